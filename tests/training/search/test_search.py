"""The search for policies: its steps against known optima, and what policies and evaluators do."""

import itertools
import json
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import values_tools
from gymnasium import spaces
from scipy import linalg
from ways import in_way

import fmugym
from fmugym import ConfigError
from fmugym.control import PID, controller_of
from fmugym.control import tuning as covariance
from fmugym.control.candidate_evaluation import (
    MOST_STEPS,
    CandidateEvaluator,
    CandidateScores,
    CeilingError,
)
from fmugym.control.controller_parsing import search_of
from fmugym.control.surrogate.surrogate import SurrogatePool
from fmugym.control.tuning import CMA, CandidateSearch
from fmugym.deployment.export.decision import decision_of
from fmugym.environment.vector import FMUVectorEnv
from fmugym.environment.vector.expression_task import Expressions
from fmugym.records.evaluation import HELD_OUT_SEED
from fmugym.training import search_training
from fmugym.training.search import surrogate_search
from fmugym.training.search.policy import (
    LIMIT,
    POLICY_FILE,
    ResidualAgent,
    ResidualPolicy,
    flattened_observations,
    require_numbers,
    scale_of,
)
from fmugym.training.search.policy_search import VALIDATION, Search
from fmugym.training.search.probe import MOST_PROBED, Probe
from fmugym.training.search.surrogate_search import TwinSearch
from fmugym.training.search_training import Searching

AXES = np.linalg.qr(np.random.default_rng(7).normal(size=(6, 6)))[0]
STRETCH = 10.0 ** np.linspace(0, 2, 6)  # lengths of axes, so that variances differ by 1e4
OPTIMUM = np.array([1.0, -2.0, 0.5, 3.0, 0.0, -1.0])


def sphere(points):
    return ((points - OPTIMUM) ** 2).sum(axis=1)


def ellipsoid(points):
    return (((points - OPTIMUM) * STRETCH) ** 2).sum(axis=1)


def turned_ellipsoid(points):
    return (((points - OPTIMUM) @ AXES * STRETCH) ** 2).sum(axis=1)


def rosenbrock(points):
    """Its minimum is where all numbers are 1."""
    head, tail = points[:, :-1], points[:, 1:]
    return (100 * (tail - head**2) ** 2 + (1 - head) ** 2).sum(axis=1)


def made(separable=False, seed=0, population=12, **limits):
    """A search for six numbers, which are many for the separable form."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(covariance, "MOST_CORRELATED", 5 if separable else 6)
        return CMA(np.zeros(6), 0.5, population, np.random.default_rng(seed), **limits)


class Other:
    """The implementation of the package ``cmaes``, with the methods of ours."""

    def __init__(self, separable=False, seed=0):
        cmaes = pytest.importorskip("cmaes", reason="needs cmaes: the extra test")
        kind = cmaes.SepCMA if separable else cmaes.CMA
        self.cma = kind(mean=np.zeros(6), sigma=0.5, population_size=12, seed=seed)

    def ask(self):
        self.points = np.array([self.cma.ask() for _ in range(12)])
        return self.points

    def tell(self, order):
        self.cma.tell([(self.points[i], float(rank)) for rank, i in enumerate(order)])


class TestCMA:
    @pytest.mark.parametrize("function", [sphere, turned_ellipsoid, rosenbrock, ellipsoid])
    def test_is_about_as_fast_as_another_implementation(self, function):
        """The other one has negative weights too, with which it needs a few rounds less."""
        separable = function is ellipsoid
        ours = [rounds_of(function, made(separable, seed)) for seed in range(3)]
        others = [rounds_of(function, Other(separable, seed)) for seed in range(3)]
        assert 0.6 < np.median(ours) / np.median(others) < 1.5

    def test_its_first_step_is_that_of_another_implementation(self):
        cma, other = made(), Other()
        other.points = cma.ask()
        order = np.array([4, 8, 0, 11, 7, 3, 10, 6, 2, 9, 1, 5])  # of a pair, one comes in time
        cma.tell(order)
        other.tell(order)
        assert cma.mean == pytest.approx(other.cma.mean, rel=1e-12)

    @pytest.mark.parametrize("separable", [False, True])
    def test_its_limits_hold(self, separable):
        """A slope without an end would let mean and steps grow for ever."""
        cma = made(separable, population=32, largest=3.0, growth=4.0)
        sizes, steps = [], []
        for _ in range(200):
            points = cma.ask()
            steps.append(np.sqrt(np.mean((points - cma.mean) ** 2)))
            cma.tell(np.argsort(points[:, 0]))
            sizes.append(np.sqrt(np.mean(cma.mean**2)))
        assert max(sizes) == pytest.approx(3.0)
        assert 1.0 < max(steps) < 3.0
        assert cma.sigma == 2.0

    @pytest.mark.parametrize("separable", [False, True])
    def test_half_of_the_candidates_mirror_the_others(self, separable):
        """No direction is preferred, and steps are those of normal numbers."""
        cma = made(separable, population=7)
        steps = np.array([cma.ask() / cma.sigma for _ in range(500)])
        assert steps.shape == (500, 7, 6)
        assert steps[:, 4:] == pytest.approx(-steps[:, :3], abs=1e-12)
        assert np.cov(steps.reshape(-1, 6).T) == pytest.approx(np.eye(6), abs=0.1)

    def test_mirrored_candidates_help_against_noise(self):
        """Independent ones need more rounds."""

        class Independent(CMA):
            def ask(self):
                self._white = self._rng.standard_normal(self._shape)
                self._steps = self._white @ self._root
                return self.mean + self.sigma * self._steps

        def reached(kind, seed):
            cma, noise = kind(np.zeros(24), 0.5, 24, np.random.default_rng(seed)), seed + 100
            rng, target = np.random.default_rng(noise), np.linspace(-1, 1, 24)
            for _ in range(60):
                values = ((cma.ask() - target) ** 2).sum(axis=1)
                cma.tell(np.argsort(values + values.std() * rng.standard_normal(24)))
            return np.sum((cma.mean - target) ** 2)

        ours, others = ([reached(kind, i) for i in range(8)] for kind in (CMA, Independent))
        assert np.mean(ours) < 0.8 * np.mean(others)

    @pytest.mark.parametrize(("n", "population"), [(6, 8), (24, 32), (100, 32)])
    def test_chance_does_not_shorten_the_steps(self, n, population):
        """It would if both candidates of a pair counted, which cancel."""
        lengths = []
        for seed in range(20):
            rng = np.random.default_rng(seed)
            cma = CMA(np.zeros(n), 1.0, population, rng)
            for _ in range(100):
                cma.ask()
                cma.tell(rng.permutation(population))
            lengths.append(np.log(cma.sigma))
        assert abs(np.mean(lengths)) < 1.0

    def test_of_a_pair_the_better_candidate_counts(self):
        cma = made(population=6)
        points = cma.ask()
        cma.tell(np.array([3, 0, 1, 4, 2, 5]))
        log = np.log(3.5) - np.log([1, 2, 3])
        assert cma.mean == pytest.approx(log / log.sum() @ points[[3, 1, 2]], rel=1e-12)


def rounds_of(function, cma):
    """How many rounds it takes until one candidate is as good as the minimum."""
    for rounds in range(1, 1000):
        values = function(cma.ask())
        if values.min() < 1e-9:
            return rounds
        cma.tell(np.argsort(values))
    raise AssertionError("not found")


FALLING = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "episode_length": "2s",
    "variables": {"tau": {"min": -0.1, "max": 0.1}},
    "agent": {"actions": ["tau"], "observations": ["theta", "theta_dot"]},
    "parameters": {"q_0": "pi", "theta_0": {"distribution": "uniform", "low": 0.1, "high": 1}},
    "reward": "-theta**2 - 0.1 * theta_dot**2",
    "costs": {"effort": {"expr": "abs(tau)", "limit": 1.0}, "turns": "abs(theta_dot)"},
    "terminated": "abs(theta) > 1.45",
}


class Branching(fmugym.TaskEnv):
    """A hook that can only be called for one environment at a time."""

    def __init__(self, **options):
        super().__init__(FALLING, **options)

    def _is_truncated(self):
        return bool(self.step_count < 0)


class Sorted(Branching):
    """A hook that can be called for all environments at once, but not be compiled."""

    def _is_truncated(self):
        return np.sort(np.array(self.state), axis=0)[1] < -1e9


def load(document=FALLING, **changes):
    task = {key: value for key, value in (document | changes).items() if value is not None}
    return partial(fmugym.load, fmugym.Task.from_dict(task))


@pytest.fixture
def env():
    with closing(load()()) as found:
        yield found


def pid(rows):
    return PID("theta", 0.0, kp=rows[:, 0], td=0.2)


GAINS = np.array([[-0.3], [0.0], [0.05], [0.2], [1.0]])
SEEDS = [3, 700_000, 41]


def played(make_env, make=pid, numbers=GAINS, seeds=SEEDS, **arguments):
    with closing(CandidateEvaluator(make_env, **arguments)) as evaluator:
        return evaluator.play(make, numbers, seeds), evaluator


class TestArena:
    def test_its_results_are_those_of_single_environments(self, env):
        costs = ["turns", "effort"]
        outcome, _ = played(load(), limits=dict.fromkeys(costs, 1.0))
        assert outcome.returns.shape == (5, 3)
        assert outcome.costs.shape == (5, 3, 3)
        assert not outcome.costs[..., 2].any()  # no faults
        lengths = set()
        for row, (gain,) in enumerate(GAINS):
            controller = PID("theta", 0.0, kp=gain, td=0.2).bind(env)
            for column, seed in enumerate(SEEDS):
                controller.reset()
                total, cost, length = episode(env, controller, seed, costs)
                lengths.add(length)
                assert outcome.returns[row, column] == total
                assert outcome.costs[row, column, :2].tolist() == cost
        assert len(lengths) > 3  # some have ended before others

    def test_environments_are_not_opened_again_and_again(self):
        """Where there may be no more of them, a few episodes play in many environments."""
        opened = []
        make = load()
        with closing(CandidateEvaluator(lambda: opened.append(1) or make(), 15)) as evaluator:
            for _ in range(3):
                evaluator.play(pid, GAINS, SEEDS)
                evaluator.play(pid, GAINS[:1], SEEDS[:1])
            first = len(opened)
            evaluator.play(pid, GAINS, SEEDS)
            assert len(opened) == first
            assert evaluator.jobs.shape == (15,)

    def test_a_second_play_is_like_the_first(self):
        with closing(CandidateEvaluator(load())) as evaluator:
            first = evaluator.play(pid, GAINS, SEEDS)
            evaluator.play(pid, GAINS[:1], [1])
            assert evaluator.play(pid, GAINS, SEEDS).returns.tolist() == first.returns.tolist()

    @pytest.mark.parametrize("most_envs", [512, 7])
    @pytest.mark.parametrize("kind", ["arrays", "one by one", "process"])
    def test_no_episode_is_stepped_beyond_its_end(self, kind, most_envs):
        """The FMUs do as many steps as the episodes in single environments have."""
        make = {
            "compiled": load(),
            "arrays": Sorted,
            "one by one": Branching,
            "process": partial(fmugym.load, fmugym.Task.from_dict(FALLING), isolation="process"),
        }[kind]
        lengths = []
        with closing(make()) as env:
            for (gain,) in GAINS:
                controller = PID("theta", 0.0, kp=gain, td=0.2).bind(env)
                for seed in SEEDS:
                    controller.reset()
                    lengths.append(episode(env, controller, seed)[2])
        made = []

        def kept():
            made.append(make())
            return made[-1]

        with closing(CandidateEvaluator(kept, most_envs, limits={"effort": 1.0})) as evaluator:
            outcome = evaluator.play(pid, GAINS, SEEDS)
            stepped = sum(pool.health()["steps"].sum() for pool in pools_of(made))
        assert stepped == evaluator.steps == sum(lengths)
        assert len(set(lengths)) > 3
        expected, _ = played(load(), limits={"effort": 1.0})
        assert outcome.returns == pytest.approx(expected.returns, rel=1e-12)
        assert outcome.costs == pytest.approx(expected.costs, rel=1e-12)

    def test_the_ceiling_holds(self):
        with closing(CandidateEvaluator(load(terminated=None))) as evaluator:
            evaluator.ceiling = 15 * 40 + 70
            evaluator.play(pid, GAINS, SEEDS)
            with pytest.raises(CeilingError, match="670"):
                evaluator.play(pid, GAINS, SEEDS)
            assert evaluator.steps == 15 * 44

    def test_episodes_without_an_end_are_stopped(self):
        endless = load(terminated=None, episode_length=None, reward=1, costs=None)
        outcome, _ = played(endless, numbers=GAINS[:1], seeds=[0])
        assert outcome.returns.item() == MOST_STEPS == 10_000
        outcome, evaluator = played(endless, numbers=GAINS[:2], seeds=[0], most_steps=7)
        assert (outcome.returns.ravel().tolist(), evaluator.steps) == ([7, 7], 14)


def episode(env, controller, seed, costs=()):
    """The return of an episode in a single environment, its costs, and how long it was."""
    observation, info = env.reset(seed=seed)
    total, cost, steps, over = 0.0, [0.0] * len(costs), 0, False
    while not over:
        action = controller.act(observation, info)
        observation, reward, terminated, truncated, info = env.step(action)
        total, over = total + reward, terminated or truncated
        cost = [before + info["costs"][name] for before, name in zip(cost, costs, strict=True)]
        steps += 1
    return total, cost, steps


NOTHING = np.empty(0)


def test_costs_beyond_their_limits_come_first():
    """Returns 5, 9, 7, 1; two costs, of which the second has no room at all; no faults."""
    costs = np.array([[[1.0, 0.0, 0]], [[4.0, 0.0, 0]], [[2.0, 0.5, 0]], [[2.0, -1.0, 0]]])
    returns = np.array([[5.0], [9.0], [7.0], [1.0]])
    merits = CandidateScores(returns, costs, {"a": 2.0, "b": 0.0}, NOTHING).merits
    assert merits == [(0.0, 5.0), (-1.0, 9.0), (-0.5, 7.0), (0.0, 1.0)]
    assert sorted(range(4), key=merits.__getitem__, reverse=True) == [0, 3, 2, 1]
    without = CandidateScores(returns, costs[..., 2:], {}, NOTHING).merits
    assert [merit for _, merit in without] == [5, 9, 7, 1]


def test_what_is_no_number_comes_last():
    """Neither a NaN among the rewards nor one among the costs has an order."""
    returns = np.array([[np.nan, 9.0], [-1e9, -1e9], [7.0, 7.0], [1.0, 1.0]])
    costs = np.array([[[0.0, 0]] * 2, [[9.0, 0]] * 2, [[np.nan, 0], [0, 0]], [[0.0, 0]] * 2])
    merits = CandidateScores(returns, costs, {"a": 1.0}, NOTHING).merits
    for order in itertools.permutations(range(4)):
        assert sorted(order, key=merits.__getitem__, reverse=True)[:2] == [3, 1]


def test_a_search_among_what_is_no_number_goes_on():
    """All its first candidates reach NaN."""
    rng = np.random.default_rng(0)
    candidate_search = CandidateSearch(CMA(np.zeros(2), 1.0, 8, rng), ResidualAgent("own"), 2)
    for most in (np.nan, 1.0):
        for _ in range(5):
            candidate_search.play(Field(most), range(2))
        candidate_search.validate(Field(most), range(2))
        assert candidate_search.best is not None
    assert np.isfinite(candidate_search.merit).all()
    assert candidate_search.best.weights.shape == (2,)


@pytest.mark.parametrize("on_fault", ["truncate", "terminate"])
def test_faults_come_last_where_they_are_no_end(on_fault):
    """A reward that is NaN ends the episode, which saves it the other ones, all of them negative.

    Where faults are an end, their reward counts. Here it is the lowest of the episode.
    """
    changes = {"reward": "log(0.05 - tau) - 9", "config": {"on_fault": on_fault}, "costs": None}
    weights = np.array([[1.0], [-1.0], [-0.5]])
    outcome, _ = played(load(**changes), ResidualAgent("own", acting=1), weights)
    is_end = on_fault == "terminate"
    assert outcome.costs[..., -1].tolist() == [[0.0 if is_end else 1.0] * 3, [0.0] * 3, [0.0] * 3]
    order = sorted(range(3), key=outcome.merits.__getitem__, reverse=True)
    assert order[0 if is_end else -1] == 0


class Stub:
    """An environment, or N of them, of which only the spaces are there."""

    unphysical_keys = ()
    observation_names = action_names = None
    config = SimpleNamespace(time_step=0.1)

    def __init__(self, observed, acting, count=None, names=None):
        self.observation_names = names
        if count is None:
            self.observation_space, self.action_space = observed, acting
        else:
            self.single_observation_space, self.single_action_space = observed, acting
            self.num_envs = count

    @property
    def unwrapped(self):
        return self


NUMBERS = spaces.Box(-2.0, 2.0, (3,), np.float32)
GOAL = spaces.Dict(
    {
        "observation": NUMBERS,
        "achieved_goal": spaces.Box(-1, 1, (1,), np.float32),
        "desired_goal": spaces.Box(-1, 1, (1,), np.float32),
    }
)
OBSERVED = [
    NUMBERS,
    spaces.Box(0, 1, (), np.float64),
    spaces.Discrete(4),
    spaces.Discrete(3, start=-1),
    spaces.MultiDiscrete([2, 3], start=[5, 0]),
    spaces.MultiBinary(3),
    spaces.Tuple((spaces.Discrete(2, start=1), NUMBERS)),
    GOAL,
    spaces.Dict({"b": spaces.Tuple((NUMBERS, spaces.Discrete(3))), "a": spaces.MultiBinary(2)}),
]


@pytest.mark.parametrize("space", OBSERVED, ids=repr)
def test_rows_are_those_of_gymnasium(space):
    batch = gym.vector.utils.batch_space(space, 5)
    batch.seed(1)
    observations = batch.sample()
    singles = list(gym.vector.utils.iterate(batch, observations))
    expected = [spaces.flatten(space, one).astype(float).tolist() for one in singles]
    assert flattened_observations(space, observations, 5).tolist() == expected
    assert [flattened_observations(space, one, 1)[0].tolist() for one in singles] == expected
    assert {len(row) for row in expected} == {spaces.flatdim(space)}
    require_numbers(space, NUMBERS)


@pytest.mark.parametrize(
    ("observed", "acting", "facts"),
    [
        (spaces.Box(0, 255, (8, 8, 3), np.uint8), NUMBERS, ["(8, 8, 3)", "--algorithm"]),
        (spaces.Dict({"a": NUMBERS, "b": spaces.Text(5)}), NUMBERS, ["Text", "--algorithm"]),
        (spaces.Tuple((spaces.Sequence(NUMBERS),)), NUMBERS, ["Sequence", "--algorithm"]),
        (NUMBERS, spaces.Box(-np.inf, np.inf, (1,)), ["inf", "limits", "'min'", "'bounds'"]),
        (NUMBERS, spaces.Box(0, np.inf, (1,)), ["inf", "limits"]),
        (NUMBERS, spaces.Dict({"a": NUMBERS}), ["Dict", "Box"]),
    ],
    ids=["image", "text", "sequence", "unbounded", "half bounded", "dict"],
)
def test_spaces_without_a_search(observed, acting, facts):
    with pytest.raises(ConfigError) as caught:
        require_numbers(observed, acting)
    for fact in facts:
        assert fact in str(caught.value)
    assert "\n" not in str(caught.value)


FORMS = [  # for 3 observations and 2 outputs
    ResidualAgent("linear", None, 3, 2),
    ResidualAgent("linear with history", None, 3, 2, history=True),
    ResidualAgent("network", None, 3, 2, hidden=5),
    ResidualAgent("network with history", None, 3, 2, hidden=4, history=True),
    ResidualAgent("constant action", None, 0, 2),
]
ACTING = [
    spaces.Box(np.array([-2.0, 10.0]), np.array([4.0, 30.0]), dtype=np.float64),
    spaces.Discrete(3, start=2),
    spaces.MultiDiscrete([2, 4], start=[0, -1]),
    spaces.MultiBinary(2),
]


UNSCALED = np.array([[0.0], [1.0]])


def policy_of(form, weights, scale=UNSCALED, baseline=None):
    return ResidualPolicy(baseline, replace(form, weights=weights, scale=scale))


def sized(form, env):
    """The form for an environment."""
    bare = ResidualPolicy(None).bind(env)
    return replace(form, observed=form.observed and len(bare.names), acting=bare.acting)


def policy_with(form, env_of_one, seed=0, rows=None, baseline=None):
    """One with random weights, for one environment or for ``rows``."""
    form, rng = sized(form, env_of_one), np.random.default_rng(seed)
    shape, count = (form.size,) if rows is None else (rows, form.size), form.features
    scale = np.stack([rng.normal(size=count), rng.uniform(0.5, 2.0, count)])
    return policy_of(form, rng.normal(size=shape), scale if count else UNSCALED, baseline)


def features_of(policy):
    """What the network of a policy for one environment got for its last decision."""
    count = policy.agent.features
    return policy.moments[1 : 1 + count, 0].copy()


class TestPolicy:
    def test_without_weights_it_is_the_controller(self, env):
        policy, controller = ResidualPolicy(pid(GAINS[3:4])).bind(env), pid(GAINS[3:4]).bind(env)
        assert episode(env, policy, 4) == episode(env, controller, 4)
        assert ResidualPolicy(None).bind(env).act(np.zeros(2)) == 0.0

    def test_corrections_are_halves_of_the_range_and_end_at_its_limits(self):
        env = Stub(NUMBERS, ACTING[0])
        form = FORMS[0]
        weights = np.zeros((4, 2))
        weights[3] = 2.0 * np.array([0.5, -0.25])  # constants; 2 is the root of 4 inputs
        policy = policy_of(form, weights.ravel()).bind(env)
        assert policy.act(np.zeros(3)).tolist() == [1.0 + 0.5 * 3, 20.0 - 0.25 * 10]
        weights[0] = [2.0, 2.0]
        policy = policy_of(form, weights.ravel()).bind(env)
        assert policy.act(np.array([0.3, 0, 0])).tolist() == pytest.approx([3.4, 20.5])
        assert policy.act(np.array([9.0, 0, 0])).tolist() == [4.0, 30.0]
        assert policy.act(np.array([-9.0, 0, 0])).tolist() == [-2.0, 10.0]

    def test_a_controller_is_corrected_within_the_limits(self):
        """It asks for more than there is; the correction begins at the limit."""
        env = Stub(spaces.Box(-9, 9, (1,)), spaces.Box(0.0, 2.0, (1,), np.float64), names=("T",))
        weights = np.array([0.0, -0.25 * np.sqrt(2)])
        policy = policy_of(
            ResidualAgent("own", None, 1, 1), weights, baseline=PID("T", 8.0, kp=1.0)
        ).bind(env)
        assert policy.act(np.zeros(1)) == pytest.approx(2.0 - 0.25)
        assert policy.act(np.array([7.5])) == pytest.approx(0.5 - 0.25)
        assert policy.act(np.array([7.9])) == 0.0

    def test_scaled_features_have_a_limit(self):
        env = Stub(spaces.Box(-1e9, 1e9, (1,)), spaces.Box(-1e3, 1e3, (1,), np.float64))
        scale = np.array([[5.0], [2.0]])
        weights = np.array([np.sqrt(2) / 1e3, 0.0])
        policy = policy_of(ResidualAgent("own", None, 1, 1), weights, scale).bind(env)
        seen = [policy.act(np.array([value])).item() for value in (8.0, 1e9, -1e9)]
        assert seen == pytest.approx([1.5, LIMIT, -LIMIT])

    @pytest.mark.parametrize("form", [form for form in FORMS if form.history])
    def test_history_by_hand(self, form):
        """The network gets each number, its change, its leaky mean, and the last action."""
        env, seen, actions = Stub(NUMBERS, ACTING[0]), [], []
        policy = policy_with(form, env).bind(env)
        observations = np.random.default_rng(2).uniform(-2, 2, (4, 3))
        for row in observations:
            actions.append(policy.act(row))
            seen.append(features_of(policy))
        leaky, before, last = observations[0], observations[0], np.zeros(2)
        for row, action, features in zip(observations, actions, seen, strict=True):
            leaky = leaky + 0.05 * (row - leaky)
            expected = np.concatenate([row, row - before, leaky, last])
            assert features == pytest.approx(expected, rel=1e-12)
            before, last = row, (action - [1.0, 20.0]) / [3.0, 10.0]
        policy.reset()
        policy.act(observations[3])
        assert features_of(policy).tolist() == [*observations[3], 0, 0, 0, *observations[3], 0, 0]

    def test_history_of_choices_is_one_hot(self):
        env, seen = Stub(NUMBERS, ACTING[2]), []
        policy = policy_with(FORMS[1], env).bind(env)
        action = policy.act(np.ones(3))
        seen.append(features_of(policy))
        policy.act(np.ones(3))
        seen.append(features_of(policy))
        told = [float(action[0] == n) for n in (0, 1)] + [
            float(action[1] == n) for n in range(-1, 3)
        ]
        assert [one[-6:].tolist() for one in seen] == [[0.0] * 6, told]

    def test_a_network_by_hand(self):
        env = Stub(NUMBERS, ACTING[0])
        form = FORMS[2]
        policy = policy_with(form, env).bind(env)
        mean, divisor = policy.agent.scale
        observation = np.array([0.5, -1.0, 1.5])
        values = np.clip((observation - mean) / divisor, -LIMIT, LIMIT)
        weights, widths = policy.agent.weights, [3, 5, 2]
        for before, after in itertools.pairwise(widths):
            part, weights = np.split(weights, [(before + 1) * after])
            layer = part.reshape(before + 1, after) / np.sqrt(before + 1)
            values = np.append(values, 1.0) @ layer
            values = np.tanh(values) if weights.size else values
        expected = np.clip([1.0, 20.0] + values * [3.0, 10.0], [-2, 10], [4, 30])
        assert policy.act(observation) == pytest.approx(expected, rel=1e-12)

    @pytest.mark.parametrize("acting", ACTING, ids=repr)
    @pytest.mark.parametrize("form", FORMS, ids=lambda form: form.name)
    def test_many_environments_are_as_single_ones(self, form, acting):
        """Bit for bit, also if episodes begin at different times."""
        one, many = Stub(GOAL, acting), Stub(GOAL, acting, 6)
        together = policy_with(form, one, rows=6).bind(many)
        batch = gym.vector.utils.batch_space(GOAL, 6)
        batch.seed(3)
        steps = [batch.sample() for _ in range(7)]
        begins = np.random.default_rng(0).random((7, 6)) < 0.2
        actions = []
        for observations, mask in zip(steps, begins, strict=True):
            together.reset(mask)
            actions.append(together.act(observations))
        for i in range(6):
            alone = policy_of(together.agent, together.agent.weights[i], together.agent.scale).bind(
                one
            )
            for observations, mask, expected in zip(steps, begins, actions, strict=True):
                if mask[i]:
                    alone.reset()
                action = alone.act({name: rows[i] for name, rows in observations.items()})
                assert action.tolist() == expected[i].tolist()
                assert acting.contains(action.astype(acting.dtype)) or acting.shape == ()
        shared = policy_with(form, one).bind(many)
        alone = policy_with(form, one).bind(one)
        first = shared.act(steps[0])
        for i in range(6):
            alone.reset()
            action = alone.act({name: rows[i] for name, rows in steps[0].items()})
            assert action.tolist() == first[i].tolist()

    def test_all_choices_can_be_made(self):
        """The largest output of each part chooses; constants alone decide here."""
        env = Stub(NUMBERS, ACTING[2])
        chosen = set()
        for seed in range(40):
            chosen.add(tuple(policy_with(FORMS[4], env, seed).bind(env).act(np.zeros(3)).tolist()))
        assert chosen == {(a, b) for a in (0, 1) for b in (-1, 0, 1, 2)}


class Blocked(fmugym.envs.CartPoleEnv):
    """Left, nothing and right; where the cart is, only one side is allowed, and later nothing."""

    def _get_action_space(self):
        return spaces.Discrete(3)

    def _get_inputs(self):
        return 1.0 * self.action - 1.0

    def action_masks(self):
        is_right, is_late = self.state[0] > 0, self.step_count >= 5
        return np.array([is_right & (not is_late), is_late, (not is_right) & (not is_late)])


class BlockedPair(Blocked):
    """Two levels more, of which the first one is allowed at the beginning only."""

    def _get_action_space(self):
        return spaces.MultiDiscrete([3, 2], start=[0, 4])

    def _get_inputs(self):
        return 1.0 * self.action[0] - 1.0

    def action_masks(self):
        return np.append(super().action_masks(), [self.step_count < 2, True])


class TestMasks:
    @pytest.mark.parametrize("kind", [Blocked, BlockedPair])
    @pytest.mark.parametrize("hooks", ["arrays", "one by one"])
    def test_are_respected_where_choices_are_made(self, kind, hooks):
        chosen, allowed = [], []
        with closing(kind()) as one, closing(FMUVectorEnv(in_way(hooks, kind), 6)) as envs:
            policy = policy_with(FORMS[1], one, rows=6).bind(envs)
            observations, _ = envs.reset(seed=3)
            for _ in range(8):
                actions = policy.act(observations)
                chosen.append(actions.reshape(6, -1) - policy.space.start)
                allowed.append(np.stack(envs.call("action_masks")))
                observations, *_ = envs.step(actions)
            for index in range(6):
                alone = policy_of(
                    policy.agent, policy.agent.weights[index], policy.agent.scale
                ).bind(one)
                observation, _ = one.reset(seed=3 + index)
                for actions in chosen:
                    action = alone.act(observation)
                    assert (action - policy.space.start).ravel().tolist() == actions[index].tolist()
                    observation, *_ = one.step(action)
        chosen, allowed = np.array(chosen), np.array(allowed)
        first = 0
        for part, count in enumerate(map(len, policy.choices)):
            masks = allowed[:, :, first : first + count]
            assert np.take_along_axis(masks, chosen[:, :, part, None], axis=2).all()
            first += count
        assert len(np.unique(chosen[:5, :, 0])) == 2

    def test_a_policy_that_needs_them_is_not_exported(self):
        with closing(Blocked()) as env, pytest.raises(ConfigError, match="masks"):
            decision_of(env, policy_with(FORMS[0], env))


def pools_of(envs):
    """The pools of those environments that are open; several may share one."""
    pools = {}
    for env in envs:
        with suppress(fmugym.SimulationError):
            pools[id(env.pool)] = env.pool
    return pools.values()


class Followed:
    """A policy whose features are kept."""

    def __init__(self, policy, seen):
        self.policy, self.seen = policy, seen

    def act(self, *observed):
        action = self.policy.act(*observed)
        self.seen.append(features_of(self.policy))
        return action


class Chain(fmugym.FMUEnv):
    """Four integrators in a row: what a constant action adds up to grows without an end."""

    A, B = np.eye(4, k=1), np.eye(4)[:, 3:]

    def __init__(self, path):
        sizes = {"n": 4, "m": 1, "r": 1, "C": [[1.0, 0.0, 0.0, 0.0]]}
        start = {"A": self.A.tolist(), "B": self.B.tolist(), "x_0": [1.0, 0.0, 0.0, 0.0]}
        config = {"time_step": 0.1, "max_episode_steps": 100, "model_parameters": sizes | start}
        names = {"model_input_names": "u", "model_output_names": "x"}
        super().__init__(path, config | names)

    def _get_action_space(self):
        return spaces.Box(-1.0, 1.0, (1,), np.float32)

    def _is_done(self):
        return False

    def _reward_policy(self):
        return -(self.out["x"][0] ** 2)


def test_a_process_that_constants_drive_away_can_be_controlled(tmp_path):
    """Beside the feedback of states that is best but for the limits of the action.

    If large constants alone told the scales, these would be 30 times too large, and the search
    would lose more than twice as much as the feedback of states.
    """
    make = partial(Chain, values_tools.state_space_fmu(tmp_path / "S.fmu"))
    blocks = np.block([[Chain.A, Chain.B], [np.zeros((1, 5))]])
    a, b = np.split(linalg.expm(0.1 * blocks)[:4], [4], axis=1)
    costs = linalg.solve_discrete_are(a, b, np.diag([1.0, 0.0, 0.0, 0.0]), [[0.1]])
    gains = np.linalg.solve(b.T @ costs @ b + 0.1, b.T @ costs @ a)
    with closing(make()) as env:
        feedback = SimpleNamespace(act=lambda x, _: np.clip(-gains @ x, -1, 1))
        by_feedback, _, _ = episode(env, feedback, 0)
    search = Search(Probe.of(make, 256, print), 0)
    with closing(CandidateEvaluator(make)) as evaluator:
        while search.rounds < 60:
            search.advance(evaluator)
    assert search.ahead.merit[1] > 1.7 * by_feedback


def test_a_scale_is_that_of_all_features(env):
    """Of the steps of all episodes until their ends, whatever plays beside them."""
    observed = []
    form = ResidualAgent("own", None, 2, 1, history=True)
    rows = np.array([np.zeros(form.size)] * 4)
    rows[:, -1] = np.sqrt(8) * np.array([-1.0, -0.3, 0.2, 0.9])
    make = form
    scales = []
    for most_envs in (3, 512):
        with closing(CandidateEvaluator(load(), most_envs)) as evaluator:
            moments = evaluator.play(make, rows, SEEDS, has_moments=True).moments.sum(axis=(0, 1))
            scales.append(scale_of(moments))
    assert np.array_equal(*scales)
    for weights in rows:
        policy = make(weights).bind(env)
        for seed in SEEDS:
            policy.reset()
            episode(env, Followed(policy, observed), seed)
    features = np.array(observed)
    assert len(features) == moments[0] < 40 * 12
    expected = np.stack([features.mean(axis=0), features.std(axis=0)])
    assert scales[0] == pytest.approx(expected)


def test_constants_are_not_made_larger():
    seen = np.array([[-7.0, 1e-4, 0.0, x] for x in (-2.0, 2.0)])
    sums = [2.0, *seen.sum(axis=0), *(seen**2).sum(axis=0)]
    mean, divisor = scale_of(np.array(sums)).tolist()
    assert mean == [-7.0, 1e-4, 0.0, 0.0]
    assert divisor == [7.0, 1.0, 1.0, 2.0]


def test_a_linear_policy_can_be_extended_by_a_history():
    env = Stub(NUMBERS, ACTING[0])
    linear, longer = FORMS[:2]
    first = policy_with(linear, env)
    scale = [np.resize(part, longer.features) for part in first.agent.scale]
    (weights,) = longer.extended(first.agent.weights[None])
    second = policy_of(longer, weights, scale).bind(env)
    first.bind(env)
    for row in np.random.default_rng(2).uniform(-2, 2, (4, 3)):
        assert second.act(row) == pytest.approx(first.act(row), rel=1e-12)


class Field:
    """An evaluator in whose place candidates reach what their numbers add up to, up to a limit."""

    def __init__(self, most):
        self.most = most

    def play(self, make, numbers, seeds, has_moments=False):
        returns = np.repeat(np.minimum(numbers.sum(axis=1), self.most)[:, None], len(seeds), axis=1)
        seen = np.ones((*returns.shape, 1 + 2 * 7))
        return CandidateScores(returns, np.zeros((*returns.shape, 1)), {}, seen)


class Needle(Field):
    """All reach nothing, but for chance, unless they are near to a point."""

    def play(self, make, numbers, seeds, has_moments=False):
        near = np.maximum(0.0, 1.0 - np.linalg.norm(numbers - 1.0, axis=1))
        chance = np.random.default_rng(list(seeds)).normal(0.0, 1e-3, (len(numbers), len(seeds)))
        returns = near[:, None] + chance
        return CandidateScores(returns, np.zeros((*returns.shape, 1)), {}, NOTHING)


def test_a_search_goes_on_from_a_candidate_that_is_better_than_their_mean():
    """The mean alone finds the point from two thirds of the seeds."""
    found = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        cma = CMA(np.zeros(4), 1.0, 32, rng, largest=30.0, growth=5.0)
        candidate_search, field = CandidateSearch(cma, ResidualAgent("own"), 4), Needle(1.0)
        for _ in range(12):
            for _ in range(5):
                candidate_search.play(field, rng.integers(1000, size=4))
            candidate_search.validate(field, range(VALIDATION, VALIDATION + 8))
        found.append(candidate_search.merit[1] > 0.5)
    assert sum(found) >= 25


class Noisy:
    """Stands for an evaluator and for a search whose candidates are always as different."""

    mean = np.zeros(1)

    def __init__(self, noise):
        self.noise, self.rng = noise, np.random.default_rng(0)

    def ask(self):
        return self.rng.normal(size=(400, 1))

    def tell(self, order):
        pass

    def play(self, make, numbers, seeds, has_moments=False):
        returns = numbers + self.rng.normal(0.0, self.noise, (400, len(seeds)))
        return CandidateScores(returns, np.zeros((*returns.shape, 1)), {}, NOTHING)


@pytest.mark.parametrize(
    ("noise", "expected"),
    [(0.0, 4), (np.sqrt(2), 4), (np.sqrt(6), 8), (np.sqrt(24), 32), (1e9, 64)],
    ids=["none", *(f"correlations of {one}" for one in (0.5, 0.25, 0.08)), "noise only"],
)
def test_episodes_become_twice_as_many_while_halves_of_them_hardly_correlate(noise, expected):
    """The means of two episodes correlate by 1 / (1 + variance / 2), those of four by more."""
    field = Noisy(noise)
    candidate_search = CandidateSearch(field, None, 4)
    for _ in range(120):
        candidate_search.play(field, range(candidate_search.episodes))
    assert candidate_search.episodes == expected


GIVEN = ResidualAgent("given", "pid of=theta setpoint=0 kp=1")
CONSTANT = ResidualAgent("constant action", acting=1)


def search_of_agents(*agents):
    """A search with ready agents for two observations and one action."""
    return Search(Probe({}, ResidualAgent("linear", None, 2, 1), agents, {}, 40, False, 0.0, 40), 0)


def test_only_the_best_controller_is_tuned_to_the_end():
    class Uneven(Field):
        def play(self, make, numbers, seeds, has_moments=False):
            outcome = super().play(make, numbers, seeds)
            return outcome._replace(returns=outcome.returns + 100.0 * ("better" in make.name))

    text = "pid of=theta setpoint=0 kp=1..2"
    names = "one", "better", "another"
    search, field = search_of_agents(*(ResidualAgent(name, text) for name in names)), Uneven(1.0)
    while search.tuning:
        search.advance(field)
    assert [one.rounds for one in search.controllers] == [5, 20, 5]


def test_a_search_that_gains_nothing_ends():
    search, field = search_of_agents(CONSTANT), Field(-1e-9)
    while not search.is_over:
        search.advance(field)
        assert search.rounds < 2000
    assert search.rounds > 100
    assert search.winner(field) is search.baseline.best


def names_of(search):
    found = [one.best for one in search.policies if one.gained]
    return [search.baseline.best.name, *(one.name for one in found)]


def test_a_history_enters_when_a_correction_gains_nothing_without_it():
    search, field = search_of_agents(GIVEN), Field(1.0)
    while not search.policies:
        search.advance(field)
    first = search.policies[0]
    while first.rounds - first.gained < 14:
        search.advance(field)
    assert [one.make.name for one in search.policies] == ["given + linear", "linear", "network"]
    while "given + linear with history" not in names_of(search):
        search.advance(field)
    assert search.rounds < 300


def test_what_the_search_has_come_to_may_win_without_an_earlier_gain():
    class Late(Field):
        """Only the last validation shows what lies beyond the limit."""

        def play(self, make, numbers, seeds, has_moments=False):
            self.most = 1e9 if min(seeds) > VALIDATION else 1.0
            own = numbers if numbers.size else np.zeros((1, 1))
            return super().play(make, own, seeds)

    search, field = search_of_agents(GIVEN), Late(1.0)
    while search.rounds < 60:
        search.advance(field)
    leader = max(search.policies[:2], key=lambda one: one.cma.mean.sum())
    assert leader.best.weights.sum() < leader.cma.mean.sum()
    assert np.array_equal(search.winner(field).weights, leader.cma.mean)


def test_who_is_worse_than_the_baseline_has_no_more_than_its_share():
    class Uneven(Field):
        def play(self, make, numbers, seeds, has_moments=False):
            outcome = super().play(make, numbers, seeds)
            alone = make.text is None and make.observed > 0
            return outcome._replace(returns=outcome.returns - 1e6 * alone)

    search, field = search_of_agents(GIVEN), Uneven(1e9)
    for _ in range(200):
        search.advance(field)
    rounds = {one.make.name: one.rounds for one in search.policies}
    assert {rounds["linear"], rounds["network"]} <= {19, 20}
    assert rounds["given + linear"] + rounds.get("given + linear with history", 0) > 140


class TestAgent:
    NAMES = "theta", "theta_dot"

    @pytest.fixture(params=FORMS, ids=lambda form: form.name)
    def agent(self, request, env):
        policy, space = policy_with(request.param, env), str(env.action_space)
        text = "pid of=theta setpoint=0 kp=0.2 td=0.2"
        return replace(policy.agent, text=text, names=self.NAMES, actions=space)

    def test_saved_and_loaded_it_acts_as_before(self, agent, tmp_path):
        agent.save(tmp_path)
        loaded = ResidualAgent.load(tmp_path)
        assert replace(loaded, weights=(), scale=(), names=self.NAMES) == replace(
            agent, weights=(), scale=()
        )
        with closing(CandidateEvaluator(load())) as evaluator:
            expected = agent.play(evaluator, SEEDS)
            assert loaded.play(evaluator, SEEDS).returns.tolist() == expected.returns.tolist()

    def test_damaged_files(self, agent, tmp_path):
        """Shorter ones, others, and those with one wrong byte, which may be where nobody looks."""
        agent.save(tmp_path)
        path = tmp_path / POLICY_FILE
        content = path.read_bytes()
        rng = np.random.default_rng(0)
        lengths = rng.integers(len(content), size=40)
        for damaged in (b"", b"PK", b"text", bytes(len(content)), *(content[:n] for n in lengths)):
            path.write_bytes(damaged)
            with pytest.raises(ConfigError, match=str(tmp_path)):
                ResidualAgent.load(tmp_path)
        for place in rng.integers(len(content), size=60):
            wrong = bytes([content[place] ^ 255])
            path.write_bytes(content[:place] + wrong + content[place + 1 :])
            with suppress(ConfigError):
                ResidualAgent.load(tmp_path)

    ODD = (
        *(None, True, -1, 2.5, 1e400, 10**30, "x", "pid of=3", "nan", [], {}, [[]], ["1", "2"]),
        *([1, 2], [[1], [2, 3]], {"a": 1}, [None], 2**31, "mpc", "pid of=q setpoint=0..1"),
        *([[0.0], [0.0]], ["theta"], ["theta", 3], "a" * 100_000),
    )

    def test_files_with_other_values_are_refused_or_act(self, agent, env, tmp_path):
        """Values of another type or size: each of them in the place of each fact."""
        agent.save(tmp_path)
        facts, refused = json.loads((tmp_path / POLICY_FILE).read_text()), 0
        observation, _ = env.reset(seed=0)
        for name, value in itertools.product(facts, self.ODD):
            (tmp_path / POLICY_FILE).write_text(json.dumps({**facts, name: value}))
            try:
                ResidualAgent.load(tmp_path).policy().bind(env).act(observation)
            except ConfigError as error:
                refused += bool(str(error))
        assert refused > len(self.ODD) * len(facts) / 2

    @pytest.mark.parametrize(
        ("change", "fact"),
        [
            ({"text": {"pid": 1}}, "text must be a text, got {'pid': 1}"),
            ({"names": [1, 2]}, "each of the names must be a text, got 1"),
            ({"observed": "2"}, "observed must be an integer"),
            ({"scale": [[0.0, 0.0], [1.0, 0.0]]}, "divisors"),
            ({"weights": ["1", "1", "1"]}, "weights must be numbers"),
        ],
        ids=str,
    )
    def test_facts_of_other_types(self, change, fact, tmp_path):
        numbers = {"weights": np.ones(3), "scale": np.ones((2, 2))}
        ResidualAgent("own", None, 2, 1, names=self.NAMES, **numbers).save(tmp_path)
        path = tmp_path / POLICY_FILE
        path.write_text(json.dumps(json.loads(path.read_text()) | change))
        with pytest.raises(ConfigError) as caught:
            ResidualAgent.load(tmp_path)
        assert fact in str(caught.value)
        assert str(tmp_path) in str(caught.value)

    @pytest.mark.parametrize(
        "change",
        [
            {"weights": np.ones(2)},
            {"scale": np.ones((2, 1))},
            {"weights": np.full(3, np.nan)},
        ],
        ids=str,
    )
    def test_arrays_of_another_size(self, change, tmp_path):
        facts = {"weights": np.ones(3), "scale": np.ones((2, 2))}
        ResidualAgent("own", None, 2, 1, names=self.NAMES, **facts).save(tmp_path)
        assert ResidualAgent.load(tmp_path).weights.tolist() == [1, 1, 1]
        ResidualAgent("own", None, 2, 1, names=self.NAMES, **facts | change).save(tmp_path)
        with pytest.raises(ConfigError, match=r"finite numbers.*\(3,\), \(2, 2\)"):
            ResidualAgent.load(tmp_path)

    @pytest.mark.parametrize(
        ("names", "actions", "facts"),
        [
            (("theta", "speed"), None, ["observes speed", "also gives theta_dot"]),
            (("theta", "theta_dot", "T"), None, ["observes T"]),
            (("theta_dot", "theta"), None, ["order"]),
            (NAMES, "Discrete(2)", ["Discrete(2)", "Box(-0.1, 0.1"]),
        ],
    )
    def test_another_task_is_told_by_what_differs(self, names, actions, facts, env):
        agent = ResidualAgent("own", None, names=names, actions=actions or str(env.action_space))
        with pytest.raises(ConfigError, match="another task") as caught:
            agent.policy().bind(env)
        for fact in facts:
            assert fact in str(caught.value)


class TestRanges:
    def test_of_negative_numbers(self):
        """They are searched on a logarithmic scale, too, and texts have their sign."""
        search = search_of("pid of=T setpoint=-3..-1 kp=-5..-0.05 ti=10..2000 offset=-1..1")
        assert search.ranges == {
            "setpoint": fmugym.Uniform(1, 3),
            "kp": fmugym.LogUniform(0.05, 5),
            "ti": fmugym.LogUniform(10, 2000),
            "offset": fmugym.Uniform(-1, 1),
        }
        found = {"setpoint": 2.0, "kp": 0.25, "ti": 100.0, "offset": -0.5}
        assert search.text(found) == "pid of=T setpoint=-2 kp=-0.25 ti=100 offset=-0.5"
        controller = controller_of(search.text(found))
        assert vars(controller) == vars(search.make(**found))
        assert (controller.kp, controller.setpoint) == (-0.25, -2.0)
        made = search.make(**{name: np.array([value] * 2) for name, value in found.items()})
        assert made.kp.tolist() == [-0.25, -0.25]
        assert search.at_an_end(found | {"kp": 4.99}) == ["kp"]

    def test_where_a_number_is_needed(self):
        text = "pid of=theta setpoint=0 kp=-5..-0.05"
        with closing(load(controllers={"pi": text})()) as env:
            assert env.task.document["controllers"] == {"pi": text}
        warm_up = {"period": "1s", "controller": "pi"}
        with pytest.raises(ConfigError, match=r"controllers.pi.*kp=-5\.\.-0\.05 is a range"):
            load(controllers={"pi": text}, warm_up=warm_up)()

    @pytest.mark.parametrize(
        "text", ["pid of=T setpoint=0 kp=-0.05..-5", "pid of=T kp=1..2", "pit kp=1..2"]
    )
    def test_in_a_task_are_checked(self, text):
        with pytest.raises(ConfigError, match="controllers"):
            load(controllers={"pi": text})()


CONTROLLERS = {"lazy": "schedule 00:00=0", "pi": "pid of=theta setpoint=0 kp=0.01..2 td=0.2"}
ROUNDS = 60  # enough for the tuning of one controller, and for the leaders among the policies


def searched(folder, document=FALLING, *, told=None, resume=False, rounds=ROUNDS, **options):
    """The facts of a short search; ``options`` are its own or of the task."""
    fields = {name for name in options if name in Searching.__dataclass_fields__}
    changes = {name: value for name, value in options.items() if name not in fields}
    make_env = load(document, **{"controllers": CONTROLLERS, **changes})
    given = {"episodes": 3} | {name: options[name] for name in fields if options[name] is not None}
    given |= {} if told is None else {"tell": told.append}
    scenarios = {"unseen episodes": make_env}
    return Searching(make_env, scenarios, folder, rounds=rounds, **given).run(resume=resume)


def content(folder):
    return (folder / POLICY_FILE).read_bytes()


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "agent"


@pytest.fixture(scope="module")
def usual(tmp_path_factory):
    """The folder of a search, and its facts."""
    folder = tmp_path_factory.mktemp("search") / "agent"
    return folder, searched(folder)


def rewards(facts, name):
    return facts["test"][name]["rewards"]["unseen episodes"]


class TestSearch:
    def test_it_beats_the_controllers(self, usual):
        folder, facts = usual
        agents = list(facts["test"])
        assert set(agents) > {"lazy", "tuned pi"}
        assert agents[0] == facts["agent"] == ResidualAgent.load(folder).name
        assert agents[1] == facts["baseline"]
        assert "better than" in facts["verdict"]
        assert "chance" not in facts["verdict"]
        assert facts["rounds"] == ROUNDS

    def test_its_agent_reaches_what_it_tells(self, usual, env):
        """In single environments, by the file alone."""
        folder, facts = usual
        told = rewards(facts, facts["agent"])
        policy = ResidualAgent.load(folder).policy().bind(env)
        for seed, expected in enumerate(told, HELD_OUT_SEED):
            policy.reset()
            assert episode(env, policy, seed)[0] == expected

    def test_the_same_rounds_give_the_same_agent_with_one_thread(self, usual, folder, monkeypatch):
        monkeypatch.setattr("fmugym.pool.native_pool.available_processors", lambda: 1)
        searched(folder)
        assert content(folder) == content(usual[0])

    def test_another_seed_gives_another_agent(self, usual, folder):
        searched(folder, seed=1)
        assert content(folder) != content(usual[0])

    def test_training_validation_and_test_never_share_episodes(self, folder, monkeypatch):
        calls, play = [], CandidateEvaluator.play
        monkeypatch.setattr(
            CandidateEvaluator,
            "play",
            lambda evaluator, *rest, **more: calls.append(rest) or play(evaluator, *rest, **more),
        )
        searched(folder)
        _, *calls = calls  # the first one was a look at the task
        several = [(len(numbers), list(seeds)) for _, numbers, seeds, *_ in calls]
        training = {seed for count, seeds in several if count > 2 for seed in seeds}
        other = {seed for count, seeds in several if count <= 2 for seed in seeds}
        test = set(range(HELD_OUT_SEED, HELD_OUT_SEED + 3))
        assert len(training) > 100
        assert 0 <= min(training) < max(training) < VALIDATION == 500_000
        assert test < other
        assert VALIDATION <= min(other - test) < max(other - test) < HELD_OUT_SEED == 1_000_000
        firsts = [min(seeds) for count, seeds in several if count <= 2]
        assert firsts == sorted(firsts)  # the test is played once, at the end

    def test_equal_episodes_are_played_once(self, folder, monkeypatch):
        counts, told, play = [], [], CandidateEvaluator.play

        def spy(evaluator, make, numbers, seeds, **options):
            counts.append(len(seeds))
            return play(evaluator, make, numbers, seeds, **options)

        monkeypatch.setattr(CandidateEvaluator, "play", spy)
        parameters = {"q_0": "pi", "theta_0": 0.5}
        facts = searched(folder, parameters=parameters, told=told)
        assert counts[0] > 1  # how it knows, and how quick a step is
        assert set(counts[2:]) == {1}
        assert any("one episode" in line for line in told)
        assert len(rewards(facts, facts["agent"])) == 1

    def test_a_baseline_that_cannot_be_beaten_stays(self, folder):
        told = []
        best = {"best": "schedule 00:00=0.05", "lazy": "schedule 00:00=0"}
        facts = searched(folder, reward="-abs(tau - 0.05)", controllers=best, told=told)
        assert facts["agent"] == facts["baseline"] == next(iter(facts["test"])) == "best"
        assert [line for line in told if "nothing was found that beats best" in line]
        agent = ResidualAgent.load(folder)
        assert (agent.text, agent.acting) == ("schedule 00:00=0.05", 0)

    def test_limits_of_costs_are_kept(self, folder):
        """The most torque is best, and half of it is allowed: 40 steps of 0.05 Nm."""
        costs = {"effort": {"expr": "abs(tau)", "limit": 2.0}}
        changes = {"reward": "tau", "costs": costs, "controllers": None, "terminated": None}
        facts = searched(folder, rounds=60, **changes)
        reached = facts["test"][facts["agent"]]
        assert reached["mean_costs"]["effort"] <= 2.0
        assert reached["total_reward"] > 1.8
        assert "of at most 2" in facts["verdict"]

    def test_without_controllers_guesses_are_tuned(self, folder):
        """Of a pendulum that hangs."""
        told = []
        hanging = {
            "parameters": {"q_0": 0.0},
            "variables": {"tau": {"min": -0.03, "max": 0.03}},
            "agent": {"actions": ["tau"], "observations": ["q", "q_dot"]},
            "reward": "-abs(q - 0.3)",
            "terminated": None,
        }
        facts = searched(folder, rounds=32, controllers=None, told=told, **hanging)
        assert told[0] == "to be beaten: PI (to be tuned), P (to be tuned)"
        assert facts["baseline"] in ("tuned PI", "tuned P")

    def test_what_runs_away_has_no_guess(self, folder):
        told = []
        falling = {"reward": "-abs(theta - 0.1)", "controllers": None, "told": told}
        facts = searched(folder, rounds=8, **falling)
        assert "no controller is guessed: constant actions end episodes in 8 steps or less" in told
        assert facts["baseline"] == "constant action"

    def test_without_any_constant_actions_are_tuned(self, folder):
        told = []
        facts = searched(folder, controllers=None, told=told, rounds=8)
        assert "constant action" in told[0]
        assert facts["baseline"] == "constant action"

    def test_controllers_of_one_action_do_not_act_on_two(self, folder):
        """A warm-up may need them all the same."""
        told = []
        two = {
            "variables": dict.fromkeys(("tau", "spare"), FALLING["variables"]["tau"]),
            "agent": FALLING["agent"] | {"actions": ["tau", "spare"]},
            "controllers": CONTROLLERS | {"still": 0},
            "warm_up": {"period": "50ms", "controller": {"tau": "lazy"}},
        }
        facts = searched(folder, **two, told=told, rounds=8)
        left_out = [line.split(": ")[1] for line in told[:3]]
        assert left_out == [*two["controllers"]]
        assert told[0].startswith("left out: lazy: Schedule gives one number, but the action")
        assert facts["baseline"] == "constant action"

    def test_few_rounds_give_what_they_have_come_to(self, folder):
        """Also before the first validation."""
        one = {"pi": CONTROLLERS["pi"]}
        facts = searched(folder, rounds=3, controllers=one)
        assert facts["agent"] == facts["baseline"] == "tuned pi"
        assert facts["rounds"] == 3
        assert ResidualAgent.load(folder).text.startswith("pid of=theta")

    def test_few_rounds_find_no_less_than_what_is_there(self, folder):
        """A controller that is ready takes part from the beginning."""
        good = {"best": "schedule 00:00=0.05", "pi": CONTROLLERS["pi"]}
        changes = {"reward": "-abs(tau - 0.05)", "controllers": good}
        facts = searched(folder, rounds=6, **changes)
        assert facts["agent"] == "best"


class Budget:
    """Counts the steps of all environments until the test begins; each takes 0.1 ms."""

    def __init__(self, monkeypatch):
        self.steps, self.is_open = 0, True
        step, step_around = Expressions.step, Expressions.step_around
        judge = search_training.judge

        def count(task, steps):
            is_fmu = not isinstance(task.episodes.pool, SurrogatePool)
            self.steps += steps * self.is_open * is_fmu

        def counted(task, actions, may_restart=False):
            count(task, len(actions))
            return step(task, actions, may_restart)

        def counted_around(task, actions, resting):
            count(task, len(actions) - np.count_nonzero(resting))
            return step_around(task, actions, resting)

        def judged(*arguments):
            self.is_open = False
            return judge(*arguments)

        monkeypatch.setattr(Expressions, "step", counted)
        monkeypatch.setattr(Expressions, "step_around", counted_around)
        monkeypatch.setattr(search_training, "judge", judged)
        monkeypatch.setattr(search_training, "monotonic", lambda: 1e-4 * self.steps)
        monkeypatch.setattr(Probe, "round_time", lambda *_: 0.0)


class TestBudget:
    @pytest.mark.parametrize("envs", [512, 11])
    @pytest.mark.parametrize(("ceiling", "part"), [(5_000, 0.1), (40_000, 0.7)])
    def test_steps_are_a_ceiling_of_all_but_the_test(
        self, ceiling, part, envs, folder, monkeypatch
    ):
        """With 5,000 steps, a surrogate plays, and what it predicts may be right at once."""
        budget = Budget(monkeypatch)
        limits = {"rounds": np.inf, "minutes": 60, "steps": ceiling, "envs": envs}
        facts = searched(folder, **limits)
        assert part * ceiling < facts["steps"] <= ceiling
        assert 0 <= facts["steps"] - budget.steps < MOST_PROBED

    def test_what_fits_a_ceiling_depends_on_no_time(self, tmp_path, monkeypatch):
        """Neither on the time of a step, nor on the environments.

        The round that does not fit is left after fewer or more steps.
        """
        facts = []
        for seconds, envs in ((100.0, 512), (0.0, 512), (0.0, 11)):
            clock = itertools.count(step=seconds)
            monkeypatch.setattr("fmugym.control.candidate_evaluation.perf_counter", clock.__next__)
            folder = tmp_path / str(len(facts))
            limits = {"rounds": np.inf, "minutes": 1e9, "steps": 20_000, "envs": envs}
            facts.append(searched(folder, **limits) | {"steps": None})
        assert facts[0] == facts[1] == facts[2]

    def test_a_ceiling_that_is_too_low_is_refused(self, folder, monkeypatch):
        budget = Budget(monkeypatch)
        with pytest.raises(ConfigError, match=r"199 steps.*200"):
            searched(folder, steps=199)
        assert budget.steps == 0
        assert not (folder).exists()

    @pytest.mark.parametrize("seconds", [2.0, 5.0])
    def test_minutes_are_the_time_of_all_but_the_test(self, seconds, tmp_path, monkeypatch):
        """And the rounds that fit repeat what was found."""
        with monkeypatch.context() as patch:
            budget = Budget(patch)
            facts = searched(tmp_path / "a", rounds=np.inf, minutes=seconds / 60)
        assert 0.7 * seconds < 1e-4 * budget.steps <= seconds
        again = searched(tmp_path / "b", rounds=facts["rounds"])
        assert content(tmp_path / "b") == content(tmp_path / "a")
        assert again["test"] == facts["test"]

    def test_episodes_that_end_early_leave_it_time(self, tmp_path, monkeypatch):
        """They take 9 steps of 10,000, and so does the last validation."""
        early = {"terminated": "n >= 9", "memory": COUNTED, "episode_length": "500s"}
        with monkeypatch.context() as patch:
            budget = Budget(patch)
            searched(tmp_path / "a", rounds=np.inf, minutes=4 / 60, **early)
        assert 0.7 * 4 < 1e-4 * budget.steps <= 4

    def test_of_slow_fmus_a_surrogate_plays(self, folder, monkeypatch):
        """A round of 8 candidates takes 1 s, of which 3 s have less than 20."""
        told = []
        monkeypatch.setattr(Probe, "round_time", lambda *_: 1.0)
        facts = searched(folder, rounds=np.inf, minutes=0.05, told=told)
        assert facts["surrogate"]
        assert [line for line in told if "predicted" in line and "measured" in line]
        assert facts["agent"] in facts["test"]
        with pytest.raises(ConfigError, match="no search to resume"):
            searched(folder, resume=True)

    @pytest.mark.parametrize(("cycles", "is_found"), [(0, False), (1, True)])
    def test_an_interruption_leaves_what_the_fmu_has_played(
        self, folder, monkeypatch, cycles, is_found
    ):
        """Nothing before the first proof on the FMU, and the best one after it."""
        search = TwinSearch._search
        monkeypatch.setattr(Probe, "round_time", lambda *_: 1.0)
        monkeypatch.setattr(surrogate_search, "_is_close", lambda *_: False)

        def interrupted(self, evaluator, cycle):
            if cycle == cycles:
                raise KeyboardInterrupt
            search(self, evaluator, cycle)

        monkeypatch.setattr(TwinSearch, "_search", interrupted)
        with pytest.raises(KeyboardInterrupt):
            searched(folder, rounds=np.inf, minutes=0.1)
        assert folder.exists() == is_found
        if is_found:
            assert ResidualAgent.load(folder).text


HIDDEN = {"q_0": "pi", "theta_0": 0.5, "b": {"distribution": "uniform", "low": 0.1, "high": 1}}
COUNTED = {"n": {"start": 0, "update": "n + 1"}}


class TestProbe:
    @pytest.mark.parametrize("envs", [1, 3, 8])
    def test_what_it_finds_depends_on_no_time(self, envs, monkeypatch):
        """Episodes differ after the first steps only; a step seems to take 100 s, or nothing."""
        found, told = [], []
        for seconds in (100.0, 0.0):
            clock = itertools.count(step=seconds)
            monkeypatch.setattr("fmugym.control.candidate_evaluation.perf_counter", clock.__next__)
            found.append(Probe.of(load(parameters=HIDDEN), envs, told.append))
        slow, fast = found
        assert slow.seconds > fast.seconds
        assert replace(slow, seconds=fast.seconds) == fast
        assert not slow.is_same
        assert not told

    @pytest.mark.parametrize(("end", "steps"), [("n >= 9", 9), ("n > 99", 40), (None, 40)])
    def test_a_round_takes_as_long_as_episodes_have_taken(self, end, steps):
        probe = Probe.of(load(terminated=end, memory=COUNTED), 8, print)
        assert probe.round_time(4) == pytest.approx(probe.seconds * steps * 8 * 4)

    def test_of_longer_episodes_the_limit_counts(self):
        probe = Probe.of(load(terminated=None, episode_length="10s"), 8, print)
        assert probe.round_time(1) == pytest.approx(probe.seconds * 200 * 8)

    def test_a_reward_that_is_always_nan_is_refused(self, folder):
        reward = {"fine": "-theta**2", "wrong": "log(-1 - tau**2)"}
        with pytest.raises(ConfigError, match=r"reward\.wrong.*log\(-1 - tau\*\*2\).*validate"):
            searched(folder, reward=reward)
        assert not (folder).exists()

    def test_a_reward_that_is_nan_later_is_none_of_its_business(self):
        Probe.of(load(reward="log(1.5 - n)", memory=COUNTED), 8, print)
