"""What a signal handler raises while values of users are converted."""

import numpy as np
import pytest
from vector_tools import (
    Drawing,
    RingError,
    Ringing,
    handler,  # noqa: F401  # the fixture "handler"
)

pytestmark = pytest.mark.usefixtures("handler")
HOOKS = ("per_env", "array")
ZEROS = np.zeros((2, 1), np.float32)


class Returning(Drawing):
    """Hooks return what is set, from the second step on."""

    hook, value = "", None

    def _value(self, hook, otherwise):
        return self.value if hook == self.hook else otherwise

    def _get_inputs(self):
        return self._value("_get_inputs", self.action)

    def _reward_policy(self):
        return self._value("_reward_policy", 1.0 + 0.0 * self.state[0])

    def _is_truncated(self):
        return self._value("_is_truncated", self.state[0] > 100.0)

    def _get_info(self):
        return {"x": self._value("_get_info", self.state[0])}


@pytest.mark.parametrize("hooks", HOOKS)
def test_it_comes_out_of_actions(hooks, make_envs):
    envs = make_envs(Returning, 2, hooks=hooks)
    envs.reset(seed=0)
    with pytest.raises(RingError):
        envs.step(Ringing())
    envs.step(ZEROS)  # the FMUs have not moved
    with pytest.raises(RingError):
        envs.reset(options={"reset_mask": Ringing()})


@pytest.mark.parametrize(
    ("hooks", "hook"),
    [("per_env", "_get_inputs")]
    + [("array", f"_{n}") for n in ("get_inputs", "reward_policy", "get_info", "is_truncated")],
)
def test_it_comes_out_of_what_hooks_return(hooks, hook, monkeypatch, make_envs):
    envs = make_envs(Returning, 2, hooks=hooks)
    envs.reset(seed=0)
    envs.step(ZEROS)
    monkeypatch.setattr(Returning, "hook", hook)
    monkeypatch.setattr(Returning, "value", Ringing())
    with pytest.raises(RingError):
        envs.step(ZEROS)


def test_it_comes_out_of_a_single_environment(monkeypatch):
    env = Returning()
    env.reset(seed=0)
    with pytest.raises(RingError):
        env.step(Ringing())
    env.step(ZEROS[0])
    env.close()
