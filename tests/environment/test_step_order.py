"""Every way of calling hooks follows the one order of a step."""

import numpy as np
from vector_tools import Drawing
from ways import in_way

ORDER = (
    *("_get_inputs", "_update", "_is_done", "_is_truncated", "_reward_policy"),
    *("_get_observation", "_get_info"),
)
CALLED = []


class Recording(Drawing):
    """Notes which hooks are called, and what they read of the hooks before them."""

    def __init__(self, **changes):
        super().__init__(episode_variables={"updates": 0.0}, **changes)

    def _note(self, hook, value):
        CALLED.append(hook)
        return value

    def _get_inputs(self):
        return self._note("_get_inputs", self.action)

    def _update(self):
        self.variables["updates"] = self.variables["updates"] + 1.0
        self._note("_update", None)

    def _is_done(self):
        return self._note("_is_done", self.variables["updates"] >= 2.0)

    def _is_truncated(self):
        return self._note("_is_truncated", self.done & (self.step_count == 2))

    def _reward_policy(self):
        return self._note("_reward_policy", np.where(self.done, -1.0, self.variables["updates"]))

    def _get_observation(self):
        return self._note("_get_observation", np.array(self.state, np.float32))

    def _get_info(self):
        return self._note("_get_info", {"updates": self.variables["updates"]})


def played(env, action):
    """The hooks of two steps, and what came of them."""
    env.reset(seed=1)
    CALLED.clear()
    results = [env.step(action) for _ in range(2)]
    values = [[np.ravel(part)[0].item() for part in result[1:4]] for result in results]
    return list(CALLED), values


EXPECTED = [[1.0, False, False], [-1.0, True, True]]


def test_of_one_environment():
    env = Recording()
    called, values = played(env, np.zeros(1, np.float32))
    assert called == [*ORDER, *ORDER]
    assert values == EXPECTED
    CALLED.clear()
    env.reset()
    assert tuple(CALLED) == ORDER[-2:]
    env.close()


def test_on_arrays(make_envs):
    env = make_envs(in_way("arrays", Recording), 3)
    called, values = played(env, np.zeros((3, 1), np.float32))
    assert called == [*ORDER, *ORDER]
    assert values == EXPECTED


def test_one_environment_at_a_time(make_envs):
    """The FMUs step between the first hook of all environments and the others."""
    env = make_envs(in_way("one by one", Recording), 3)
    called, values = played(env, np.zeros((3, 1), np.float32))
    step = [ORDER[0]] * 3 + [*ORDER[1:]] * 3
    assert called == [*step, *step]
    assert values == EXPECTED
