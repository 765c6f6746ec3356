"""How many environments of a training step together."""

import time

import numpy as np
import pytest
from test_residual import physical

import fmugym
from fmugym.training.sb3_training import fitting_envs


@pytest.mark.parametrize(
    ("seconds", "processors", "free", "expected"),
    [
        (0.0, 2, np.inf, 8),
        (0.0, 16, np.inf, 16),
        (0.01, 2, np.inf, 2),
        (0.01, 16, np.inf, 16),
        (0.01, 16, 6e8, 3),
        (0.0, 16, 1e7, 1),
    ],
)
def test_they_follow_from_the_machine(monkeypatch, seconds, processors, free, expected):
    def stepped(env, action, own=fmugym.FMUEnv.step):
        time.sleep(seconds)
        return own(env, action)

    name = "fmugym.training.sb3_training."
    sizes = iter([1e9, 1.1e9])
    monkeypatch.setattr(fmugym.FMUEnv, "step", stepped)
    monkeypatch.setattr(f"{name}used_memory", lambda: next(sizes))
    monkeypatch.setattr(f"{name}available_memory", lambda: free)
    monkeypatch.setattr(f"{name}available_processors", lambda: processors)
    assert fitting_envs(physical) == expected
