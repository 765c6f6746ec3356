"""Every episode equals that of a fresh FMPy instance, wherever and in whatever company FMUs run.

The FMUs are those that programs of other makers build, and a bundled one of each version of FMI.
"""

import functools
import shutil

import fresh
import makers
import numpy as np
import pytest
from combinations import in_turn

import fmugym
from fmugym.fmi.bundled import FMI_VERSIONS, bundled_fmu
from fmugym.pool import opening

pytestmark = pytest.mark.usefixtures("trials")

MADE = makers.MADE | {
    f"bundled {version}": makers.Made(
        lambda folder, version=version: bundled_fmu("Pendulum", version),
        {"tau": 0.1},
        ("q", "q_dot"),
        0.02,
        {"q_0": (0.5, 1.0)},
    )
    for version in FMI_VERSIONS
}
LENGTHS = (3, 12, 12, 5)
NUM_ENVS = 3
WAYS = {
    **{f"{threads} threads": {"threads": threads} for threads in (1, 2, 3)},
    "per env": {"way": "one by one"},
    **{f"{n} workers": {"isolation": "process", "workers": n} for n in (1, 2)},
    "default": {},
}


class MadeEnv(fmugym.FMUEnv):
    """Draws all parameters."""

    def __init__(self, path, name, **options):
        one = MADE[name]
        config = {
            "model_input_names": list(one.inputs),
            "model_output_names": one.outputs,
            "model_parameters": {n: fmugym.Uniform(*b) for n, b in one.parameters.items()},
            "bounds": {n: (-b, b) for n, b in one.inputs.items()},
            "time_step": one.step,
        }
        super().__init__(path, config, **options)

    def _is_done(self):
        return self.state[0] > 1e9


@pytest.fixture(scope="module")
def make_fmu(tmp_path_factory):
    return functools.cache(lambda name: MADE[name].build(tmp_path_factory.mktemp("made")))


def actions_of(name, length, index=0):
    """Moving inputs of one environment, shape (steps, inputs)."""
    swing = np.sin(0.9 * np.arange(length) + index)
    columns = [np.rint(abs(swing) * reach) if isinstance(reach, int) else abs(swing) * reach
               for reach in MADE[name].inputs.values()]  # fmt: skip
    return np.stack(columns, axis=1).astype(np.float32)


def expected(path, name, drawn, length, index=0):
    one = MADE[name]
    rows = [dict(zip(one.inputs, row, strict=True)) for row in actions_of(name, length, index)]
    return fresh.play(path, one.outputs, rows, one.step, drawn)


@in_turn({"name": list(MADE), "isolation": ["none", "process"]})
def test_single(make_fmu, name, isolation):
    path = make_fmu(name)
    env = MadeEnv(path, name, isolation=isolation)
    env.reset(seed=7)
    for length in LENGTHS:
        _, info = env.reset()
        rows = fresh.episode(env, actions_of(name, length))
        assert rows == expected(path, name, info.get("drawn", {}), length)
    env.close()


@in_turn({"name": list(MADE), "way": list(WAYS)})
def test_vector(make_fmu, name, way, make_envs):
    path = make_fmu(name)
    envs = make_envs(lambda: MadeEnv(path, name), NUM_ENVS, autoreset_mode="Disabled", **WAYS[way])
    envs.reset(seed=7)
    for length in LENGTHS:
        _, infos = envs.reset()
        actions = [actions_of(name, length, index) for index in range(NUM_ENVS)]
        for index, states in enumerate(fresh.episodes(envs, np.stack(actions, axis=1))):
            told = infos.get("drawn", {}).items()
            drawn = {n: values[index] for n, values in told if not n.startswith("_")}
            assert states == expected(path, name, drawn, length, index)


def test_the_need_of_a_tool_is_told_once(make_fmu, caplog, tmp_path):
    """A search opens an FMU many times; no other test opens one of this name."""
    path = shutil.copy(make_fmu("pythonfmu"), tmp_path / "Well.fmu")
    for _ in range(2):
        MadeEnv(path, "pythonfmu").close()
    assert caplog.text.count("Well.fmu needs the tool that exported it to run") == 1


def test_what_is_invalid_in_it_does_not_stop(make_fmu):
    """Without a variability, Integers and Booleans are continuous, which the standard forbids."""
    findings = fmugym.FMU(make_fmu("pythonfmu")).description.findings
    assert any("variability" in finding for finding in findings)


@pytest.mark.parametrize("name", ["pythonfmu", "pythonfmu3"])
def test_who_calls_python_is_stepped_by_one_thread(make_fmu, name, make_envs, monkeypatch):
    """Two would hand the lock of Python over and over, and take eight times as long."""
    make = functools.partial(MadeEnv, make_fmu(name), name)
    found = [make_envs(make, 4, **wishes).pool.threads for wishes in ({}, {"threads": 2})]
    pool = opening.ProcessPool

    def isolated(*arguments, threads, **options):
        found.append(threads)
        return pool(*arguments, threads=threads, **options)

    monkeypatch.setattr(opening, "ProcessPool", isolated)
    make_envs(make, 4, isolation="process", workers=1)
    assert found == [1, 2, 1]
