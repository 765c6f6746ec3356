"""Deployment of agents: as C, FMUs and ONNX (``export``), and beside a plant (``plant``)."""
