"""Arrays in all pools: against closed forms and FMPy."""

import makers
import numpy as np
import pytest
import values_tools
from combinations import in_turn
from gymnasium import spaces
from scipy.linalg import expm
from values_tools import (
    POOLS,
    STEP,
    VERSIONS,
    Env,
    Writing,
    fixture_feedthrough,  # noqa: F401  # the fixture "feedthrough"
    pools,
    state_space_env,
    ways,
)
from vector_tools import require_same_alone

import fmugym
from fmugym import Choice, ConfigError, Uniform
from fmugym.environment.env_checker import check_fmu_env
from fmugym.records import RecordSeries

A = np.array([[-1.0, 0.5], [0.0, -2.0]])

B = np.array([[1.0], [0.5]])

C = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])

D = np.array([[0.0], [0.0], [0.25]])


@pytest.fixture(scope="module")
def state_space(tmp_path_factory):
    return values_tools.state_space_fmu(tmp_path_factory.mktemp("ss") / "S.fmu", fixed=True)


def exact(x, u, steps):
    """The states after some steps with a constant input."""
    n = len(x)
    block = np.zeros((n + 1, n + 1))
    block[:n, :n], block[:n, n:] = A, B * u
    return (expm(block * STEP * steps) @ np.append(x, 1.0))[:n]


@ways
def test_arrays_follow_the_closed_form(state_space, options):
    env = state_space_env(
        state_space,
        model_parameters={"x_0": [0.5, Uniform(1, 2)]},
        monitor_names=["der(x)"],
        **options,
    )
    assert env.observation_names == ("y[1]", "y[2]", "y[3]", "x[1]", "x[2]")
    assert env.observation_space.shape == (5,)
    assert env.action_space == spaces.Box(-5, 5, (1,), np.float32)
    for episode in range(2):
        env.reset(seed=None if episode else 3)
        start = env.parameters["x_0"]
        assert start[0] == 0.5
        assert 1 <= start[1] <= 2
        for step in range(1, 4):
            observation, *_ = env.step(np.array([0.5], np.float32))
            x = exact(start, 0.5, step)
            assert env.out["x"] == pytest.approx(x, abs=1e-7)
            assert env.out["y"] == pytest.approx(C @ x + D @ [0.5], abs=1e-7)
            assert env.out["der(x)"] == pytest.approx(A @ x + B @ [0.5], abs=1e-7)
            assert observation == pytest.approx(np.append(C @ x + D @ [0.5], x), rel=1e-6)
    env.close()


@pools
def test_one_element(state_space, options):
    """The other elements keep their start values, since FMI sets whole arrays only."""
    config = {
        "model_input_names": "u[1]",
        "model_output_names": ["y[3]", "x[2]"],
        "model_parameters": {"A[1,2]": 0.75, "B[2,1]": 2.0, "C[3,1]": Choice([0.5])},
        "bounds": {"u[1]": (-1, 1)},
    }
    env = Env(state_space, **config, **options)
    env.reset()
    env.step(np.ones(1, np.float32))
    own = env.read_variables("A", "B", "C")
    wanted = {"A[1,1]": -1, "A[1,2]": 0.75, "A[2,1]": 0, "A[2,2]": -2, "B[1,1]": 1, "B[2,1]": 2}
    wanted |= {"C[1,1]": 1, "C[1,2]": 0, "C[2,1]": 0, "C[2,2]": 1, "C[3,1]": 0.5, "C[3,2]": 1}
    assert own == wanted
    assert env.out["y"].shape == (1,)
    assert env.state == (env.out["y[3]"], env.out["x[2]"])
    env.close()


@in_turn({"version": VERSIONS, "options": POOLS})
def test_some_elements_are_inputs(feedthrough, version, options):
    """Names as ``v[1]`` are elements in FMI 3.0, and mere names before it."""
    first, second = ("v[1,2]", "v[2,1]") if version == 3 else ("v[1]", "v[2]")
    env = Writing(
        feedthrough[version],
        given=[3, 5],
        model_input_names=[second, first],
        model_output_names=["w"],
        monitor_names=["Boolean_out"],
        **options,
    )
    for _ in range(2):
        env.reset()
        env.step(0)
        assert env.out["w"].tolist() == ([0, 5, 3, 0] if version == 3 else [5, 3])
        assert tuple(env.inputs) == (3.0, 5.0)
    env.close()


def test_bounds_and_samplings_of_arrays(feedthrough):
    env = Env(
        feedthrough[3],
        model_input_names="v",
        model_output_names=["w", "Int16_out"],
        bounds={"v[2,1]": (-1, 1), "v": (-3, 4), "w": (-7, 7)},
        samplings={"w": "integral", "w[1,1]": "last"},
        substeps=2,
    )
    assert env.action_space.low.tolist() == [-3, -3, -1, -3]
    assert env.action_space.high.tolist() == [4, 4, 1, 4]
    assert env.observation_space.high.tolist()[:4] == [7, 7, 7, 7]
    env.reset()
    env.step(np.array([4, 3, 1, 2], np.float32))
    assert env.state == pytest.approx((4, 0.3, 0.1, 0.2, 0))
    env.close()


@pools
def test_vector_environments_do_as_single_ones(state_space, options):
    drawn = {"A": [[Uniform(-2, -1), 0.5], [0, -2]]}
    require_same_alone(lambda: state_space_env(state_space, model_parameters=drawn, **options), 3)


def test_each_environment_has_its_own_array(state_space, make_envs):
    envs = make_envs(lambda: state_space_env(state_space, model_parameters={"x_0": 0.0}), 2)
    envs.set_attr("x_0", [[1, 2], [3, 4]])
    envs.set_attr("A[1,2]", [0.5, 0.0])
    assert envs.reset()[0][:, 3:].tolist() == [[1, 2], [3, 4]]
    rows = envs.step(np.zeros((2, 1), np.float32))[0]
    assert rows[0, 3:] == pytest.approx(exact([1, 2], 0, 1), rel=1e-6)
    assert rows[1, 3] == pytest.approx(3 * np.exp(-STEP), rel=1e-6)
    with pytest.raises(ConfigError, match=r"'x_0'.*\(2,\)"):
        envs.set_attr("x_0", [[1, 2], [3]])


def test_hooks_on_arrays_of_environments(state_space):
    class Sum(Env):
        def _is_done(self):
            return self.out["y"].sum(axis=0) > 100

        def _reward_policy(self):
            return self.out["x"].sum(axis=0) - self.parameters["x_0"][1]

        def _get_observation(self):
            return np.stack([self.out["y"][2], self.out["x[1]"] * self.parameters["A[1,2]"]])

        def _get_observation_space(self):
            return spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def make():
        return Sum(
            state_space,
            model_input_names="u",
            model_output_names=["y", "x"],
            model_parameters={"x_0": [1, Uniform(0, 1)], "A": [[-1, 0.5], [0, -2]]},
        )

    require_same_alone(make, 3, way="arrays")


@pools
def test_snapshots(state_space, options):
    env = state_space_env(state_space, model_parameters={"x_0": [1, Uniform(1, 2)]}, **options)
    env.reset(seed=2)
    action = np.ones(1, np.float32)
    env.step(action)
    saved, rows = env.save_state(), []
    for _ in range(3):
        rows.append([env.step(action)[0].tolist() for _ in range(2)])
        env.restore_state(saved)
    assert rows[0] == rows[1] == rows[2]
    assert rows[0][0] != rows[0][1]
    env.close()


def test_rollouts(state_space, make_envs):
    def make():
        return state_space_env(state_space, model_parameters={"A": [[-1, 0.5], [0, -2]]})

    envs, env = make_envs(make, 2), make()
    env.reset(seed=0)
    start = env.save_state()
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 3, 1)).astype(np.float32)
    matrices = [[[-1, coupling], [0, -2]] for coupling in (0.5, 0.5, 0.1, 0.2)]
    rollout = envs.rollout(start, actions, parameters={"A": matrices})
    for index, matrix in enumerate(matrices):
        env.reset(seed=0, options={"model_parameters": {"A": matrix}})
        rows = [env.step(action)[0].tolist() for action in actions[index]]
        assert rollout.observations[index].tolist() == rows
    with pytest.raises(ConfigError, match=r"A\[1,1\].*all elements"):
        envs.rollout(start, actions, parameters={"A[1,2]": 0.5})
    env.close()


def test_parameters_of_one_episode(state_space):
    env = state_space_env(state_space, model_parameters={"x_0": [1, 2], "A": [[-1, 0], [0, -2]]})
    given = {"x_0": Uniform(3, 4), "A[1,2]": 0.25}
    _, info = env.reset(seed=0, options={"model_parameters": given})
    assert set(info["drawn"]) == {"x_0[1]", "x_0[2]", "A[1,2]"}
    assert env.parameters["A"].tolist() == [-1, 0.25, 0, -2]
    assert env.out["x"].tolist() == [info["drawn"]["x_0[1]"], info["drawn"]["x_0[2]"]]
    assert info["drawn"]["x_0[1]"] != info["drawn"]["x_0[2]"]
    env.reset()
    assert env.out["x"].tolist() == [1, 2]
    env.close()


def test_series(state_space):
    env = RecordSeries(state_space_env(state_space), ["y", "A", "u[1]"])
    env.reset(seed=0)
    env.step(np.ones(1, np.float32))
    series = env.series
    names = [column.name for column in series.columns]
    wanted = [*(f"y[{i}]" for i in (1, 2, 3)), "u[1]", "A[1,1]", "A[1,2]", "A[2,1]", "A[2,2]"]
    assert set(wanted) <= set(names)
    assert "x[1]" not in names
    assert series["A[1,2]"].tolist() == [0.5, 0.5]
    assert series["u[1]"].tolist()[1:] == [1]
    env.close()


def test_a_task_file_names_elements(state_space, tmp_path):
    (tmp_path / "task.toml").write_text(
        f"""
        fmu = "{state_space}"
        time_step = 0.1
        [variables]
        total = {{ name = "y[3]" }}
        [agent]
        actions = ["u[1]"]
        observations = ["total", "x[2]"]
        [reward]
        near = "-total**2"
        [parameters]
        "A[1,2]" = {{ distribution = "uniform", low = 0.25, high = 0.5 }}
        """
    )
    env = fmugym.load(tmp_path / "task.toml")
    observation, _ = env.reset(seed=0)
    assert env.observation_names == ("total", "x[2]")
    assert observation == pytest.approx([env.out["y[3]"], env.out["x[2]"]])
    assert 0.25 <= env.parameters["A[1,2]"] <= 0.5
    env.close()


@pytest.mark.parametrize("words", [(), ("--class",)], ids=["task", "class"])
def test_fmugym_new_knows_elements(state_space, tmp_path, words, ran):
    path = tmp_path / ("new.py" if words else "new.toml")
    ran("new", state_space, "--output", path, *words)
    text = path.read_text()
    for name in ("u[1]", "y[1]", "y[2]", "y[3]", "x[1]", "x[2]"):
        assert f'"{name}"' in text
    assert "[[-1.0, 0.5], [0.0, -2.0]]" in text
    if not words:
        path.write_text(text.replace("# A = [[-1.0, 0.5]", "A = [[-1.0, 0.25]"))
        out = ran("validate", path)
        assert "each parameter of the task has an effect" in out
        env = fmugym.load(path)
        env.reset()
        env.step(env.action_space.sample())
        env.close()


def test_the_contract(state_space):
    env = state_space_env(state_space, model_parameters={"A": [[-1, 0.5], [0, -2]]})
    check_fmu_env(env)


@pools
def test_arrays_of_pythonfmu3(mixer, options):
    gain = np.array([[1, 2, 3], [4, 5, 6]])
    u = np.array([1, 0.5, -0.5], np.float32)

    def make():
        return Env(
            mixer,
            model_input_names="u",
            model_output_names="y",
            model_parameters={"gain": gain},
            bounds={"u": (-1, 1)},
            **options,
        )

    env = make()
    for _ in range(2):
        env.reset()
        for steps in (1, 2, 3):
            env.step(u)
            assert env.out["y"] == pytest.approx(gain @ u * STEP * steps, abs=1e-12)
    env.close()


@pytest.fixture(scope="module")
def mixer(tmp_path_factory):
    build = makers.by_python("pythonfmu3", "foreign_mixer3.py")
    return build(tmp_path_factory.mktemp("mixer"))


@pytest.mark.parametrize(
    ("changes", "facts"),
    [
        ({"model_output_names": ["y[4]"]}, r"y\[4\].*\(3,\)"),
        ({"model_output_names": ["y[0]"]}, r"y\[0\].*\(3,\)"),
        ({"model_output_names": ["y[1,1]"]}, r"y\[1,1\].*\(3,\)"),
        ({"model_output_names": ["yy"]}, "yy.*'y'"),
        ({"model_output_names": ["y", "y[2]"]}, r"y\[2\].*twice"),
        ({"bounds": {"u[2]": (0, 1)}}, r"u\[2\]"),
        ({"bounds": {"AA": (0, 1)}}, "'AA'"),
        ({"samplings": {"y[9]": "mean"}}, r"y\[9\]"),
        ({"model_parameters": {"A": [1, 2, 3]}}, r"'A'.*\(2, 2\).*\(3,\)"),
        ({"model_parameters": {"A": [[1, 2], [3]]}}, r"'A'.*\(2, 2\).*different"),
        ({"model_parameters": {"A": [[1, 2], [3, "b"]]}}, r"A\[2,2\].*'b'"),
        ({"model_parameters": {"A": np.eye(3)}}, r"'A'.*\(2, 2\).*\(3, 3\)"),
        ({"model_parameters": {"y": [1, 2, 3]}}, r"y\[1\].*output"),
        ({"model_input_names": "x_0[1]"}, r"x_0\[1\].*parameter"),
    ],
)
def test_wrong_arrays(state_space, changes, facts):
    with pytest.raises(ConfigError, match=facts):
        state_space_env(state_space, **changes)


def test_start_values_of_elements_that_are_no_inputs(feedthrough):
    """They would be lost with the first input, for FMI sets whole arrays only."""
    with pytest.raises(ConfigError, match=r"v\[1,1\].*'v'"):
        Env(
            feedthrough[3],
            model_input_names="v[1,2]",
            model_output_names="w",
            model_parameters={"v[1,1]": 3},
        )
