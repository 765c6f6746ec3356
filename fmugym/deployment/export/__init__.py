"""Agents outside of Python: C99, FMUs and ONNX, with everything around the network.

``agent_of`` puts an agent together from its environment and its model. ``write_c``, ``write_fmu``
and ``write_onnx`` write it. See ``docs/deploy.md``.
"""

from fmugym.deployment.export.agent_fmu import write_fmu
from fmugym.deployment.export.c_source import write_c
from fmugym.deployment.export.exported_agent import ExportedAgent, agent_of
from fmugym.deployment.export.network import Activation, Layer, Network, Scaling, network_of
from fmugym.deployment.export.onnx_model import write_onnx

__all__ = [
    "Activation",
    "ExportedAgent",
    "Layer",
    "Network",
    "Scaling",
    "agent_of",
    "network_of",
    "write_c",
    "write_fmu",
    "write_onnx",
]
