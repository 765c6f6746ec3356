"""Structural parameters, by which arrays get their sizes, in all pools: against a closed form."""

import numpy as np
import pytest
import values_tools
from combinations import in_turn
from scipy.linalg import expm
from values_tools import (
    LARGER,
    STEP,
    WAYS,
    Writing,
    state_space_env,
)

import fmugym
from fmugym import Choice, ConfigError


@pytest.fixture(scope="module")
def sized(tmp_path_factory):
    return values_tools.state_space_fmu(tmp_path_factory.mktemp("ss") / "S.fmu")


def larger(steps, u):
    """The outputs and states of the larger model after some steps with constant inputs."""
    block = np.zeros((5, 5))
    block[:3, :3], block[:3, 3:] = LARGER["A"], LARGER["B"]
    x = (expm(block * STEP * steps) @ np.append(LARGER["x_0"], u))[:3]
    return np.append(np.dot(LARGER["C"], x) + np.dot(LARGER["D"], u), x)


@in_turn({"options": WAYS, "probe": [None, 60.0]})
def test_structural_parameters_give_arrays_their_sizes(sized, options, probe, make_envs):
    config = {"model_parameters": LARGER, "probe_timeout": probe} | options
    envs = make_envs(lambda: state_space_env(sized, **config), 2)
    env = state_space_env(sized, **config)
    assert env.action_space.shape == (2,)
    assert env.observation_names == ("y[1]", "x[1]", "x[2]", "x[3]")
    u = np.array([0.5, -0.25], np.float32)
    for _ in range(3):
        env.reset()
        envs.reset()
        for steps in (1, 2):
            env.step(u)
            rows = envs.step(np.stack([u, u]))[0]
            assert env.state == pytest.approx(larger(steps, u), abs=1e-7)
            assert rows.tolist() == [np.float32(env.state).tolist()] * 2
    env.close()


def test_a_task_file_gives_sizes(sized, tmp_path):
    task = {
        "fmu": str(sized),
        "time_step": 0.1,
        "agent": {"actions": ["u[1]", "u[2]"], "observations": ["y[1]", "x[3]"]},
        "reward": {"near": "-1.0"},
        "parameters": dict(LARGER),
    }
    env = fmugym.load(task)
    env.reset(seed=0)
    env.step(np.array([0.5, -0.25], np.float32))
    wanted = larger(1, np.array([0.5, -0.25]))
    assert [env.out["y[1]"], env.out["x[3]"]] == pytest.approx([wanted[0], wanted[3]], abs=1e-7)
    env.close()
    task["parameters"]["A"] = [[1, 2]]
    with pytest.raises(ConfigError, match=r"'A'.*\(3, 3\)"):
        fmugym.load(task)


def test_sizes_of_an_opened_fmu(sized):
    fmu = fmugym.FMU(sized, sizes={"n": 3})
    assert [fmu.variable(name).shape for name in ("A", "B", "C", "u")] == [
        (3, 3),
        (3, 1),
        (3, 3),
        (1,),
    ]
    assert fmugym.FMU.of(fmu).variable("x").shape == (3,)
    assert fmugym.FMU(sized).variable("x").shape == (2,)


def test_arrays_without_elements(sized):
    given = {"m": 0, "x_0": [1, 1], "A": -np.eye(2)}
    env = Writing(sized, [], model_input_names="u", model_output_names="x", model_parameters=given)
    env.reset()
    env.step(0)
    assert env.state == pytest.approx([np.exp(-STEP)] * 2, abs=1e-9)
    env.close()


@pytest.mark.parametrize(
    ("changes", "facts"),
    [
        ({"model_parameters": {"n": 9}}, "'n'.*0 to 8.*9"),
        ({"model_parameters": {"n": -1}}, "'n'.*0 to 8.*-1"),
        ({"model_parameters": {"n": 2.5}}, "'n'.*0 to 8.*2.5"),
        ({"model_parameters": {"n": Choice([2, 3])}}, "'n'.*drawn"),
        ({"model_parameters": {"n": 3, "A[1,1]": 2}}, r"'A\[1,2\]'.*\(3, 3\)"),
        ({"model_parameters": {"n": 3, "x_0": [1, 2]}}, r"'x_0'.*\(3,\).*\(2,\)"),
        ({"model_input_names": "n"}, "'n'.*structuralParameter"),
    ],
)
def test_wrong_sizes(sized, changes, facts):
    with pytest.raises(ConfigError, match=facts):
        state_space_env(sized, **changes)


def test_sizes_cannot_change_from_episode_to_episode(sized):
    env = state_space_env(sized)
    with pytest.raises(ConfigError, match=r"'n'.*structural"):
        env.reset(options={"model_parameters": {"n": 3}})
    env.close()


def test_an_fmu_with_sizes_is_a_component(sized):
    system = fmugym.FMUSystem({"part": fmugym.FMU(sized, sizes={"n": 3})}, [("part.x[3]", "third")])
    description = system.as_fmu().description
    assert description.variable("part.x").shape == (3,)
    with pytest.raises(ConfigError, match=r"x\[4\]"):
        fmugym.FMUSystem({"part": fmugym.FMU(sized, sizes={"n": 3})}, [("part.x[4]", "fourth")])


def test_a_parameter_that_gives_no_size(sized):
    with pytest.raises(ConfigError, match=r"'x_0'.*parameter"):
        fmugym.FMU(sized, sizes={"x_0": 3})
