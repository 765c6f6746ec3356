"""Rollouts of candidates that assume other data, outputs and random numbers than their episode."""

from functools import partial

import numpy as np
import pytest
from letters import wide
from test_rollouts import WAYS as OF_CLASSES
from test_rollouts import rows_of
from test_snapshots import Track
from ways import in_way

import fmugym
from fmugym import ConfigError

WAYS = {"expressions": {}, **OF_CLASSES}
HOUR, DT, STEPS, N = 3600.0, 600.0, 20, 3
TIMES = np.arange(24) * HOUR
OWN = np.linspace(0.0, 0.023, 24)
OTHER = 0.01 + 0.005 * np.sin(np.arange(24.0))
WHEEL = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": DT,
    "clock": 2 * HOUR,
    "parameters": {
        **dict.fromkeys(("g", "b", "c"), 0.0),
        **dict.fromkeys(("m", "l"), 1.0),
        "body": "point_mass",
        "max_step": DT,
        "tau_max": 1.0,
        "theta_dot_max": 1e6,
    },
}
"""A wheel without friction: 1 N m makes it 1 rad/s faster in each second."""


def spinning(first=OWN, second=OWN, interpolation="linear", **sensor):
    """The wheel in a wind, beside prices."""
    rows = {"step": HOUR, "interpolation": interpolation}
    return {
        **WHEEL,
        "episode_length": "6h",
        "variables": {"q_dot": sensor, "push": {"min": -1, "max": 1}},
        "data": {
            "wind": {"values": np.array(first).tolist()} | rows,
            "price": {"values": np.array(second).tolist()} | rows,
        },
        "inputs": {"tau": "push + wind"},
        "agent": {
            "actions": ["push"],
            "observations": ["q_dot", "wind", "price"],
            "forecast": {"of": ["wind"], "horizon": "2h", "step": "1h"},
        },
        "reward": "q_dot + 10 * wind - price - 0.1 * previous(q_dot)",
    }


def pushes(seed=0):
    return np.random.default_rng(seed).uniform(-0.01, 0.01, (N, STEPS, 1)).astype(np.float32)


def root(task, steps=2):
    """A snapshot in the middle of an episode."""
    with fmugym.load(task) as env:
        env.reset(seed=5)
        for _ in range(steps):
            env.step([0.005])
        return env.save_state(), env.state[0], env.unwrapped.variables["clock"] + steps * DT


@pytest.fixture
def environments(vector_of):
    def make(task, way="expressions", count=2):
        return vector_of(lambda: fmugym.load(task), count, **WAYS[way])

    return make


def value_at(time, values, interpolation):
    if interpolation == "linear":
        return np.interp(time, TIMES, values)
    return values[np.searchsorted(TIMES, time, side="right") - 1]


class TestData:
    @pytest.mark.parametrize("way", WAYS)
    @pytest.mark.parametrize("interpolation", ["linear", "previous"])
    def test_in_closed_form(self, way, interpolation, environments):
        snapshot, speed, now = root(spinning(interpolation=interpolation))
        envs = environments(spinning(interpolation=interpolation), way)
        found = envs.rollout(snapshot, pushes(), data={"wind": (TIMES, OTHER)})
        wind = partial(value_at, values=OTHER, interpolation=interpolation)
        price = partial(value_at, values=OWN, interpolation=interpolation)
        after = 0.0 if interpolation == "linear" else 1.0  # what holds is that of the step
        for index, candidate in enumerate(pushes()[..., 0].astype(float)):
            fast, t = speed, now
            for step, push in enumerate(candidate):
                before, fast = fast, fast + DT * (push + wind(t))
                t += DT
                judged = t - after
                reward = fast + 10 * wind(judged) - price(judged) - 0.1 * before
                assert found.rewards[index, step] == pytest.approx(reward, abs=1e-9)
                seen = [fast, wind(t), price(t), wind(t + HOUR), wind(t + 2 * HOUR)]
                assert found.observations[index, step] == pytest.approx(seen, abs=1e-5)

    @pytest.mark.parametrize("way", WAYS)
    @pytest.mark.parametrize("interpolation", ["linear", "previous"])
    def test_that_is_true_changes_no_bit(self, way, interpolation, environments):
        task = spinning(interpolation=interpolation)
        snapshot, *_ = root(task)
        envs = environments(task, way)
        plain = envs.rollout(snapshot, pushes())
        true = {"wind": (TIMES, OWN), "price": (TIMES, OWN)}
        assert rows_of(envs.rollout(snapshot, pushes(), data=true)) == rows_of(plain)
        later = {"wind": (TIMES[10:] - 24 * HOUR, OWN[10:])}  # the same hours of the day before
        assert rows_of(envs.rollout(snapshot, pushes(), data=later)) != rows_of(plain)
        assert rows_of(envs.rollout(snapshot, pushes())) == rows_of(plain)

    @pytest.mark.parametrize("way", WAYS)
    def test_equals_an_environment_whose_data_that_is(self, way, environments):
        """A policy, too, which reads forecasts; of two equal series one is exchanged."""
        snapshot, *_ = root(spinning())
        envs, same = environments(spinning(), way), environments(spinning(OTHER), way)

        def policy(observations):
            return (0.1 * observations[:, 3:4] - 1e-4 * observations[:, :1]).astype(np.float32)

        for actions, horizon in ((pushes(), None), (policy, STEPS)):
            other = {wide("wind"): (TIMES, OTHER)}  # the same name in other letters
            found = envs.rollout(snapshot, actions, horizon=horizon, data=other)
            assert rows_of(found) == rows_of(same.rollout(snapshot, actions, horizon=horizon))

    @pytest.mark.parametrize(
        ("data", "reason"),
        [
            ({"wnd": (TIMES, OWN)}, "'wind'"),
            (dict.fromkeys(("wind", wide("wind")), (TIMES, OWN)), "'data': 'wind' and .* one name"),
            ({"wind": OWN}, "times and values of 'wind'"),
            ({"wind": (TIMES, OWN[1:])}, "times and values of 'wind'"),
            ({"wind": ([], [])}, "times and values of 'wind'"),
            ({"wind": (TIMES[::-1], OWN)}, "times of 'wind' must rise"),
            ({"wind": (TIMES, OWN * np.nan)}, "finite"),
            ({"wind": ([0.0, 86400.0], [1.0, 2.0])}, "less than the period of 86400 s"),
            ("wind", "'data'"),
        ],
    )
    def test_that_is_refused(self, data, reason, environments):
        envs = environments(spinning())
        with pytest.raises(ConfigError, match=reason):
            envs.rollout(root(spinning())[0], pushes(), data=data)

    def test_of_a_task_without_any(self, vector_of):
        envs = vector_of(Track, 2)
        envs.reset(seed=0)
        with pytest.raises(ConfigError, match="'wind'"):
            envs.rollout(None, np.zeros((2, 3, 1)), data={"wind": ([0.0], [1.0])})


class TestOffsets:
    @pytest.mark.parametrize("way", WAYS)
    def test_shift_what_hooks_read_but_not_the_fmu(self, way, environments):
        snapshot, *_ = root(spinning())
        envs = environments(spinning(), way)
        plain = envs.rollout(snapshot, pushes())
        found = envs.rollout(snapshot, pushes(), offsets={wide("q_dot"): 2.5})
        assert found.rewards == pytest.approx(plain.rewards + 2.5 - 0.25, abs=1e-12)
        shift = found.observations - plain.observations
        assert shift[..., 0] == pytest.approx(np.full((N, STEPS), 2.5), abs=1e-5)
        assert not shift[..., 1:].any()
        assert rows_of(envs.rollout(snapshot, pushes())) == rows_of(plain)

    @pytest.mark.parametrize(
        ("offsets", "reason"),
        [
            ({"q_dt": 1.0}, "'q_dot'"),
            (dict.fromkeys(("q_dot", wide("q_dot")), 1.0), "'offsets': 'q_dot' and .* one name"),
            ({"q_dot": "much"}, "offset of 'q_dot'"),
            (1.0, "'offsets'"),
        ],
    )
    def test_that_are_refused(self, offsets, reason, environments):
        envs = environments(spinning())
        with pytest.raises(ConfigError, match=reason):
            envs.rollout(root(spinning())[0], pushes(), offsets=offsets)


class TestSeed:
    @pytest.mark.parametrize("way", WAYS)
    def test_gives_all_candidates_other_noise(self, way, environments):
        task = spinning(noise=0.5)
        snapshot, *_ = root(task)
        envs = environments(task, way, N)
        same = np.repeat(pushes()[:1], N, axis=0)
        true = envs.rollout(snapshot, same)
        found = envs.rollout(snapshot, same, seed=7)
        noise = found.observations[..., 0] - true.rewards - 0.0
        assert np.abs(np.diff(true.observations[..., 0], axis=0)).max() == 0.0
        assert found.rewards.tolist() == true.rewards.tolist()  # rewards know no noise
        assert np.abs(np.diff(found.observations[..., 0], axis=0)).max() == 0.0
        assert not (found.observations[..., 0] == true.observations[..., 0]).any()
        assert noise.std() > 0.1
        again = envs.rollout(snapshot, same, seed=7)
        assert rows_of(again) == rows_of(found)
        other = envs.rollout(snapshot, same, seed=8)
        assert not (other.observations[..., 0] == found.observations[..., 0]).any()

    def test_is_that_of_an_environment(self, environments):
        """Without other draws, the noise is that of an episode with this seed."""
        task = spinning(noise=0.5)
        with fmugym.load(task) as env:
            env.reset(seed=11)
            other = env.save_state()
            env.reset(seed=4)
            here = env.save_state()
        envs = environments(task, count=1)
        assert rows_of(envs.rollout(here, pushes()[:1], seed=11)) == rows_of(
            envs.rollout(other, pushes()[:1])
        )

    def test_that_is_refused(self, environments):
        envs = environments(spinning())
        with pytest.raises(ConfigError, match="seed must be"):
            envs.rollout(root(spinning())[0], pushes(), seed=-1)


@pytest.mark.parametrize("way", WAYS)
def test_costs_are_those_of_the_infos(way, environments):
    costs = {"effort": "abs(push)", "speed": {"expr": "max(q_dot, 0)", "limit": 9}}
    task = spinning() | {"costs": costs, "episode_length": "2h"}
    snapshot, *_ = root(task)
    envs = environments(task, way)
    found = envs.rollout(snapshot, pushes())
    with fmugym.load(task) as env:
        for index, candidate in enumerate(pushes()):
            env.restore_state(snapshot)
            for step, action in enumerate(candidate[: found.lengths[index]]):
                paid = env.step(action)[-1]["costs"]
                assert {name: one[index, step] for name, one in found.costs.items()} == paid
    assert found.lengths.tolist() == [10] * N
    assert not found.costs["effort"][:, 10:].any()


@pytest.mark.parametrize("told", [3.0, {"of": "all"}, {"of": [1.0, 2.0, 3.0]}])
def test_costs_are_no_others_that_a_class_tells(told, vector_of):
    class Telling(Track):
        def _get_info(self):
            return {"costs": told}

    envs = vector_of(in_way("one by one", Telling), 2)
    envs.reset(seed=0)
    assert envs.rollout(None, np.zeros((2, 3, 1), np.float32)).costs == {}


def test_costs_that_are_not_told_are_zero(vector_of):
    """Two candidates tell none at all, and the other two from the third step on."""

    class Paying(Track):
        def _get_info(self):
            return {"costs": {"push": 2.0}} if self.action > 0 and self.step_count > 2 else {}

    envs = vector_of(in_way("one by one", Paying), 2)
    envs.reset(seed=0)
    start = envs.save_state(0)
    pushed = np.repeat([0.0, 0.0, 0.01, 0.01], 4).reshape(4, 4, 1).astype(np.float32)
    found = envs.rollout(start, pushed).costs["push"]
    assert found.tolist() == [[0.0] * 4] * 2 + [[0.0, 0.0, 2.0, 2.0]] * 2


@pytest.mark.parametrize("way", WAYS)
def test_present_episodes_and_their_streams_go_on_as_before(way, make_envs):
    task = spinning(noise=0.5)
    make = partial(fmugym.load, task)
    envs, others = (make_envs(make, 2, **WAYS[way]) for _ in range(2))
    for both in (envs, others):
        both.reset(seed=1)
        both.step([[0.001]] * 2)
    before = envs.save_state()
    assumed = {"data": {"wind": (TIMES, OTHER)}, "offsets": {"q_dot": 1.0}, "seed": 3}
    envs.rollout(None, pushes()[:2], **assumed)
    assert envs.save_state() == before
    for _ in range(40):  # beyond the end of the episodes
        step, same = envs.step([[0.001]] * 2), others.step([[0.001]] * 2)
        assert step[0].tolist() == same[0].tolist()
        assert step[1].tolist() == same[1].tolist()
