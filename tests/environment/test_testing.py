"""``check_fmu_env`` finds what it is for."""

import logging

import gymnasium as gym
import numpy as np
import pytest

import fmugym
from fmugym import ConfigError, ContractError
from fmugym.environment.env_checker import check_fmu_env


class Sound(fmugym.FMUEnv):
    def __init__(self, **parameters):
        config = {
            "model_input_names": ["tau"],
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"q_0": 1.0, **parameters},
            "time_step": 0.02,
            "bounds": {"tau": (-0.1, 0.1)},
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config)
        self.counter = 0

    def _is_done(self):
        return False


class Undetermined(Sound):
    count = 0

    def _get_info(self):
        return {}

    def _reward_policy(self):
        Undetermined.count += 1
        return Undetermined.count


class Forgetful(Sound):
    """Its counter survives the reset."""

    def _update(self):
        self.counter += 1

    def _reward_policy(self):
        return float(self.counter)


class TooNarrow(Sound):
    def _get_observation_space(self):
        return gym.spaces.Box(-0.5, 0.5, (2,), np.float32)


class SameArray(Sound):
    def _get_observation(self):
        if not hasattr(self, "kept"):
            self.kept = np.zeros(2, np.float32)
        self.kept[:] = self.state
        return self.kept


class Failing(Sound):
    def _get_inputs(self):
        return 0.0 if self.step_count < 5 else 1e300

    def __init__(self):
        config = {"model_input_names": "f", "model_output_names": "x", "time_step": 0.02}
        fmugym.FMUEnv.__init__(self, fmugym.bundled_fmu("CartPole"), config)


class Infinite(Sound):
    def _reward_policy(self):
        return float("inf")


@pytest.mark.parametrize(
    ("env_class", "text"),
    [
        (Undetermined, "same seed and actions differ: at step 1 reward"),
        (Forgetful, "reset does not restore everything: .*at step 1 reward"),
        (TooNarrow, "is not in Box"),
        (SameArray, "returns the same array again|reset does not|differ"),
        (Failing, "a step with a sampled action failed: .* returned Discard"),
        (Infinite, "_reward_policy returned inf"),
    ],
)
def test_a_broken_environment_is_found(env_class, text):
    env = env_class()
    with pytest.raises(ContractError, match=text):
        check_fmu_env(env)
    env.close()


def test_a_sound_environment_passes_and_is_left_alone():
    env = Sound()
    env.reset(seed=1)
    env.step(0.05)
    before = env.state, env.time, env.step_count
    check_fmu_env(env)
    assert (env.state, env.time, env.step_count) == before
    env.close()


def test_parameters_without_effect_are_named(caplog):
    env = Sound(theta_dot_max=40.0)
    with caplog.at_level(logging.WARNING):
        check_fmu_env(env)
    assert "parameter 'theta_dot_max' has no effect" in caplog.text
    assert "'q_0'" not in caplog.text
    env.close()


def test_other_environments_are_refused():
    with pytest.raises(ConfigError, match="expected an environment of fmugym, got CartPoleEnv"):
        check_fmu_env(gym.make("CartPole-v1"))
