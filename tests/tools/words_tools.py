"""An FMU that says why it fails (``zoo/words.c``), and an environment over it."""

from pathlib import Path

import fmu_tools
import model_tools

import fmugym

CATEGORIES = ("logEvents", "logStatusError", "logStatusDiscard", "logAll")
STEP = 0.5
VARIABLES = (
    ("u", "input", 'start="0"'),
    ("y", "output", ""),
    ("at", "parameter", 'start="0"'),
    ("asked", "output", ""),
)


def words_fmu(folder, version, token, categories=CATEGORIES):
    """Write an FMU; see ``words.c`` for the tokens."""
    description = {"flags": "", "categories": categories}
    path = Path(folder) / "Words.fmu"
    return model_tools.model_fmu(path, "words", version, token, VARIABLES, **description)


class WordsEnv(fmugym.FMUEnv):
    """Integrates its action until the FMU fails in step ``at``."""

    def __init__(self, path, at=0, level=30, **options):
        keywords = {key: options.pop(key) for key in ("backend",) if key in options}
        config = {
            "model_input_names": "u",
            "model_output_names": ["y", "asked"],
            "model_parameters": {"at": at},
            "time_step": STEP,
            "bounds": {"u": (-1, 1)},
        } | options
        super().__init__(path, fmu_tools.grouped(config), level, **keywords)

    def _is_done(self):
        return self.state[0] > 1e9
