"""How the components of a system begin episodes, each in its own way.

The FMUs are those of ``zoo/quirks.c``; what is right is an episode of a fresh system.
"""

import itertools
import logging
from contextlib import closing

import numpy as np
import pytest
import quirk_table
import ssp_tools
from combinations import in_turn
from exchange_tools import exchange_fmu
from pool_tools import open_pool, start, step

from fmugym import FMUSystem
from fmugym.pool import PoolSpec
from fmugym.pool.pool_spec import ResetMethod
from fmugym.pool.trial.component_resets import find_component_resets
from fmugym.pool.trial.trial import examine

pytestmark = pytest.mark.usefixtures("trials")

RESTORE, RESET, INSTANCE, LIBRARY, PROCESS = ResetMethod
MIXES = [
    *((RESTORE, RESTORE, RESTORE), (RESTORE, RESET, INSTANCE), (RESTORE, INSTANCE, RESET)),
    *((RESET, RESTORE, INSTANCE), (RESET, RESET, RESET), (RESET, INSTANCE, RESTORE)),
    *((INSTANCE, RESTORE, RESET), (INSTANCE, RESET, RESTORE), (INSTANCE, INSTANCE, INSTANCE)),
]
"""Each method of two components beside each of the others."""
NAMES = ("a", "b", "c")
GAINS = (1.5, 1.5, 1.5, 0.7, 1.5, 1.5, 1.5, 0.7, 0.7, 0.7)
LENGTHS = (3, 25, 25, 4, 25, 25, 25, 3, 25, 25)


@pytest.fixture(scope="module", name="fmu_of")
def made(tmp_path_factory):
    return quirk_table.making_quirks(tmp_path_factory.mktemp("components"))


def chain(fmu_of, *tokens, version=2):
    """Components in a row."""
    paths = [fmu_of(token, version) for token in tokens]
    return FMUSystem(
        dict(zip(NAMES, paths, strict=False)),
        [
            *(f"{one}.y -> {other}.u" for one, other in itertools.pairwise(NAMES[: len(paths)])),
            "go -> a.gain",
        ],
    )


def outputs_of(fmu):
    return [name for name in fmu.description.variables if name.endswith((".y", ".clock"))]


def open_chain(system, count, *options, **spec):
    fmu = system.as_fmu()
    return open_pool(fmu, ["a.u"], outputs_of(fmu), 0.1, count, *options, **spec)


def play(pool, gain, length):
    """The outputs of all instances, shape (steps + 1, outputs, instances)."""
    instances = np.arange(pool.num_instances)
    first = start(pool, {"b.gain": gain}).outputs.copy()
    return np.array([first, *(step(pool, np.sin(0.9 * i + instances)) for i in range(length))])


def fresh_episode(system, gain, length, count=2):
    with closing(open_chain(system, count, private=True)) as pool:
        return play(pool, gain, length)


def episodes(system, methods, count=2, lengths=LENGTHS):
    options = {"component_resets": tuple(methods), "private": LIBRARY in methods}
    with closing(open_chain(system, count, **options)) as pool:
        return [play(pool, *one) for one in zip(GAINS, lengths, strict=False)]


def is_right(system, methods):
    """Whether each of many episodes equals one of a fresh system, bit by bit."""
    expected = {gain: fresh_episode(system, gain, max(LENGTHS)) for gain in set(GAINS)}
    pairs = zip(GAINS, LENGTHS, strict=True)
    found = episodes(system, methods)
    return all(
        rows.tobytes() == expected[gain][: length + 1].tobytes()
        for rows, (gain, length) in zip(found, pairs, strict=True)
    )


LIARS = {
    "reset does nothing": INSTANCE,
    "reset keeps the state": INSTANCE,
    "reset keeps outputs": INSTANCE,
    "restore forgets": RESET,
    "restore keeps the time": RESET,
    "library keeps": LIBRARY,
}


class TestMethods:
    @pytest.mark.parametrize("token", LIARS)
    def test_a_liar_begins_by_its_own_one(self, fmu_of, token):
        system = chain(fmu_of, "well behaved", token, "well behaved")
        assert is_right(system, (RESTORE, LIARS[token], RESET))

    @pytest.mark.parametrize("token", ["reset does nothing", "reset keeps the state"])
    def test_this_test_would_find_a_liar(self, fmu_of, token):
        system = chain(fmu_of, "well behaved", token)
        assert not is_right(system, (RESET, RESET))

    @pytest.mark.parametrize("token", ["restore forgets", "restore keeps the time"])
    def test_who_restores_something_else_is_found_out(self, fmu_of, token):
        """The other components are restored all the same, as their FMUs see."""
        system = chain(fmu_of, "well behaved", token, "well behaved")
        assert is_right(system, (RESTORE, RESTORE, RESTORE))

    @in_turn({"methods": MIXES, "version": [2, 3]})
    def test_in_any_mix(self, fmu_of, version, methods):
        system = chain(fmu_of, *["well behaved"] * 3, version=version)
        assert is_right(system, methods)

    def test_some_are_really_not_initialized_again(self, fmu_of, monkeypatch):
        """The state of the first is restored in all but the first two of like episodes."""
        system = chain(fmu_of, "reset does nothing", "well behaved")
        right = fresh_episode(system, 1.5, 25)
        found = episodes(system, (RESTORE, INSTANCE), lengths=(25, 25, 25))
        # the reset of the first does nothing, so that only its restored state can be right
        assert found[2].tobytes() != right.tobytes()
        assert found[2].tobytes() == found[1].tobytes() != found[0].tobytes()

    def test_without_a_function_for_resets(self, fmu_of, tmp_path):
        """Model exchange of FMI 1.0 has none: only this component is made anew."""
        ball = exchange_fmu(tmp_path / "ball.fmu", "ball", 1)
        system = FMUSystem({"a": fmu_of("well behaved"), "b": ball}, ["a.y -> b.e"])
        fmu = system.as_fmu()
        fitted = PoolSpec((), (), 0.1).fitting(fmu.description)
        assert fitted.component_resets == (RESET, INSTANCE)
        assert fitted.reset_method is INSTANCE
        assert fitted.whole_reset_method is RESET
        rows = []
        with closing(open_pool(fmu, ["a.u"], ["b.h"], 0.1, 2)) as pool:
            for _ in range(3):
                first = start(pool).outputs.copy()
                rows.append([first, *(step(pool, 1.0) for _ in range(9))])
        assert np.array_equal(rows[0], rows[1])
        assert np.array_equal(rows[0], rows[2])

    def test_snapshots_end_with_the_instance(self, fmu_of):
        """A state of a component that was made anew belongs to nobody."""
        system = chain(fmu_of, "well behaved", "well behaved")
        with closing(open_chain(system, 2, component_resets=(RESTORE, INSTANCE))) as pool:
            play(pool, 1.5, 5)
            snapshot = pool.save()
            before = step(pool, 0.0)
            pool.restore(snapshot)
            assert step(pool, 0.0).tobytes() == before.tobytes()
            play(pool, 1.5, 5)
            with pytest.raises(Exception, match="has been replaced since"):
                pool.restore(snapshot)


class TestChoice:
    """Which methods a trial finds, given what it would see."""

    OFFERS = ((RESTORE, RESET, INSTANCE),) * 3

    @staticmethod
    def find(offers, base, truth):
        """Components begin anew by what they are good at, and by everything slower."""
        asked = []

        def is_right(methods):
            asked.append(methods)
            order = list(ResetMethod)
            return all(
                order.index(method) >= order.index(own)
                for method, own in zip(methods, truth, strict=True)
            )

        return find_component_resets(offers, base, is_right), asked

    def test_each_gets_its_own(self):
        for truth in itertools.product((RESTORE, RESET, INSTANCE), repeat=3):
            base = max(truth, key=list(ResetMethod).index)
            found, _ = self.find(self.OFFERS, base, truth)
            assert found == (truth if set(truth) != {base} else ())

    def test_what_is_not_offered_is_not_asked_for(self):
        offers = ((RESET, INSTANCE), (INSTANCE,), (RESTORE, RESET, INSTANCE))
        found, asked = self.find(offers, RESET, (RESET, INSTANCE, RESTORE))
        assert found == (RESET, INSTANCE, RESTORE)
        assert len(asked) == 1

    def test_what_is_wrong_together_is_not_used(self):
        assert find_component_resets(self.OFFERS, RESET, lambda m: list(m).count(RESTORE) < 2) == ()

    def test_nothing_is_tried_without_a_choice(self):
        found, asked = self.find(((INSTANCE,),) * 2, INSTANCE, (INSTANCE,) * 2)
        assert not found
        assert not asked


def verdict_of(system):
    fmu = system.as_fmu()
    spec = PoolSpec((fmu.variable("a.u"),), tuple(map(fmu.variable, outputs_of(fmu))), 0.1)
    return examine(fmu, spec, length=100)


class TestTrial:
    @pytest.mark.parametrize("token", LIARS)
    def test_finds_who_lies(self, fmu_of, token):
        system = chain(fmu_of, "well behaved", token, "well behaved")
        verdict = verdict_of(system)
        assert {verdict.components[0], verdict.components[2]} == {RESTORE}
        # a liar that gives itself away is not restored by the pool either
        assert verdict.components[1] in {LIARS[token], RESTORE}
        if "reset" in token or token == "library keeps":
            assert verdict.components[1] is LIARS[token]

    def test_honest_ones_are_restored_together(self, fmu_of):
        verdict = verdict_of(chain(fmu_of, *["well behaved"] * 3))
        assert verdict.reset_method is RESTORE
        assert verdict.components == ()

    def test_info_tells_it(self, fmu_of, tmp_path, ran):
        system = chain(fmu_of, "well behaved", "reset does nothing")
        archive = ssp_tools.write(system, tmp_path / "chain.ssp")
        system = FMUSystem.read(archive)
        verdict_of(system)
        lines = ran("info", archive).splitlines()
        (one,) = (line for line in lines if line.strip().startswith("a:"))
        (other,) = (line for line in lines if line.strip().startswith("b:"))
        assert "'restore'" in one
        assert "'instance'" in other

    def test_a_verdict_is_kept(self, fmu_of):
        system = chain(fmu_of, "well behaved", "reset does nothing")
        assert verdict_of(system) == verdict_of(system)
        assert verdict_of(system).components_of(system.plan) == {"a": "restore", "b": "instance"}

    @in_turn({"token": list(LIARS), "options": [{}, {"isolation": "process", "workers": 2}]})
    def test_pools_do_what_it_says(self, fmu_of, token, options, caplog):
        caplog.set_level(logging.INFO)
        system = chain(fmu_of, "well behaved", token)
        with closing(open_chain(system, 3, options)) as pool:
            found = [play(pool, *one) for one in zip(GAINS, LENGTHS, strict=True)]
        for rows, gain, length in zip(found, GAINS, LENGTHS, strict=True):
            right = fresh_episode(system, gain, length, 3)
            assert rows.tobytes() == right.tobytes()
        assert "component 'a' begins by the method 'restore'" in caplog.text
