"""Order of the hooks that are called when the FMU has stepped.

Single environments and batches of environments differ in what hooks read and return: numbers or
arrays. They share this order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, Protocol

from fmugym.task.results import as_flag, as_reward

if TYPE_CHECKING:
    from fmugym.task.hooks import Hooks

__all__ = ["NUMBERS", "ORDER", "Form", "Numbers", "call_hooks"]

ORDER: Final = (
    "_get_inputs",
    "_update",
    "_is_done",
    "_is_truncated",
    "_reward_policy",
    "_get_observation",
    "_get_info",
)
"""The hooks of a step. The FMU steps after the first."""


class Form(Protocol):
    """Conversion of results of hooks to numbers or arrays.

    Each method raises ``ConfigError`` with the name of the hook if a result cannot be used.

    Attributes:
        flag_type: Values of this type are flags already; None for no type.
        reward_type: Values of this type are rewards already; None for no type.
    """

    flag_type: type | None
    reward_type: type | None

    def update(self, env: Hooks) -> None:
        """Call ``_update``."""

    def flags(self, hook: str, value: Any) -> Any:
        """Turn the result of ``_is_done`` or ``_is_truncated`` into Booleans."""

    def rewards(self, value: Any) -> Any:
        """Turn the result of ``_reward_policy`` into rewards, which need not be finite."""


class Numbers:
    """The ``Form`` of a single environment."""

    flag_type: type | None = bool
    reward_type: type | None = float

    @staticmethod
    def update(env: Hooks) -> None:
        """See ``Form.update``."""
        env._update()

    flags = staticmethod(as_flag)
    rewards: Callable[[Any], Any] = staticmethod(as_reward)


NUMBERS: Final = Numbers()
"""All single environments share it, so that it stays in the processor's caches."""


def call_hooks(
    env: Hooks, form: Form, stopped: Any, cut_off: Any, observed: Any
) -> tuple[Any, ...]:
    """Ask the hooks for the result of a step.

    Args:
        env: The environment; its attributes hold what hooks read after the step.
        form: What the results become.
        stopped: Whether the FMU has asked to stop; False if none of them has.
        cut_off: Whether the limit of steps is reached.
        observed: The observation if it is there already; None for that of the hook.

    Returns:
        The observation as the hook returned it, the reward, terminated and truncated.
    """
    own = env._own_hooks
    if own.update:
        form.update(env)
    done = env._is_done()
    if type(done) is not form.flag_type:
        done = form.flags("_is_done", done)
    if stopped is not False:
        done = done | stopped
    env._episode.done = done
    if own.is_truncated:
        cut_off = form.flags("_is_truncated", env._is_truncated()) | cut_off
    if observed is None:
        reward, observed = env._reward_and_observation()
    else:
        reward = env._reward_policy()
    if type(reward) is not form.reward_type:
        reward = form.rewards(reward)
    return observed, reward, done, cut_off
