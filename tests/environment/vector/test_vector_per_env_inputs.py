"""Hooks that are called one environment at a time: inputs and infos that are gathered together."""

import numpy as np
import pytest
from gymnasium import spaces
from vector_tools import make_pair, results_of_both
from ways import in_way

import fmugym
from fmugym import ConfigError
from fmugym.environment.vector import FMUVectorEnv


class TwoTorques(fmugym.FMI2CSEnv):
    """``_get_inputs`` returns an array that all environments share, or what ``form`` makes of it.

    The reward of an environment breaks in step ``broken``.
    """

    array = np.zeros(2)
    form = None
    broken = 0

    def __init__(self):
        config = {
            "model_input_names": ["tau1", "tau2"],
            "model_output_names": ["q1", "q2"],
            "model_parameters": {"q1_0": fmugym.Uniform(-1.0, 1.0)},
            "time_step": 0.02,
        }
        super().__init__(fmugym.bundled_fmu("DoublePendulum"), config)
        self.informed = []

    def _get_action_space(self):
        return spaces.Box(-1.0, 1.0, (2,), np.float32)

    def _get_inputs(self):
        self.array[:] = self.action
        self.array *= 0.1
        return self.array if self.form is None else self.form(self.array)

    def _is_done(self):
        return False

    def _reward_policy(self):
        return np.nan if self.step_count == self.broken else 1.0

    def _get_info(self):
        self.informed.append(self.step_count)
        return {"first": self.inputs[0], "steps": self.step_count}


FORMS = (None, np.float32, list, tuple, np.longdouble, lambda values: values[:, None])
ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (4, len(FORMS), 2)).astype(np.float32)


@pytest.mark.parametrize("forms", [FORMS, (None,) * 6, (np.float32,) * 6, (list,) * 6])
def test_inputs_of_any_form_are_those_of_single_environments(forms):
    """An array that all environments return must not mix their inputs."""
    ours, theirs = make_pair(TwoTorques, num_envs=len(forms), way="one by one")
    for envs in (ours, theirs):
        envs.set_attr("form", list(forms))
    for _ in results_of_both(ours, theirs, list(ACTIONS)):
        assert ours.get_attr("inputs") == theirs.get_attr("inputs")
    ours.close()
    theirs.close()


@pytest.mark.parametrize("form", [None, np.float32, list])
def test_an_input_that_is_not_finite_names_its_environment(form, make_envs):
    envs = make_envs(in_way("one by one", TwoTorques), 3)
    envs.reset(seed=0)
    envs.set_attr("form", form)
    envs.step(ACTIONS[0][:3])
    before = [envs.get_attr(name) for name in ("inputs", "action", "previous_action", "state")]
    envs.set_attr("form", [form, lambda values: np.array([values[0], np.inf]), form])
    with pytest.raises(ConfigError, match=r"environment 1: .*tau2 = inf"):
        envs.step(ACTIONS[1][:3])
    after = [envs.get_attr(name) for name in ("inputs", "action", "previous_action", "state")]
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(old, new)
    envs.set_attr("form", form)
    envs.step(ACTIONS[1][:3])


@pytest.mark.parametrize("mode", ["next_step", "same_step", "disabled"])
def test_infos_are_asked_for_as_in_a_single_environment(mode):
    """The info of a fault is asked for once, in the state before the step."""
    envs = FMUVectorEnv(in_way("one by one", TwoTorques), 3, autoreset_mode=mode)
    alone = TwoTorques()
    envs.reset(seed=0)
    alone.reset(seed=1)
    envs.set_attr("broken", [0, 2, 0])
    alone.broken = 2
    for actions in ACTIONS[:2]:
        *_, infos = envs.step(actions[:3])
        *_, info = alone.step(actions[1])
    asked = envs.get_attr("informed")
    restarts = [0] if mode == "same_step" else []
    assert list(asked) == [[0, 1, 2], [*alone.informed, *restarts], [0, 1, 2]]
    last = infos["final_info"] if mode == "same_step" else infos
    assert (last["first"][1], last["steps"][1]) == (info["first"], info["steps"])
    assert last["fault"][1] == info["fault"]
    for env in (envs, alone):
        env.close()
