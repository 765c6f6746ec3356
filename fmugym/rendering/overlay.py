"""Overlay of the figures of a step, in a row at the top of a picture."""

from dataclasses import dataclass
from typing import Final

from fmugym.checks import check_text, number_of
from fmugym.rendering import palette
from fmugym.rendering.canvas import Canvas

_NONE: Final = "\N{EN DASH}"


@dataclass(frozen=True)
class Overlay:
    """Figures in the upper left corner of a picture: names, and values below them.

    Args:
        time: Time of the episode, in s.
        action: The action as text with its unit, such as "+10.0 N"; "" before the first step.
        reward: Reward of the last step; None before the first step.
        episode_return: Sum of the rewards of the episode; None before the first step.

    Raises:
        ConfigError: If an argument has a wrong type.
    """

    time: float
    action: str = ""
    reward: float | None = None
    episode_return: float | None = None

    def __post_init__(self) -> None:
        check_text("the action of an overlay", self.action)
        for name in ("time", "reward", "episode_return"):
            value = getattr(self, name)
            if value is not None or name == "time":
                object.__setattr__(self, name, number_of(f"{name} of an overlay", value))

    def draw(self, canvas: Canvas) -> None:
        """Write the figures, in a size that follows the width of the picture."""
        unit = canvas.size[0] / 500.0
        for column, (name, value) in enumerate(self._figures()):
            x = round(unit * (18 + 118 * column))
            canvas.caption((x, round(unit * 15)), name, round(unit * 18), palette.MUTED)
            canvas.caption((x, round(unit * 30)), value, round(unit * 26), palette.INK)

    def _figures(self) -> tuple[tuple[str, str], ...]:
        return (
            ("time", f"{_number(self.time)} s"),
            ("reward", _number(self.reward)),
            ("return", _number(self.episode_return)),
            ("action", self.action or _NONE),
        )


def _number(value: float | None) -> str:
    """Return two decimals, or a power of ten for a number too long for its column."""
    if value is None:
        return _NONE
    return f"{value:.3e}" if abs(value) >= 1e7 else f"{value:.2f}"
