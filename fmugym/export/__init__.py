"""Agents outside of Python: C99, FMUs and ONNX, with everything around the network.

``agent_of`` puts an agent together from its environment and its model. ``write_c``, ``write_fmu``
and ``write_onnx`` write it. See ``docs/deploy.md``.
"""

from fmugym.export.c99 import write_c
from fmugym.export.exportable import ExportedAgent, agent_of
from fmugym.export.fmus import write_fmu
from fmugym.export.network import Activation, Layer, Network, Scaling, network_of
from fmugym.export.onnx_model import write_onnx

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
