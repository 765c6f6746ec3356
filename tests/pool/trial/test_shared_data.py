"""FMUs whose steps work in data that all instances of a library share: ``zoo/scratch.c``."""

import contextlib
import sys

import fmu_tools
import model_tools
import numpy as np
import pytest

import fmugym
from fmugym.pool.trial.verdict import Neighbours, known_verdict

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="it asks the loader of Linux")

KINDS = ("statics", "objects", "common", "table")
STEP, SUBSTEP = 0.05, 0.001
NUM_ENVS, NUM_STEPS = 128, 10_000


def scratch_fmu(folder, kind):
    source = f"zoo/scratch_{kind}.{'cpp' if kind == 'objects' else 'c'}"
    sources = ("zoo/scratch.c", source, "zoo/usual.c", "zoo/fmi2.c")
    flags = ("-Wl,--no-as-needed", "-lstdc++")
    library = fmu_tools.model_library(2, "Zoo", *sources, flags=flags)
    xml = model_tools.describe(2, kind, model_tools.GAIN_VARIABLES)
    return fmu_tools.write_model(folder / kind / "Scratch.fmu", 2, "Zoo", xml, library)


class ScratchEnv(model_tools.GainEnv):
    def __init__(self, path, log_level=30):
        super().__init__(path, fmugym.Uniform(0.5, 2.0), log_level, time_step=STEP)


def expected_outputs(gains, inputs):
    """By the same operations in the same order."""
    y, rows = np.zeros_like(gains), []
    for u in inputs:
        for _ in range(round(STEP / SUBSTEP)):
            y = y + SUBSTEP * (gains * u - y)
        rows.append(y)
    return np.array(rows)


@pytest.mark.usefixtures("own_trials")
@pytest.mark.parametrize("kind", KINDS)
def test_steps_in_threads_do_not_deviate(tmp_path, kind):
    path = scratch_fmu(tmp_path, kind)
    inputs = np.random.default_rng(7).uniform(-1, 1, (NUM_STEPS, NUM_ENVS)).astype(np.float32)
    envs = fmugym.FMUVectorEnv(lambda: ScratchEnv(path), NUM_ENVS, threads=8)
    with contextlib.closing(envs):
        _, infos = envs.reset(seed=3)
        seen = [envs.step(row[:, None])[0][:, 0].copy() for row in inputs]
    expected = expected_outputs(infos["drawn"]["gain"], inputs.astype(np.float64))
    deviations = np.count_nonzero(np.array(seen) != expected.astype(np.float32))
    assert deviations == 0, known_verdict(fmugym.FMU(path)).neighbours
    assert known_verdict(fmugym.FMU(path)).neighbours is Neighbours.LIBRARIES
