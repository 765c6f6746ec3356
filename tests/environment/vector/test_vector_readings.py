"""What methods, attributes and snapshots tell of the last step, in every engine and mode.

No hook of these environments reads the actions or the state before a step. So compiled steps have
no use for them, but the caller may ask for them at any time. The reference are single environments
in Python.
"""

import numpy as np
import pytest
from contract_cases import WITH_DONE
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector_tools import (
    HOOKS,
    Drawing,
    each_mode,
    each_way,
    in_each_mode,
    require_equal,
    results_of_both,
)
from ways import in_way

import fmugym
from fmugym.environment.vector import FMUVectorEnv
from fmugym.records import RecordVectorSeries

COUNT, STEPS = 3, 6
NAMES = (
    *("action", "previous_action", "state", "previous_state"),
    *("inputs", "step_count", "done", "time"),
)


class Told(Drawing):
    """Methods that read what no hook reads. Episodes end after some steps, one by its hook."""

    def _is_done(self):
        return abs(self.state[0]) > 0.55

    def told(self):
        return {name: getattr(self, name) for name in NAMES}


@pytest.fixture
def pair(opened, make_envs):
    """Make a vector environment, and single environments in Python."""

    def make(hooks, mode=AutoresetMode.NEXT_STEP, cls=Told):
        ours = make_envs(in_way(hooks, cls), COUNT, autoreset_mode=mode)
        theirs = SyncVectorEnv([cls] * COUNT, autoreset_mode=mode)
        return ours, opened(theirs)

    return make


def plain(value):
    if isinstance(value, dict):
        return {name: plain(part) for name, part in value.items()}
    return list(map(plain, value)) if isinstance(value, tuple) else np.asarray(value).tolist()


ASKED = {
    "call": lambda envs: envs.call("told"),
    "attributes": lambda envs: tuple(
        dict(zip(NAMES, values, strict=True))
        for values in zip(*(envs.get_attr(name) for name in NAMES), strict=True)
    ),
    "method_taken_before": lambda envs: tuple(told() for told in envs.get_attr("told")),
}


@in_each_mode({"way": list(ASKED), "first": [1, 3]})
def test_the_last_step_is_told_from_the_first_question_on(first, way, hooks, mode, pair):
    envs = ours, theirs = pair(hooks, mode)
    for count, _ in enumerate(results_of_both(*envs, STEPS, seed=0), 1):
        if count >= first:
            assert plain(ASKED[way](ours)) == plain(theirs.call("told")), count


@each_way
def test_pictures_show_the_last_step(hooks, pair):
    """The caption of this environment tells the action and the state before."""
    seen = []

    class Pictured(Told):
        metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  (Gymnasium's own form)

        def __init__(self):
            super().__init__()
            self.render_mode = "rgb_array"

        def render(self):
            seen.append(self.told())

    envs = ours, theirs = pair(hooks, cls=Pictured)
    list(results_of_both(*envs, 1))
    ours.render()
    assert plain(tuple(seen)) == plain(theirs.call("told"))


def test_before_the_first_reset(make_envs):
    """There is no last step: the values are those of a new environment."""
    envs = make_envs(Told, 2, way="arrays")
    assert plain(envs.get_attr("step_count")) == [0, 0]
    assert plain(envs.get_attr("previous_action")) == [[0.0], [0.0]]


@each_mode
def test_costs_in_a_series_have_the_done_of_their_step(mode):
    """They come from the infos; where ``done`` is a cost, it is what the row says of the end."""
    ours, theirs = (
        RecordVectorSeries(
            FMUVectorEnv(in_way(way, lambda: fmugym.load(WITH_DONE)), 3, autoreset_mode=mode)
        )
        for way in HOOKS
    )
    list(results_of_both(ours, theirs))
    rows = [{c.name: envs.series[c.name] for c in envs.series.columns} for envs in (ours, theirs)]
    require_equal(*rows)
    is_step = rows[0]["step"] > 0
    assert rows[0]["costs.last"].any()
    np.testing.assert_array_equal(rows[0]["costs.last"][is_step], rows[0]["terminated"][is_step])
    ours.close()
    theirs.close()
