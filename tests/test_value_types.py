"""Values of every type, and arrays, in all pools: against closed forms and FMPy."""

import fmpy
import makers
import model_tools
import numpy as np
import pytest
import values_tools
from gymnasium import spaces
from scipy.linalg import expm

import fmugym
from fmugym import Choice, ConfigError, FMUVectorEnv, Uniform
from fmugym.series import RecordSeries
from fmugym.testing import check_fmu_env
from fmugym.tools import cli

STEP = 0.1
POOLS = {
    "native": {},
    "python": {"backend": "python"},
    "isolated": {"isolation": "process"},
    "isolated python": {"isolation": "process", "backend": "python"},
}
pools = pytest.mark.parametrize("options", POOLS.values(), ids=POOLS)
VERSIONS = (1, 2, 3)
versions = pytest.mark.parametrize("version", VERSIONS)
LIMITS = {
    "Integer": (-(2**31), 2**31 - 1),
    "Boolean": (0, 1),
    "Float32": (-float(np.finfo(np.float32).max), float(np.finfo(np.float32).max)),
    **{f"Int{n}": (-(2 ** (n - 1)), 2 ** (n - 1) - 1) for n in (8, 16, 32)},
    **{f"UInt{n}": (0, 2**n - 1) for n in (8, 16, 32)},
    "Int64": (-(2**53), 2**53),
    "UInt64": (0, 2**53),
    "Real": (-1e30, 1e30),
    "Float64": (-1e30, 1e30),
}
A = np.array([[-1.0, 0.5], [0.0, -2.0]])
B = np.array([[1.0], [0.5]])
C = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
D = np.array([[0.0], [0.0], [0.25]])


class Env(fmugym.FMUEnv):
    """An FMU without a task."""

    def __init__(self, path, backend=None, isolation=None, **config):
        defaults = {"time_step": STEP, "probe_timeout": None}
        super().__init__(path, defaults | config, backend=backend, isolation=isolation)

    def _is_done(self):
        return self.out["y"][0] > 1e9 if "y" in self.out else False


class Writing(Env):
    """Writes the same inputs in each step, whatever the action."""

    def __init__(self, path, given, **config):
        self.given = given
        super().__init__(path, **config)

    def _get_action_space(self):
        return spaces.Discrete(2)

    def _get_inputs(self):
        return self.given


def state_space_env(path, **changes):
    config = {"model_input_names": "u", "model_output_names": ["y", "x"]}
    return Env(path, **(config | changes))


@pytest.fixture(scope="module")
def feedthrough(tmp_path_factory):
    folder = tmp_path_factory.mktemp("feedthrough")
    return {v: values_tools.feedthrough_fmu(folder / f"F{v}.fmu", v) for v in VERSIONS}


@pytest.fixture(scope="module")
def state_space(tmp_path_factory):
    return values_tools.state_space_fmu(tmp_path_factory.mktemp("ss") / "S.fmu", fixed=True)


# Types


@versions
@pools
def test_numbers_of_every_type_come_out_as_they_went_in(feedthrough, version, options):
    types = values_tools.TYPES[version]
    names = {key: [f"{t}_{key}" for t in types] for key in ("in", "out", "parameter", "told")}
    for place in (0, 1):
        values = [LIMITS[type_][place] for type_ in types]
        env = Writing(
            feedthrough[version],
            given=values,
            model_input_names=names["in"],
            model_output_names=names["out"] + names["told"],
            model_parameters=dict(zip(names["parameter"], values, strict=True)),
            **options,
        )
        env.reset()
        env.step(0)
        assert env.state == tuple(map(float, values + values))
        env.close()


@versions
def test_values_outside_of_a_type(feedthrough, version):
    for type_ in values_tools.TYPES[version]:
        if type_ in {"Real", "Float64"}:
            continue
        low, high = LIMITS[type_]
        excess = 1e36 if type_ == "Float32" else 2 if "64" in type_ else 1
        for value in (low - excess, high + excess):
            with pytest.raises(ConfigError, match=f"{type_}_parameter"):
                Writing(
                    feedthrough[version],
                    given=[],
                    model_input_names=[],
                    model_output_names=[f"{type_}_out"],
                    model_parameters={f"{type_}_parameter": value},
                )
            env = Writing(
                feedthrough[version],
                given=[value],
                model_input_names=[f"{type_}_in"],
                model_output_names=[f"{type_}_out"],
            )
            env.reset()
            if type_ == "Boolean":
                env.step(0)
                assert env.state == (float(value >= 0.5),)
            else:
                with pytest.raises(ConfigError, match=f"{type_}_in"):
                    env.step(0)
            env.close()


@versions
@pools
def test_enumerations_are_discrete(feedthrough, version, options):
    env = Env(
        feedthrough[version],
        model_input_names="Enumeration_in",
        model_output_names="Enumeration_out",
        **options,
    )
    assert env.action_space == env.observation_space == spaces.Discrete(2)
    env.reset()
    assert [env.step(action)[0] for action in (0, 1, 0)] == [0, 1, 0]
    env.close()


# Arrays


def exact(x, u, steps):
    """The states after some steps with a constant input."""
    n = len(x)
    block = np.zeros((n + 1, n + 1))
    block[:n, :n], block[:n, n:] = A, B * u
    return (expm(block * STEP * steps) @ np.append(x, 1.0))[:n]


WAYS = [
    options | {"interface": interface, "tolerance": 1e-9}
    for options in POOLS.values()
    for interface in ("co_simulation", "model_exchange")
]
ways = pytest.mark.parametrize(
    "options", WAYS, ids=lambda options: " ".join(map(str, options.values()))
)


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


def test_arrays_agree_with_fmpy(state_space):
    matrix = [[-0.5, 2.0], [-2.0, -0.5]]
    env = state_space_env(state_space, model_parameters={"A": matrix, "x_0": 1.0})
    env.reset()
    rows = [env.out["y"]]
    for _ in range(5):
        env.step(np.zeros(1, np.float32))
        rows.append(env.out["y"])
    env.close()
    result = fmpy.simulate_fmu(
        str(state_space),
        stop_time=0.5,
        output_interval=STEP,
        fmi_type="CoSimulation",
        start_values={"A": np.ravel(matrix), "x_0": [1, 1]},
        output=["y"],
    )
    assert np.array(rows) == pytest.approx(result["y"], abs=1e-12)


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


@versions
@pools
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
    def make():
        return state_space_env(
            state_space, model_parameters={"A": [[Uniform(-2, -1), 0.5], [0, -2]]}, **options
        )

    envs, env = FMUVectorEnv(make, 3), make()
    seen = envs.reset(seed=5)[0]
    for index in range(3):
        assert seen[index].tolist() == env.reset(seed=5 + index)[0].tolist()
        for _ in range(3):
            env.step(np.array([0.25], np.float32))
        envs.reset(seed=5)
        for _ in range(3):
            rows = envs.step(np.full((3, 1), 0.25, np.float32))[0]
        assert rows[index].tolist() == np.float32(env.state).tolist()
    env.close()
    envs.close()


def test_each_environment_has_its_own_array(state_space):
    envs = FMUVectorEnv(lambda: state_space_env(state_space, model_parameters={"x_0": 0.0}), 2)
    envs.set_attr("x_0", [[1, 2], [3, 4]])
    envs.set_attr("A[1,2]", [0.5, 0.0])
    assert envs.reset()[0][:, 3:].tolist() == [[1, 2], [3, 4]]
    rows = envs.step(np.zeros((2, 1), np.float32))[0]
    assert rows[0, 3:] == pytest.approx(exact([1, 2], 0, 1), rel=1e-6)
    assert rows[1, 3] == pytest.approx(3 * np.exp(-STEP), rel=1e-6)
    with pytest.raises(ConfigError, match=r"'x_0'.*\(2,\)"):
        envs.set_attr("x_0", [[1, 2], [3]])
    envs.close()


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

    envs, env = FMUVectorEnv(make, 2, hooks="array"), make()
    envs.reset(seed=1)
    env.reset(seed=1)
    for _ in range(3):
        action = np.array([0.5], np.float32)
        one, many = env.step(action), envs.step(np.stack([action, action]))
        assert many[0][0].tolist() == np.float32(one[0]).tolist()
        assert many[1][0] == one[1]
    envs.close()
    env.close()


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


def test_rollouts(state_space):
    def make():
        return state_space_env(state_space, model_parameters={"A": [[-1, 0.5], [0, -2]]})

    envs, env = FMUVectorEnv(make, 2), make()
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
    envs.close()
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


@pytest.mark.parametrize("words", [(), ("--class",)], ids=["task", "class"])
def test_fmugym_new_knows_elements(state_space, tmp_path, capsys, words):
    path = tmp_path / ("new.py" if words else "new.toml")
    assert cli.main(["new", str(state_space), "--output", str(path), *words]) == 0
    text = path.read_text()
    for name in ("u[1]", "y[1]", "y[2]", "y[3]", "x[1]", "x[2]"):
        assert f'"{name}"' in text
    assert "[[-1.0, 0.5], [0.0, -2.0]]" in text
    if not words:
        path.write_text(text.replace("# A = [[-1.0, 0.5]", "A = [[-1.0, 0.25]"))
        assert cli.main(["validate", str(path)]) == 0
        assert "each parameter of the task has an effect" in capsys.readouterr().out
        env = fmugym.load(path)
        env.reset()
        env.step(env.action_space.sample())
        env.close()


# Strings and Binary


@versions
@pools
def test_strings_are_set(feedthrough, version, options):
    env = Writing(
        feedthrough[version],
        [],
        model_input_names=[],
        model_output_names="length",
        model_parameters={"String_parameter": "bluish", "String_in": "green"},
        **options,
    )
    for _ in range(3):
        env.reset()
        env.step(0)
        assert env.state == (len("bluish"),)
    env.close()


@versions
@pools
def test_an_fmu_reads_a_file_of_its_resources(tmp_path, version, options):
    path = model_tools.model_fmu(
        tmp_path / "Resource.fmu",
        "resource",
        version,
        "{resource}",
        [("y", "output", "")],
        add={"resources/y.txt": "42.5"},
    )

    def make():
        return Writing(path, [], model_input_names=[], model_output_names="y", **options)

    envs, env = FMUVectorEnv(make, 2), make()
    assert env.reset()[0].tolist() == [42.5]
    assert envs.reset()[0].tolist() == [[42.5]] * 2
    env.close()
    envs.close()


@pytest.mark.parametrize(
    ("changes", "facts"),
    [
        ({"model_input_names": "String_in"}, r"'String_in'.*input.*String.*model_parameters"),
        ({"model_output_names": "String_out"}, r"'String_out'.*output.*String.*number"),
        ({"model_parameters": {"String_parameter": 3}}, r"'String_parameter'.*String.*3"),
        ({"model_input_names": "Binary_in"}, r"'Binary_in'.*input.*Binary.*numbers"),
        ({"model_parameters": {"Binary_in": "00"}}, r"'Binary_in'"),
    ],
)
def test_refused_types(feedthrough, changes, facts):
    config = {"model_input_names": "v", "model_output_names": "w", "bounds": {"v": (0, 1)}}
    with pytest.raises(ConfigError, match=facts):
        Env(feedthrough[3], **(config | changes))


def test_the_contract(state_space):
    env = state_space_env(state_space, model_parameters={"A": [[-1, 0.5], [0, -2]]})
    check_fmu_env(env, num_steps=20)


# Sizes

LARGER = {
    "n": 3,
    "m": 2,
    "r": 1,
    "A": [[-1, 0.5, 0], [0, -2, 1], [0.1, 0, -3]],
    "B": [[1, 0], [0, 1], [1, 1]],
    "C": [[1, 1, 1]],
    "D": [[0.5, 0]],
    "x_0": [1, 2, 3],
}


@pytest.fixture(scope="module")
def sized(tmp_path_factory):
    return values_tools.state_space_fmu(tmp_path_factory.mktemp("ss") / "S.fmu")


def larger(steps, u):
    """The outputs and states of the larger model after some steps with constant inputs."""
    block = np.zeros((5, 5))
    block[:3, :3], block[:3, 3:] = LARGER["A"], LARGER["B"]
    x = (expm(block * STEP * steps) @ np.append(LARGER["x_0"], u))[:3]
    return np.append(np.dot(LARGER["C"], x) + np.dot(LARGER["D"], u), x)


@pytest.mark.parametrize("probe", [None, 60.0], ids=["", "tried"])
@ways
def test_structural_parameters_give_arrays_their_sizes(sized, options, probe):
    config = {"model_parameters": LARGER, "probe_timeout": probe} | options
    envs = FMUVectorEnv(lambda: state_space_env(sized, **config), 2)
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
    envs.close()


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


# Other makers


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


# Mistakes


@pytest.mark.parametrize(
    ("changes", "facts"),
    [
        ({"model_output_names": ["y[4]"]}, r"y\[4\].*\(3,\)"),
        ({"model_output_names": ["y[0]"]}, r"y\[0\].*\(3,\)"),
        ({"model_output_names": ["y[1,1]"]}, r"y\[1,1\].*\(3,\)"),
        ({"model_output_names": ["yy"]}, "yy.*'y'"),
        ({"model_output_names": ["y", "y[2]"]}, r"y\[2\].*twice"),
        ({"bounds": {"u[2]": (0, 1)}}, r"u\[2\]"),
        ({"bounds": {"A": (0, 1)}}, "'A'"),
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
