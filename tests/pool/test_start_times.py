"""Start times that differ from episode to episode: pools, environments and declared tasks."""

import csv
import pickle
from functools import partial

import exchange_tools
import gymnasium
import numpy as np
import pytest
import wine_tools
from combinations import in_turn
from fmu_tools import grouped
from pool_tools import KINDS, open_pool, step
from test_rollouts import WAYS
from vector_tools import require_same_alone
from ways import in_way

import fmugym
from fmugym import FMU, Choice, ConfigError, FMUEnv, FMUSystem, FMUVectorEnv, Uniform
from fmugym.errors import TaskError
from fmugym.pool.pool_spec import START_TIME
from fmugym.records import RecordSeries

STEP = 0.25
STARTS = np.array([0.0, 1.5, 86400.25])
OUTPUTS = ("x", "now", "sine", "seconds")
SUNS = [("ModelExchange", 1), ("ModelExchange", 2), ("ModelExchange", 3)]
SUNS += [("CoSimulation", 2), ("CoSimulation", 3)]
CASES = [
    *(("native", *sun) for sun in SUNS),
    *(("process", "ModelExchange", 1), ("process", "CoSimulation", 3)),
    ("wine", "ModelExchange", 2),
]
all_cases = pytest.mark.parametrize(("kind", "interface", "version"), CASES)


@pytest.fixture(scope="session")
def sun(tmp_path_factory):
    """Write FMUs that tell their time, each once."""
    folder, made = tmp_path_factory.mktemp("suns"), {}

    def make(interface="CoSimulation", version=2):
        key = interface, version
        if key not in made:
            path = folder / f"{interface}{version}.fmu"
            made[key] = exchange_tools.exchange_fmu(path, "sun", version, (interface,))
        return made[key]

    return make


@pytest.fixture
def make_pool(request, sun, opened):
    """Make pools that are closed after the test."""

    def make(kind, interface="CoSimulation", version=2, n=3, **spec):
        path = sun(interface, version)
        if kind == "wine":
            request.getfixturevalue("wine")
            path = wine_tools.exchange_fmu(path.with_suffix(".win.fmu"), "sun", version)
        fmu = FMU(path, probe_timeout=None)
        return opened(open_pool(fmu, (), OUTPUTS, STEP, n, KINDS.get(kind, {}), **spec))

    return make


def start(pool, times, x=None):
    """Reset a pool with the start time of each instance, and the state if it is given."""
    variables, rows = (START_TIME,), [times]
    if x is not None:
        variables, rows = (pool.variable("x"), START_TIME), [x, times]
    pool.reset(variables, np.array(rows, np.float64))
    assert not pool.statuses.any(), pool.failure(0)


def steps(pool, count):
    for _ in range(count):
        step(pool)


def require(pool, starts, count, x=0.0):
    """Each FMU is where the closed form is after so many steps from its own start time."""
    times = starts + count * STEP
    found = dict(zip(OUTPUTS, pool.outputs, strict=True))
    np.testing.assert_allclose(found["now"], times, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found["sine"], np.sin(times), rtol=0, atol=1e-9)
    np.testing.assert_allclose(found["x"], x + np.sin(times) - np.sin(starts), atol=2e-3)
    np.testing.assert_array_equal(found["seconds"], np.floor(times) - np.floor(starts))


@all_cases
def test_each_instance_begins_at_its_own_time(make_pool, kind, interface, version):
    pool = make_pool(kind, interface, version)
    start(pool, STARTS)
    require(pool, STARTS, 0)
    steps(pool, 5)
    require(pool, STARTS, 5)
    pool.reset((), np.zeros((0, 3)))  # without one, episodes begin at that of the spec
    steps(pool, 1)
    require(pool, np.zeros(3), 1)
    for times in (STARTS, STARTS, STARTS[::-1]):  # which may find kept initial states
        start(pool, times, np.array([0.5, 0.0, -0.5]))
        steps(pool, 5)
        require(pool, times, 5, np.array([0.5, 0.0, -0.5]))


# Environments


class Sun(FMUEnv):
    """Reads the time in all hooks."""

    def __init__(self, path, isolation=None, **config):
        config = {
            "model_input_names": [],
            "model_output_names": ["x", "now", "sine"],
            "model_parameters": {"x": Uniform(-1, 1)},
            "episode_variables": {"target": Uniform(0, 1), "early": 0.0},
            "time_step": STEP,
            "max_episode_steps": 5,
            "start_time": Uniform(0, 100),
        } | config
        super().__init__(path, grouped(config), isolation=isolation)

    def _get_action_space(self):
        return gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def _get_observation_space(self):
        return gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float64)

    def _get_inputs(self):
        return ()

    def _update(self):
        self.variables["early"] = self.variables["early"] + 0.1 * self.time

    def _is_done(self):
        return self.time % 10 > 9.5

    def _reward_policy(self):
        return self.time + 10 * self.state[0] + self.variables["target"]

    def _get_observation(self):
        start = self.parameters["start_time"]
        return np.array([self.time, self.state[1], self.variables["early"], start])


ACTION = np.zeros(1, np.float32)
all_ways = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)


def vector(make, n=3, way=None, **options):
    return FMUVectorEnv(in_way(way, make), n, **options)


def play(env, seed, steps):
    """What a single environment tells, which begins a new episode where one has ended."""
    observation, info = env.reset(seed=seed)
    rows = [(observation.tolist(), info["drawn"])]
    for _ in range(steps):
        observation, reward, *ends, info = env.step(ACTION)
        rows.append((observation.tolist(), reward, *ends))
        if any(ends):
            observation, info = env.reset()
            rows.append((observation.tolist(), info["drawn"]))
    return rows


@pytest.mark.parametrize("interface", ["CoSimulation", "ModelExchange"])
def test_a_single_environment(sun, interface):
    env = Sun(sun(interface))
    drawn = []
    for seed in range(5):
        observation, info = env.reset(seed=seed)
        drawn.append(info["drawn"]["start_time"])
        assert list(info["drawn"]) == ["x", "start_time", "target"]
        assert env.time == env.parameters["start_time"] == drawn[-1]
        for count in range(1, 4):
            observation = env.step(ACTION)[0]
            assert env.time == drawn[-1] + count * STEP
            assert observation[1] == pytest.approx(env.time, abs=1e-9)
    generator = np.random.default_rng(4)
    assert drawn[-1] == [generator.uniform(*limits) for limits in ((-1, 1), (0, 100))][1]
    assert 0 <= min(drawn) < max(drawn) < 100
    env.close()


@in_turn(
    {
        "way": WAYS,
        "interface,mode": [
            ("CoSimulation", "next_step"),
            ("CoSimulation", "disabled"),
            ("ModelExchange", "same_step"),
        ],
    }
)
def test_many_environments_equal_single_ones(sun, way, interface, mode):
    assert require_same_alone(partial(Sun, sun(interface)), 14, mode, **way)


@in_turn({"way": WAYS, "interface,version": SUNS})
def test_snapshots_and_rollouts_keep_it(sun, way, interface, version):
    make = partial(Sun, sun(interface, version), max_episode_steps=20)
    env, envs = make(), vector(make, 2, **way)
    env.reset(seed=11)
    env.step(ACTION)
    snapshot = pickle.loads(pickle.dumps(env.save_state()))
    expected = [env.step(ACTION)[:2] for _ in range(3)]
    envs.reset(seed=0)
    rollout = envs.rollout(snapshot, np.zeros((2, 3, 1), np.float32))
    for index in range(2):
        assert rollout.rewards[index].tolist() == [reward for _, reward in expected]
    envs.restore_state(snapshot, 1)
    for observation, reward in expected:
        result = envs.step(np.zeros((2, 1), np.float32))
        assert result[0][1].tolist() == observation.tolist()
        assert result[1][1] == reward
        assert result[0][0][0] != observation[0]
    env.close()
    envs.close()


@all_ways
def test_the_stop_time_ends_episodes(sun, way):
    make = partial(Sun, sun(), start_time=[1.0, 2.0, 3.0], stop_time=4.5, max_episode_steps=9)
    assert require_same_alone(make, 30, **way)
    with make() as env:
        expected = play(env, 5, 30)
    lengths, count = set(), 0
    for row in expected:
        if len(row) == 2:
            count, start = 0, row[1]["start_time"]
            continue
        count += 1
        assert row[3] == (count == min(9, (4.5 - start) / STEP))
        lengths |= {count} if row[3] else set()
    assert lengths == {9, 6}


def test_kept_initial_states_are_of_one_start_time(sun):
    starts = {"model_parameters": {}, "start_time": Choice([1.0, 20.0])}
    env = Sun(sun(), **starts, max_episode_steps=2, reset_method="restore")
    seen = set()
    for episode in range(40):
        observation, info = env.reset(seed=0 if episode == 0 else None)
        assert observation[:2].tolist() == [info["drawn"]["start_time"]] * 2
        seen.add(observation[0])
        env.step(ACTION)
    assert seen == {1.0, 20.0}
    env.close()


def test_an_episode_may_get_another_one(sun):
    for make in (Sun, lambda path: vector(partial(Sun, path), 2)):
        env = make(sun())
        options = {"model_parameters": {"start_time": 5.0}}
        observation, info = env.reset(seed=0, options=options)
        assert np.atleast_2d(observation)[:, :2].tolist() == [[5.0, 5.0]] * len(
            np.atleast_2d(observation)
        )
        assert np.all(info["drawn"]["start_time"] == 5.0)
        assert np.all(env.reset(seed=0)[1]["drawn"]["start_time"] != 5.0)
        env.close()


@pytest.mark.parametrize("isolation", ["none", "process"])
def test_all_parts_of_a_system_begin_at_the_same_time(sun, isolation):
    parts = {"a": sun(), "b": sun("ModelExchange", 3)}
    system = FMUSystem(parts, ["a.sine -> b.u"], step_size=STEP)
    own = {"model_output_names": ["b.x", "a.now", "b.now"], "model_parameters": {}}
    env = Sun(system, **own, isolation=isolation, start_time=[0.0, 7.5, 100.25])
    seen = set()
    for seed in range(20):
        start = env.reset(seed=seed)[1]["drawn"]["start_time"]
        env.step(ACTION)
        assert env.time == env.out["a.now"] == env.out["b.now"] == start + STEP
        seen.add(start)
    assert seen == {0.0, 7.5, 100.25}
    env.close()


def test_it_survives_the_trial(sun, monkeypatch):
    monkeypatch.delenv("FMUGYM_PROBE")
    env = Sun(sun("ModelExchange"))
    assert env.reset_method == "restore"
    observation, info = env.reset(seed=0)
    assert observation[1] == info["drawn"]["start_time"]
    assert env.save_state().method == "state"
    env.close()


@pytest.mark.parametrize(
    ("config", "fact"),
    [
        ({"start_time": "noon"}, "start_time.*'noon'"),
        ({"start_time": []}, "at least one"),
        ({"start_time": ["noon"]}, "start_time.*noon"),
        ({"start_time": {"low": 0}}, "start_time.*'distribution'"),
        ({"start_time": [1.0, np.inf]}, "inf"),
        ({"episode_variables": {"start_time": 0.0}}, "'start_time'.*episode variable"),
        ({"start_time": [0.0, 9.9], "stop_time": 10.0}, "stop_time = 10.0.*9.9"),
    ],
)
def test_mistakes_are_named(sun, config, fact):
    with pytest.raises(ConfigError, match=fact):
        Sun(sun(), **config)


# Declared tasks

DAY = 86400.0
TASK = {
    "time_step": "6h",
    "episode_length": "2d",
    "data": {"day": {"values": list(range(365)), "step": "1d", "interpolation": "previous"}},
    "setpoints": {"T": {"schedule": {"06:00": 21, "22:00": 17}}},
    "variables": {"u": {"min": -1, "max": 1}},
    "agent": {
        "actions": ["u"],
        "observations": ["day", "T", "days", "hours"],
        "forecast": {"of": "day", "horizon": "1d", "step": "1d"},
    },
    "expressions": {"days": "now / 86400", "hours": "clock / 3600"},
    "reward": "day + 0.001 * sine",
    "config": {"solver": "rk4", "max_step": 3600},
}


@pytest.fixture
def task(sun):
    return TASK | {"fmu": str(sun("ModelExchange"))}


def first_days(env, episodes):
    """The days of the FMU at the beginning of episodes."""
    days = set()
    for episode in range(episodes):
        observation, info = env.reset(seed=0 if episode == 0 else None)
        require_day(observation, env.time / DAY)
        if "start_time" in info["drawn"]:
            assert env.time == info["drawn"]["start_time"] + env.warm_up_steps * DAY / 4
        days.add(round(env.time / DAY, 6))
    env.close()
    return days


def require_day(observation, day):
    """Data, schedule, forecast and clock follow the FMU's own time."""
    is_day = 0.25 <= day % 1 < 22 / 24
    expected = [int(day) % 365, 21 if is_day else 17, day, day * 24, int(day + 1) % 365]
    np.testing.assert_allclose(observation, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("start_time", "days"),
    [
        ("01-15", {14}),
        ("2024-03-01 12:00", {59.5}),
        ("3d 6h", {3.25}),
        (0.5 * DAY, {0.5}),
        (["01-02", "03-01", "3d"], {1, 59, 3}),
        ({"from": "12-30", "to": "01-02"}, {363, 364, 0, 1}),
        ({"distribution": "choice", "values": [0, 21600]}, {0, 0.25}),
    ],
)
def test_the_fmu_begins_at_a_time_of_the_year(task, start_time, days):
    assert first_days(fmugym.load(task | {"start_time": start_time}), 40) == days


def test_a_season_leaves_scenarios_out_with_its_warm_up(task, load):
    season = task | {
        "start_time": {"from": "01-01", "to": "01-15", "exclude": "scenarios"},
        "scenarios": {"peak": {"start": "01-06", "length": "3d"}},
        "warm_up": "1d",
    }
    # Days 5, 6 and 7 are left out. A warm-up of a day and an episode of two days follow.
    assert first_days(fmugym.load(season), 70) == {1, 2, 3, *range(9, 16)}
    env = load(season, scenario="peak")
    assert first_days(env, 2) == {5}
    early = season | {"scenarios": {"peak": {"start": "01-01", "length": "2d"}}}
    env = load(early, scenario="peak")
    observation, _ = env.reset(seed=0)
    assert env.time == 365 * DAY  # an FMU begins at 0 or later
    require_day(observation, 365)
    assert [env.step([0.0])[3] for _ in range(8)] == [False] * 7 + [True]


def test_scenarios_of_a_task_with_a_clock_move_only_the_clock(task, load):
    scenarios = {"clock": "02-01", "scenarios": {"peak": {"start": "01-06", "length": "1d"}}}
    env = load(task | scenarios | {"start_time": "3d"}, scenario="peak")
    observation, _ = env.reset(seed=0)
    assert (observation[0], env.time) == (5, 3 * DAY)


def test_recorded_times_are_those_of_the_fmu(task, tmp_path):
    task = task | {"start_time": ["01-03", "01-09"], "warm_up": {"period": "1d", "controller": 0}}
    env = RecordSeries(fmugym.load(task), path=tmp_path / "run.csv")
    times = []
    for _ in range(4):
        env.reset(seed=0 if not times else None)
        times.append(env.unwrapped.time)
        for _ in range(2):
            env.step(np.zeros(1, np.float32))
            times.append(env.unwrapped.time)
    env.close()
    with open(tmp_path / "run.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["time [s]"]) for row in rows] == times
    assert len(set(times)) == 6


@in_turn(
    {
        "hooks": ["arrays", "one by one"],
        "warm_up": [{"period": "12h", "controller": 0.5, "cache": True}, 0],
    }
)
def test_vectors_of_tasks_equal_single_ones(task, hooks, warm_up):
    task = task | {"start_time": {"from": "10-01", "to": "10-03", "step": "6h"}}
    task |= {"warm_up": warm_up} if warm_up else {}
    assert require_same_alone(partial(fmugym.load, task), 25, way=hooks)


@pytest.mark.parametrize(
    ("change", "fact"),
    [
        ({"start_time": []}, "start_time.*at least one"),
        ({"start_time": ["01-01", "02-01"], "clock": 0}, "start_time.*clock"),
        ({"start_time": {"from": "01-01", "to": "01-02", "exclude": "peek"}}, "start_time"),
        (
            {
                "start_time": {"distribution": "uniform", "low": 0, "high": 1},
                "warm_up": {"period": "6h", "controller": 1, "cache": True},
            },
            "warm_up.cache.*start_time",
        ),
    ],
)
def test_mistakes_in_tasks_are_placed(task, change, fact):
    with pytest.raises(TaskError, match=f"^{fact}"):
        fmugym.load(task | change)
