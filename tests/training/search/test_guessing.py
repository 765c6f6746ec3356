"""Guessed controllers: step responses and pairings of plants whose gains are in the literature."""

from contextlib import closing
from functools import partial

import numpy as np
import pytest
from makers import by_python

import fmugym
from fmugym import ConfigError
from fmugym.control.candidate_evaluation import CandidateEvaluator
from fmugym.control.controller_parsing import search_of
from fmugym.training.search.step_response import (
    best_pairing,
    episodes_of,
    niederlinski_index,
    relative_gains,
    step_test,
)
from fmugym.training.search.suggested_controllers import (
    Loops,
    guessed_controllers,
    suggested_controllers,
)

COLUMN = np.array([[12.8, -18.9], [6.6, -19.4]])
"""Wood and Berry, Chemical Engineering Science 28 (1973): mol % by lb/min."""

TANKS = {
    "minimum phase": (
        {"k1": 3.33, "k2": 3.35, "valve_1": 0.70, "valve_2": 0.60},
        (12.4, 12.7, 1.8, 1.4),
        3.0,
        np.array([[2.6, 1.5], [1.4, 2.8]]),
    ),
    "other phase": (
        {"k1": 3.14, "k2": 3.29, "valve_1": 0.43, "valve_2": 0.34},
        (12.6, 13.0, 4.8, 4.9),
        3.15,
        np.array([[1.5, 2.5], [2.5, 1.6]]),
    ),
}
"""Johansson (2000): parameters, levels in cm, voltages, and gains in V/V of its linear models."""


class TestPairing:
    @pytest.mark.parametrize(
        ("gains", "first"),
        [
            (COLUMN, 2.01),
            (TANKS["minimum phase"][-1], 1.40),
            (TANKS["other phase"][-1], -0.64),
        ],
        ids=["column", *TANKS],
    )
    def test_relative_gains_are_those_of_the_literature(self, gains, first):
        relative = relative_gains(gains)
        assert relative[0, 0] == pytest.approx(first, abs=0.02)
        assert relative.sum(axis=0) == pytest.approx(np.ones(2))

    def test_of_three(self):
        """Example 3.18 of Skogestad and Postlethwaite, Multivariable Feedback Control (2005)."""
        gains = np.array([[16.8, 30.5, 4.30], [-16.7, 31.0, -1.41], [1.27, 54.1, 5.40]])
        expected = [[1.50, 0.99, -1.48], [-0.41, 0.97, 0.45], [-0.08, -0.95, 2.03]]
        assert relative_gains(gains) == pytest.approx(np.array(expected), abs=0.01)
        assert best_pairing(gains)[0] == (0, 1, 2)
        order = [2, 0, 1]
        assert best_pairing(gains[order])[0] == (1, 2, 0)

    def test_scales_do_not_matter(self):
        scaled = COLUMN * [[1000.0], [1e-3]] * [7.0, -0.01]
        assert relative_gains(scaled) == pytest.approx(relative_gains(COLUMN))

    def test_some_plants_have_none(self):
        """Two rows of this one have their only positive relative gain in one column (Koppel)."""
        gains = np.array([[1, 1, -0.1], [0.1, 2, -1], [-2, -3, 1]])
        positive = relative_gains(gains) > 0
        assert positive.tolist() == [
            [False, True, False],
            [False, True, False],
            [True, False, True],
        ]
        assert best_pairing(gains) is None

    def test_a_negative_index_is_refused(self):
        """All relative gains in the diagonal are positive, and yet integrals are unstable.

        From the chapter on decentralized control in Skogestad and Postlethwaite (2005).
        """
        gains = np.array(
            [
                [8.72, 2.81, 2.98, -15.80],
                [6.54, -2.92, 2.50, -20.79],
                [-5.82, 0.99, -1.48, -7.51],
                [-7.23, 2.92, 3.11, 7.86],
            ]
        )
        diagonal = [0.41, 0.45, 0.17, 0.04]
        assert np.diag(relative_gains(gains)) == pytest.approx(diagonal, abs=0.005)
        assert niederlinski_index(gains, range(4)) == pytest.approx(-18.65, abs=0.005)
        found, _ = best_pairing(gains)
        assert niederlinski_index(gains, found) > 0
        assert (relative_gains(gains)[found, range(4)] > 0).all()


CONTROLLED = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "episode_length": "10s",
    "variables": {
        "tau": {"min": -0.1, "max": 0.3},
        "q": {"min": -2, "max": 2},
    },
    "agent": {"actions": ["tau"], "observations": ["q", "q_dot", "goal"]},
    "setpoints": {"goal": 1.0},
}


class TestLoops:
    @pytest.mark.parametrize(
        ("changes", "setpoints"),
        [
            ({"reward": "-abs(q - goal)"}, {"q": ["goal"]}),
            ({"reward": "-(goal - q)**2"}, {"q": ["goal"]}),
            (
                {
                    "reward": {
                        "a": "-(q - 0.5)**2",
                        "b": {"expr": "-abs(q_dot - goal)", "weight": 2},
                    }
                },
                {"q": [0.5], "q_dot": ["goal"]},
            ),
            ({"reward": "-error**2", "expressions": {"error": "0.25 - q"}}, {"q": [0.25]}),
            ({"reward": "-tau**2", "costs": {"far": {"expr": "max(q - 1, 0)"}}}, {"q": [1.0]}),
            ({"reward": "-tau**2 - q * goal - q_dot"}, None),
            ({"reward": "1 - goal"}, None),
            ({"reward": "-abs(q - phi)", "variables": {"phi": {"name": "theta"}}}, None),
            (
                {
                    "reward": 1,
                    "setpoints": {"goal": {"value": 1.0, "of": "q"}},
                },
                {"q": ["goal"]},
            ),
            (
                {"reward": "-abs(q - 1) - abs(q - goal) - abs(q_dot - q)"},
                {"q": ["goal", "q_dot", 1.0], "q_dot": ["q"]},
            ),
        ],
        ids=[
            "reward",
            "reversed",
            "terms",
            "expression",
            "costs",
            "none",
            "set point",
            "unseen",
            "of",
            "names first",
        ],
    )
    def test_come_from_differences(self, changes, setpoints):
        changes = {"variables": CONTROLLED["variables"] | changes.pop("variables", {})} | changes
        loops = controlled(**changes)
        assert (loops and loops.setpoints) == setpoints

    def test_need_actions_that_are_numbers(self):
        levels = CONTROLLED["variables"] | {"tau": {"levels": [-0.1, 0.1]}}
        assert controlled(reward="-abs(q - goal)", variables=levels, physical=False) is None
        with closing(fmugym.envs.CartPoleEnv()) as env:
            assert Loops.of({"reward": "x - 1"}, env) is None

    def test_actions_of_two_levels_are_switches(self):
        levels = CONTROLLED["variables"] | {"tau": {"levels": [-0.1, 0.3]}}
        assert controlled(reward="-abs(q - goal)").switches == frozenset()
        loops = controlled(reward="-abs(q - goal)", variables=levels)
        assert loops.switches == {"tau"}
        assert loops.limits[0] == pytest.approx((-0.1, 0.3))


def controlled(physical=True, **changes):
    """The loops of a pendulum that hangs."""
    task = fmugym.Task.from_dict(CONTROLLED | changes)
    with closing(fmugym.load(task, physical=physical)) as env:
        return Loops.of(env.task.document, env)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The paths of the FMUs by name."""
    folder = tmp_path_factory.mktemp("plants")
    return {name: by_python("pythonfmu", f"{name}.py")(folder) for name in PLANTS}


PLANTS = ("foreign_column", "foreign_four_tanks")


def column(made, **changes):
    """A task with the column, and no controller."""
    return {
        "fmu": str(made["foreign_column"]),
        "time_step": "1min",
        "episode_length": "2h",
        "variables": {
            "reflux": {"min": -1, "max": 1},
            "steam": {"min": -2, "max": 1},
            "top": {"min": -100, "max": 100},
            "bottom": {"min": -100, "max": 100},
        },
        "setpoints": {"top_set": 1.0, "bottom_set": {"value": -0.5}},
        "agent": {
            "actions": ["reflux", "steam"],
            "observations": ["bottom", "top", "top_set", "bottom_set"],
        },
        "reward": "-abs(top_set - top) - abs(bottom - bottom_set)",
        **changes,
    }


def tanks(made, phase):
    parameters, levels, voltage, _ = TANKS[phase]
    starts = {f"level_{number}": level for number, level in enumerate(levels, 1)}
    return {
        "fmu": str(made["foreign_four_tanks"]),
        "time_step": "5s",
        "episode_length": "10min",
        "variables": {
            **{one: {"min": voltage - 1, "max": voltage + 1} for one in ("v1", "v2")},
            **{one: {"min": 0, "max": 10} for one in ("y1", "y2")},
        },
        "parameters": {**parameters, **starts},
        "setpoints": {"y1_set": 6.5, "y2_set": 6.3},
        "agent": {"actions": ["v1", "v2"], "observations": ["y1", "y2", "y1_set", "y2_set"]},
        "reward": "-(y1_set - y1)**2 - (y2_set - y2)**2",
    }


def responses_of(task, envs=256):
    """The loops of a task, and its step responses."""
    task = fmugym.Task.from_dict(task)
    make = partial(fmugym.load, task, physical=True)
    with closing(make()) as env:
        loops = Loops.of(task.document, env)
    with closing(CandidateEvaluator(make, envs, loops.most_steps)) as evaluator:
        return loops, step_test(evaluator, loops.limits), evaluator.steps


def guessed(task):
    """By action, what it controls, and whether more of it raises that."""
    loops, responses, _ = responses_of(task)
    return loops_of(guessed_controllers(loops, responses)["PI"])


def loops_of(text):
    searches = search_of(text).searches
    return {action: (one.fixed["of"], "kp" not in one.negative) for action, one in searches.items()}


class TestStepTest:
    def test_gains_of_the_column(self, made):
        """At the end of two hours, about 1 % of the slowest lag is left."""
        _, responses, steps = responses_of(column(made))
        by_range = responses.gains[[1, 0]] / [2.0, 3.0]
        assert responses.names == ("bottom", "top", "top_set", "bottom_set")
        assert by_range == pytest.approx(COLUMN, rel=0.02)
        assert not responses.gains[2:].any()
        assert steps == episodes_of(2) * 120 == 15 * 120

    @pytest.mark.parametrize("phase", TANKS)
    def test_gains_of_four_tanks(self, made, phase):
        """Of a plant that is not linear, by steps of a quarter of a volt around the point."""
        _, responses, _ = responses_of(tanks(made, phase))
        assert responses.gains[:2] / 2.0 == pytest.approx(TANKS[phase][-1], rel=0.1)
        assert responses.runs_away == []

    def test_groups_do_not_matter(self, made):
        _, alone, _ = responses_of(column(made), envs=4)
        _, together, _ = responses_of(column(made))
        assert alone.responses == pytest.approx(together.responses, nan_ok=False, abs=0)
        assert (alone.ends == together.ends).all()

    def test_what_integrates_has_slopes(self, made):
        """Gains are those of the integrals then, K/T; delays move them, but not the slopes."""
        _, responses, _ = responses_of(column(made, parameters={"feedback": 0.0}))
        slopes = COLUMN / [[16.7, 21.0], [10.9, 14.4]]
        quarter = 29.5  # minutes between the means of the last two quarters
        assert responses.gains[[1, 0]] / [2.0, 3.0] / quarter == pytest.approx(slopes, rel=0.01)
        assert responses.runs_away == []

    def test_noise_cancels(self, made):
        noisy = column(made)
        noisy["variables"]["top"] = {"min": -100, "max": 100, "noise": 5.0}
        _, responses, _ = responses_of(noisy)
        assert responses.gains[[1, 0]] / [2.0, 3.0] == pytest.approx(COLUMN, rel=0.02)


class TestGuesses:
    def test_the_column_is_paired_as_in_the_literature(self, made):
        """Reflux controls the top and steam the bottom, which it lowers."""
        assert guessed(column(made)) == {"reflux": ("top", True), "steam": ("bottom", False)}

    def test_four_tanks_of_minimum_phase(self, made):
        expected = {"v1": ("y1", True), "v2": ("y2", True)}
        assert guessed(tanks(made, "minimum phase")) == expected

    def test_four_tanks_of_the_other_phase(self, made):
        expected = {"v1": ("y2", True), "v2": ("y1", True)}
        assert guessed(tanks(made, "other phase")) == expected

    def test_what_integrates_is_paired_by_slopes(self, made):
        """The relative gain of the slopes K/T is 1.57."""
        found = guessed(column(made, parameters={"feedback": 0.0}))
        assert found == {"reflux": ("top", True), "steam": ("bottom", False)}

    def test_gains_of_a_plant_give_the_ranges(self, made):
        """Of the PI controller of the top: 2 lb/min for 25.6 mol %."""
        loops, responses, _ = responses_of(column(made))
        text = guessed_controllers(loops, responses)["PI"]
        ranges = search_of(text).searches["reflux"].ranges
        gains = ranges["kp"].low, ranges["kp"].high
        assert gains == pytest.approx((0.3 / 12.8, 30 / 12.8), rel=0.02)
        assert (ranges["ti"].low, ranges["ti"].high) == (60.0, 7200.0)

    def test_proportional_ones_have_an_action_without_error(self, made):
        """Unless their set point is tuned, which does the same."""
        loops, responses, _ = responses_of(column(made, reward="-abs(top_set - top)"))
        searches = search_of(guessed_controllers(loops, responses)["P"]).searches
        assert {*searches["reflux"].ranges} == {"kp", "offset"}
        assert {*searches["steam"].ranges} == {"kp", "setpoint"}
        offset = searches["reflux"].ranges["offset"]
        assert (offset.low, offset.high) == (-1.0, 1.0)

    def test_without_a_set_point_one_is_tuned(self, made):
        """Within what the test has seen there."""
        reward = {"reward": "-abs(top_set - top)"}
        loops, responses, _ = responses_of(column(made, **reward))
        text = guessed_controllers(loops, responses)["PI"]
        assert loops_of(text) == {"reflux": ("top", True), "steam": ("bottom", False)}
        found = search_of(text).searches["steam"].ranges["setpoint"]
        ends = responses.ends[:, 0]
        assert (found.low, found.high) == pytest.approx((ends.min(), ends.max()), rel=1e-3)

    def test_an_action_on_or_off_has_a_thermostat(self, made):
        task = column(made)
        task["variables"] |= {"reflux": {"levels": [-1, 0, 1]}, "steam": {"levels": [0, 1]}}
        loops, responses, _ = responses_of(task)
        text = guessed_controllers(loops, responses)["PI"]
        assert search_of(text).searches["reflux"].kind == "pid"
        steam = search_of(text).searches["steam"]
        assert steam.kind == "hysteresis"
        assert (steam.fixed["of"], steam.fixed["below"], steam.fixed["above"]) == ("bottom", 0, 1)

    def test_what_runs_away_has_none(self, made):
        with pytest.raises(ConfigError, match="bottom, top run away"):
            guessed(column(made, parameters={"feedback": -1.0}))


@pytest.mark.parametrize("most", [600, 2000])
def test_the_two_zones(most, example, tmp_path):
    """The heat pump controls its tank, each valve its zone; in 7 h or in a day of the winter."""
    path = example("two_zones").make_task(tmp_path)
    make = partial(fmugym.load, path, physical=True)
    with closing(make()) as env:
        loops = Loops.of(env.task.document, env)
    with closing(CandidateEvaluator(make)) as evaluator:
        guesses = suggested_controllers(evaluator, loops, most)
        assert most - 21 < evaluator.steps <= most
    assert [*guesses] == ["PI", "P"]
    expected = {"u_hp": ("T_tank", True), "v1": ("T1", True), "v2": ("T2", True)}
    assert loops_of(guesses["PI"]) == loops_of(guesses["P"]) == expected
