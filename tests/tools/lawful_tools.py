"""An FMU that notes illegal calls (``lawful.c``), and the file where it notes them."""

import logging
import mmap
import struct
from pathlib import Path

import fmu_tools
import model_tools

CALLS = (
    *("instantiate", "setup", "enter", "exit", "set", "step", "get", "reset"),
    *("get_state", "set_state", "free_state", "terminate", "get_status"),
)
"""Those that may fail, in the order of ``enum call``."""

WARNING, DISCARD, ERROR, FATAL, NOT_A_NUMBER, STOP = range(1, 7)
_SIZE, _PLAN, _FIRST = 4096, 16, 16 + 8 * 16


class Record:
    """The file; FMUs that are instantiated while it stands in the environment use it.

    Args:
        folder: Where to put it.
    """

    def __init__(self, folder):
        self.path = Path(folder) / "record"
        self.path.write_bytes(bytes(_SIZE))
        with self.path.open("r+b") as file:
            self._map = mmap.mmap(file.fileno(), _SIZE)

    def clear(self):
        """Begin anew."""
        self._map[:] = bytes(_SIZE)

    def plan(self, call, countdown, code):
        """Let a call, from now on the ``countdown``-th, return a status."""
        place = _PLAN + 8 * CALLS.index(call)
        self._map[place : place + 8] = struct.pack("ii", countdown, code)

    @property
    def illegal(self):
        """The first illegal call; empty if there was none."""
        return self._map[_FIRST : _FIRST + 128].split(b"\0")[0].decode()


_VARIABLES = (
    ("u", "input", 'start="0"'),
    ("y", "output", ""),
    ("k", "parameter", 'start="1"'),
    *((name, "parameter", 'start="0"') for name in ("longest", "leak", "step_leak")),
)


def lawful_fmu(folder, version):
    """Write the FMU, whose variables are all real: an input u, an output y, and parameters."""
    flags = f'canHandleVariableCommunicationStepSize="true" {model_tools.STATES[version]}'
    xml = model_tools.describe(version, "{lawful}", _VARIABLES, flags, name="Lawful")
    library = fmu_tools.model_library(version, "Lawful", "sources/lawful.c")
    return fmu_tools.write_model(Path(folder) / "Lawful.fmu", version, "Lawful", xml, library)


class LawfulEnv(fmu_tools.PlainEnv):
    """y' = k u."""

    def __init__(self, path, **changes):
        config = {
            "model_input_names": "u",
            "model_output_names": "y",
            "time_step": 0.5,
            "bounds": {"u": (-1, 1)},
        }
        super().__init__(path, fmu_tools.grouped(config | changes), logging.CRITICAL)
