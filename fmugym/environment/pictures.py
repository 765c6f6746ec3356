"""Pictures of an environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium

from fmugym.checks import check_option
from fmugym.environment.hooks import Hooks
from fmugym.errors import ConfigError, SimulationError, shown

if TYPE_CHECKING:
    from fmugym.rendering import Overlay, Renderer

__all__ = ["Pictured", "note_for_picture"]

_GYMNASIUM_MODES = ("human", "rgb_array", "ansi", "rgb_array_list", "ansi_list")


class Pictured(Hooks):
    """The part of ``FMUEnv`` that makes pictures."""

    render_size: ClassVar[tuple[int, int]] = (600, 400)
    """Width and height of the pictures in pixels."""

    _was_reset: bool = False
    _renderer: Renderer[Any] | None = None
    """Draws the pictures, once there are any."""

    _pictured: tuple[float | None, float] = None, 0.0
    """The reward and the return that a picture shows."""

    @property
    def time(self) -> float:
        """The FMU's time in seconds."""
        raise NotImplementedError

    def _checked_render_mode(self, mode: Any) -> str | None:
        """Warn of a mode that the class does not support, and go on without pictures.

        Some libraries ask every environment for pictures: ``make_vec_env`` of Stable-Baselines3,
        for example. A mode that Gymnasium does not know is an error.
        """
        known = list(self.metadata.get("render_modes", ()))
        if mode is None:
            return None
        if not isinstance(mode, str) or mode not in _GYMNASIUM_MODES:
            return check_option("render mode", mode, known)
        if mode in known:
            return mode
        gymnasium.logger.warn(
            f"{type(self).__name__} has no render_mode {mode!r}, only {known}; "
            "it goes on without pictures"
        )
        return None

    def render(self) -> Any:
        """Draw the current state.

        Returns:
            In the mode ``rgb_array``, an array of shape (height, width, 3) and type uint8. In the
            mode ``human``, None; a window shows the picture.

        Raises:
            SimulationError: Before the first reset.
            ConfigError: If a hook does not return what a picture needs.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render was called, but no render_mode was given at construction")
            return None
        if not self._was_reset:
            raise SimulationError("render was called before the first reset")
        if self._renderer is None:
            self._renderer = self._make_renderer(self.render_mode)
        return self._renderer.render(self._get_frame(), self._overlay())

    def _make_renderer(self, mode: str) -> Renderer[Any]:
        from fmugym.rendering import Renderer  # pygame takes a while to import

        scene = self._get_scene()
        if not callable(getattr(scene, "draw", None)):
            raise ConfigError(f"_get_scene returned {shown(scene)}, expected a scene with 'draw'")
        fps = 1 / self.interface.time_step
        return Renderer(scene, self.render_size, fps, mode, type(self).__name__)

    def _overlay(self) -> Overlay:
        from fmugym.rendering import Overlay

        action = self._describe_action() if self.step_count else ""
        if not isinstance(action, str):
            raise ConfigError(f"_describe_action returned {shown(action)}, expected text")
        return Overlay(self.time, action, *self._pictured)


def note_for_picture(env: Pictured, reward: float) -> None:
    """Note the reward of a step of an environment with pictures; a window shows it at once."""
    env._pictured = reward, env._pictured[1] + reward
    if env.render_mode == "human":
        env.render()
