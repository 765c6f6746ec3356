"""The random streams of the C extension are numpy's, and so are the values drawn from them."""

import math

import numpy as np
import pytest
from combinations import in_turn
from gymnasium.utils import seeding
from vector_tools import HOOKS, Drawing
from ways import in_way

from fmugym import Choice, LogUniform, Normal, Uniform
from fmugym.environment import episode_start as module
from fmugym.environment.distributions import draw
from fmugym.environment.episode_start import EpisodeStart, no_draws
from fmugym.environment.saved_episode import state_of as generator_state_of
from fmugym.environment.vector import FMUVectorEnv
from fmugym.environment.vector.random_streams import EpisodeStreams
from fmugym.pool.pool_form import form_of_draws

SEEDS = [
    *range(200),
    *(2**bits + offset for bits in (31, 32, 63, 64, 96, 127, 128, 160, 192) for offset in (-1, 0)),
    *(int(number) << 77 for number in np.random.default_rng(0).integers(2**62, size=50)),
    10**200,
    3**5000,
]
DISTRIBUTIONS = {
    "uniform": Uniform(-0.3, 0.7),
    "uniform of no width": Uniform(2.0, 2.0),
    "log uniform": LogUniform(1e-3, 7.0),
    "normal": Normal(0.2, 1.3),
    "normal within limits": Normal(0.0, 1.0, low=-0.1, high=1.7),
    "normal of no width": Normal(0.5, 0.0),
    "choice": Choice([1.0, 2.5, -3.0]),
    "choice of one": Choice([4.0]),
    "choice of many": Choice(list(range(1000))),
    "weighted choice": Choice([1.0, 2.0, 3.0, 4.0], [0.2, 0.0, 0.5, 0.3]),
    "a weight of rounding": Choice([1.0, 2.0, 3.0], [1 / 3, 1 / 3, 1 / 3 + 1e-10]),
}


class OwnUniform(Uniform):
    """A distribution of the user's, which only Python can draw."""

    def sample(self, rng):
        return float(rng.uniform(self.low, self.high)) ** 2


class Own:
    """The same as another distribution, but only Python can draw it."""

    def __init__(self, other):
        self._other = other

    def sample(self, rng):
        return draw(self._other, rng)


def draws_of(*distributions):
    return EpisodeStart((), {}, {f"v{i}": value for i, value in enumerate(distributions)})


@pytest.fixture(params=[True, False], ids=lambda native: "native" if native else "python")
def draws_by(request):
    """Make draws of the C extension, or of Python."""

    def make(*distributions):
        draws = draws_of(*(one if request.param else Own(one) for one in distributions))
        assert (draws.native is not None) == request.param
        return draws

    return make


def state_of(streams, index):
    return generator_state_of(streams.states[index].tolist())


def test_seeds_of_any_size():
    streams = EpisodeStreams(len(SEEDS))
    streams.seed(SEEDS, np.arange(len(SEEDS)))
    for index, seed in enumerate(SEEDS):
        generator, taken = seeding.np_random(seed)
        assert state_of(streams, index) == generator.bit_generator.state, seed
        assert streams.seed_of(index) == taken


def test_some_are_seeded_and_the_others_go_on(draws_by):
    streams, draws = EpisodeStreams(4), draws_by(Uniform(0.0, 1.0))
    everyone = np.arange(4)
    streams.seed([3, 4, 5, 6], everyone)
    streams.draw(draws, everyone)
    streams.seed([9, None, 2**70, 7], np.array([0, 1, 2]))
    expected = [np.random.default_rng(seed) for seed in (9, 4, 2**70, 6)]
    for index in (1, 3):
        expected[index].random()
    drawn = streams.draw(draws, everyone)
    assert drawn[0].tolist() == [generator.random() for generator in expected]


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_draws_are_numpys(name, draws_by):
    """One after another, mixed with others that leave half a number over or none."""
    distributions = [DISTRIBUTIONS[name], Choice([1, 2, 3]), DISTRIBUTIONS[name], Uniform(0, 1)]
    seeds = [5, 6, 2**100]
    streams, draws = EpisodeStreams(3), draws_by(*distributions)
    streams.seed(seeds, np.arange(3))
    generators = [np.random.default_rng(seed) for seed in seeds]
    for indices in ([0, 1, 2], [1], [2, 0]) * 200:
        drawn = streams.draw(draws, np.array(indices))
        expected = [[draw(d, generators[index]) for d in distributions] for index in indices]
        assert drawn.T.tolist() == expected
    for index, generator in enumerate(generators):
        assert state_of(streams, index) == generator.bit_generator.state


@pytest.mark.parametrize("kind", ["PCG64", "MT19937", "Philox", "SFC64"])
def test_draws_by_a_generator_of_any_kind_are_numpys(kind, draws_by):
    """A single environment has a generator, which the user may replace."""
    distributions = [*DISTRIBUTIONS.values(), *reversed(DISTRIBUTIONS.values())]
    draws = draws_by(*distributions)
    ours, theirs = (np.random.Generator(getattr(np.random, kind)(9)) for _ in range(2))
    for _ in range(100):
        drawn = draws.draw_values(ours, natively=True)
        assert drawn == [draw(d, theirs) for d in distributions]
    assert ours.random() == theirs.random()
    assert ours.integers(7, dtype=np.int32) == theirs.integers(7, dtype=np.int32)


def test_many_normal_numbers():
    """The tail and the wedges of the ziggurat are reached about once in a hundred draws."""
    count = 200_000
    streams, draws = EpisodeStreams(count), draws_of(Normal(0.0, 1.0))
    streams.seed(list(range(count)), np.arange(count))
    drawn = streams.draw(draws, np.arange(count))[0]
    for index in range(0, count, count // 5000):
        assert drawn[index] == np.random.default_rng(index).normal()
    assert abs(drawn.mean()) < 4 / math.sqrt(count)


def test_python_and_native_code_take_turns():
    """Options may have distributions that only Python draws."""
    streams = EpisodeStreams(2)
    mine, all_known = draws_of(OwnUniform(0.0, 1.0), Choice([1, 2, 3])), draws_of(Choice([5, 6, 7]))
    assert mine.native is None
    streams.seed([1, 2], np.arange(2))
    generators = [np.random.default_rng(seed) for seed in (1, 2)]
    for draws in (mine, all_known, all_known, mine, all_known) * 3:
        drawn = streams.draw(draws, np.arange(2))
        expected = [draws.draw_values(generator, natively=True) for generator in generators]
        assert drawn.T.tolist() == expected


def test_a_failed_draw_leaves_the_stream_where_numpy_left_it():
    class Failing:
        def sample(self, rng):
            rng.random()
            raise ValueError("no value today")

    streams = EpisodeStreams(1)
    streams.seed([8], np.arange(1))
    with pytest.raises(Exception, match="no value today"):
        streams.draw(draws_of(Failing()), np.arange(1))
    generator = np.random.default_rng(8)
    generator.random()
    assert streams.draw(draws_of(Uniform(0, 1)), np.arange(1))[0, 0] == generator.random()


def test_an_unseeded_stream_can_be_repeated(draws_by):
    draws, streams = draws_by(Uniform(0.0, 1.0)), EpisodeStreams(1)
    drawn = streams.draw(draws, np.arange(1))[0, 0]
    assert streams.seed_of(0).bit_length() > 64
    assert np.random.default_rng(streams.seed_of(0)).random() == drawn


def test_normals_are_left_to_python_where_numpys_function_is_not_found(monkeypatch):
    monkeypatch.setattr(module, "_standard_normal", lambda: 0)
    streams = EpisodeStreams(1)
    assert draws_of(Normal(0.0, 1.0)).native is None
    assert draws_of(Uniform(0.0, 1.0)).native is not None
    streams.seed([4], np.arange(1))
    drawn = streams.draw(draws_of(Normal(0.0, 1.0)), np.arange(1))
    assert drawn[0, 0] == np.random.default_rng(4).normal()


@pytest.mark.parametrize(
    ("distribution", "variable"),
    [
        (Uniform(1.0, 2.0), "body"),  # an Enumeration: most draws are errors
        (Choice([1, 2.5]), "body"),
        (Choice(["point mass", "nothing"]), "body"),
    ],
    ids=str,
)
def test_what_may_not_fit_is_checked_draw_by_draw(distribution, variable):
    env = Drawing()
    draws = EpisodeStart((env.fmu.variable(variable),), {variable: distribution}, {})
    assert draws.recipes is None
    env.close()


MIXED = {
    "q_0": Normal(0.0, 0.3, low=-0.5, high=0.5),
    "m": LogUniform(0.05, 0.07),
    "body": Choice([1, 2]),
    "b": Choice([0.0, 1e-5, 2e-5], [0.2, 0.5, 0.3]),
}


@in_turn({"hooks": HOOKS, "own": {"known": False, "own": True}})
def test_every_distribution_in_episodes(own, hooks, make_envs):
    """Environment i, seeded with s, draws what a single environment seeded with s + i draws."""
    parameters = {**MIXED, "q_dot_0": OwnUniform(0.1, 0.4)} if own else MIXED
    envs = make_envs(in_way(hooks, lambda: Drawing(model_parameters=parameters)), 3)
    single = Drawing(model_parameters=parameters)
    infos = [envs.reset(seed=40)[1], *(envs.reset()[1] for _ in range(4))]
    for index in range(3):
        told = [single.reset(seed=40 + index)[1], *(single.reset()[1] for _ in range(4))]
        for ours, theirs in zip(infos, told, strict=True):
            drawn = {name: ours["drawn"][name][index] for name in parameters}
            assert drawn == theirs["drawn"]
    single.close()


class BareDrawing(Drawing):
    """Hooks that can be compiled: the draws are made in the pool's pass."""

    def _get_action_space(self):
        import gymnasium as gym

        return gym.spaces.Discrete(3)

    def _get_inputs(self):
        return (self.action - 1) * 0.001

    def _is_truncated(self):
        return self.step_count >= 4


@pytest.mark.parametrize("own", [False, True], ids=["known", "own"])
def test_every_distribution_in_the_pass(own):
    parameters = {**MIXED, "q_dot_0": OwnUniform(0.1, 0.4)} if own else MIXED
    ways = [
        FMUVectorEnv(in_way(hooks, lambda: BareDrawing(model_parameters=parameters)), 5)
        for hooks in ("arrays", "one by one")
    ]
    first, second = (envs.reset(seed=1)[0] for envs in ways)
    ways[0].action_space.seed(0)
    for _ in range(40):
        np.testing.assert_array_equal(first, second)
        actions = ways[0].action_space.sample()
        (first, *_, infos), (second, *_, others) = (envs.step(actions) for envs in ways)
        assert infos.keys() == others.keys()
        for name in parameters if infos else ():
            assert infos["drawn"][name].tolist() == others["drawn"][name].tolist()
    for envs in ways:
        envs.close()


def test_a_refused_step_draws_nothing(make_envs):
    parameters = {"q_0": OwnUniform(0.1, 0.4)}
    envs, twins = (
        make_envs(in_way("arrays", lambda: BareDrawing(model_parameters=parameters)), 2)
        for _ in range(2)
    )
    for each in (envs, twins):
        each.reset(seed=3)
        for _ in range(4):
            each.step(np.zeros(2, np.int64))
    with pytest.raises(Exception, match="3"):
        envs.step(np.array([0, 3]))
    zeros = np.zeros(2, np.int64)
    np.testing.assert_array_equal(envs.step(zeros)[0], twins.step(zeros)[0])


def drawn_once(form, standard_normal=0):
    """Draw an episode from a stream."""
    from fmugym import _native

    _native.draw((form, standard_normal, 0), np.ones((1, 6), np.uint64), np.empty((1, 1)))


class TestGuards:
    @pytest.mark.parametrize(
        ("row", "numbers"),
        [
            ((99, 0, 0, 0), []),
            ((-1, 0, 0, 0), []),
            (("uniform", 0, 0, 1), [0.0, 1.0]),
            (("uniform", 0, 1, 2), [0.0, 1.0]),
            (("uniform", 0, -1, 2), [0.0, 1.0]),
            (("uniform", -2, 0, 2), [0.0, 1.0]),
            (("uniform", 0, 2**62, 2), [0.0, 1.0]),
            (("choice", 0, 0, 0), []),
            (("choice", 0, 0, 2**40), [0.0]),
            (("weighted", 0, 0, 3), [0.5, 1.0, 2.0]),
            (("normal", 0, 0, 4), [3.0, 1.0, 0.0, 2.0]),
            (("normal", 0, 0, 4), [math.nan, 1.0, 0.0, 2.0]),
            (("log_uniform", 0, 0, 2), [0.0, 1.0]),  # without the function exp
        ],
        ids=str,
    )
    def test_numbers_that_do_not_fit(self, row, numbers):
        from fmugym import _native

        kind = row[0] if isinstance(row[0], int) else _native.DISTRIBUTIONS.index(row[0])
        table = np.array([kind, *row[1:]], np.int64)
        with pytest.raises(ValueError, match="numbers do not fit"):
            drawn_once(form_of_draws(table, numbers), no_draws()[1])

    def test_a_table_of_odd_length(self):
        with pytest.raises(ValueError, match="ends too early"):
            drawn_once(bytes(33))

    def test_what_is_no_bit_generator(self):
        from fmugym import _native

        draws = draws_of(Uniform(0, 1)).native
        with pytest.raises(ValueError, match="PyCapsule"):
            _native.draw_from(draws, None, np.empty(1), np.empty(1))

    def test_too_few_start_values(self):
        from fmugym import _native

        kind = _native.DISTRIBUTIONS.index("uniform")
        table = np.array([[kind, 1, 0, 2]], np.int64)
        draws = form_of_draws(table, np.array([0.0, 1.0])), 0, 0
        with pytest.raises(ValueError, match="one is for no start value"):
            _native.draw_from(draws, np.random.PCG64().capsule, np.empty(1), np.empty(1))

    def test_values_for_other_streams(self):
        from fmugym import _native

        draws = draws_of(Uniform(0, 1)).native
        with pytest.raises(ValueError, match=r"values must have the shape \(1, 3\), not \(1, 2\)"):
            _native.draw(draws, np.zeros((3, 6), np.uint64), np.empty((1, 2)))
