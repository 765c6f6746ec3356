"""Scenes of the bundled models: the cart-pole and the pendulum."""

import math
from dataclasses import dataclass
from typing import Final

from fmugym.checks import check_number
from fmugym.errors import ConfigError, shown
from fmugym.rendering import palette
from fmugym.rendering.canvas import Canvas, Point, World, direction

_LARGEST_FORCE: Final = 1.6  # of the drawn force, as a multiple of `force_scale`
_LARGEST_SWEEP: Final = math.radians(150.0)  # of the torque arrow at the torque limit

_TORQUE_RADIUS: Final = 0.5  # of the torque arrow, in rods
_HALF_ROD: Final = 0.045  # half the thickness of the rod, in rods


@dataclass(frozen=True)
class CartPoleFrame:
    """One moment of a cart-pole.

    Args:
        x: Position of the cart, in m, positive to the right.
        angle: Angle of the pole from upright, in rad, positive to the right.
        force: Force on the cart, in N, positive to the right.
    """

    x: float
    angle: float
    force: float = 0.0


@dataclass(frozen=True)
class PendulumFrame:
    """One moment of a pendulum.

    Args:
        angle: Angle from upright, in rad, counter-clockwise positive.
        torque: Torque at the pivot, in N m, counter-clockwise positive.
    """

    angle: float
    torque: float = 0.0


@dataclass(frozen=True)
class CartPoleScene:
    """A cart with its pole on a track between two limits, and the force as an arrow.

    Args:
        x_threshold: Distance of each limit from the middle of the track, in m.
        pole_length: Length of the pole from axle to tip, in m.
        angle_threshold: Largest angle of the pole from upright, in rad, drawn as a shade behind
            the pole. None for no limit, with room for the pole below the track.
        force_scale: The force whose arrow is a fifth of `x_threshold` long, in N.

    Raises:
        ConfigError: If a length, angle or force is not positive and finite.
    """

    x_threshold: float
    pole_length: float
    angle_threshold: float | None = None
    force_scale: float = 10.0

    def __post_init__(self) -> None:
        for name in ("x_threshold", "pole_length", "force_scale", "angle_threshold"):
            value = getattr(self, name)
            if value is not None or name != "angle_threshold":
                object.__setattr__(self, name, check_number(name, value, positive=True))

    @property
    def world(self) -> World:
        """The track, the reach of the pole, and space for the figures at the top."""
        reach = 1.15 * self.pole_length
        top = self._axle_height + reach + 0.3 * self.x_threshold
        bottom = -0.2 * self.x_threshold
        if self.angle_threshold is None:
            bottom = min(bottom, self._axle_height - reach)
        return World(-1.32 * self.x_threshold, bottom, 1.32 * self.x_threshold, top)

    def draw(self, canvas: Canvas, frame: CartPoleFrame) -> None:
        """Draw the track, the cart, its pole and the force on it.

        Raises:
            ConfigError: If the frame lacks a number.
        """
        x, angle, force = _numbers(frame, "x", "angle", "force")
        axle = (x, self._axle_height)
        self._draw_angle_limit(canvas, axle)
        self._draw_track(canvas)
        self._draw_force(canvas, x, force)
        self._draw_cart(canvas, x)
        self._draw_pole(canvas, axle, angle)

    @property
    def _unit(self) -> float:
        """The length that scales the cart, in m."""
        return self.x_threshold / 22.0

    @property
    def _axle_height(self) -> float:
        return 3.0 * self._unit

    def _draw_angle_limit(self, canvas: Canvas, axle: Point) -> None:
        if self.angle_threshold is not None:
            limit = min(self.angle_threshold, math.pi)
            start, radius = math.pi / 2 - limit, 1.12 * self.pole_length
            canvas.sector(axle, radius, start, 2.0 * limit, palette.SHADE)

    def _draw_track(self, canvas: Canvas) -> None:
        unit, end = self._unit, 1.2 * self.x_threshold
        canvas.line((-end, 0.0), (end, 0.0), 0.3 * unit, palette.FAINT)
        for quarter in range(-4, 5):
            self._draw_tick(canvas, 0.25 * quarter * self.x_threshold, quarter % 4 == 0)
        for limit in (-self.x_threshold, self.x_threshold):
            canvas.line((limit, 0.0), (limit, 2.6 * unit), 0.45 * unit, palette.MUTED)

    def _draw_tick(self, canvas: Canvas, x: float, is_labelled: bool) -> None:
        unit = self._unit
        canvas.line((x, 0.0), (x, -0.75 * unit), 0.18 * unit, palette.FAINT)
        if is_labelled:
            size = round(min(canvas.size) / 21)
            canvas.text((x, -1.2 * unit), f"{x:g} m", size, palette.MUTED, anchor="midtop")

    def _draw_force(self, canvas: Canvas, x: float, force: float) -> None:
        ratio = min(max(force / self.force_scale, -_LARGEST_FORCE), _LARGEST_FORCE)
        unit, side = self._unit, math.copysign(2.7 * self._unit, force)
        start = (x + side, 1.9 * unit)
        end = (start[0] + 0.2 * self.x_threshold * ratio, start[1])
        canvas.arrow(start, end, 0.65 * unit, palette.ACCENT)

    def _draw_cart(self, canvas: Canvas, x: float) -> None:
        unit = self._unit
        canvas.rectangle((x, 1.9 * unit), 4.8 * unit, 2.1 * unit, palette.INK, radius=0.45 * unit)
        for wheel in (x - 1.45 * unit, x + 1.45 * unit):
            canvas.circle((wheel, 0.96 * unit), 0.78 * unit, palette.BACKGROUND)
            canvas.circle((wheel, 0.75 * unit), 0.6 * unit, palette.INK)
            canvas.circle((wheel, 0.75 * unit), 0.22 * unit, palette.BACKGROUND)

    def _draw_pole(self, canvas: Canvas, axle: Point, angle: float) -> None:
        along = direction(math.pi / 2 - angle)
        tip = (axle[0] + self.pole_length * along[0], axle[1] + self.pole_length * along[1])
        canvas.line(axle, tip, 0.85 * self._unit, palette.STEEL)
        canvas.circle(axle, 0.62 * self._unit, palette.INK)
        canvas.circle(axle, 0.3 * self._unit, palette.BACKGROUND)


@dataclass(frozen=True)
class PendulumScene:
    """A rod with a bob that turns around a pivot, and the torque as a curved arrow.

    The rod has length 1 in the picture, regardless of its length in the model. The arrow starts at
    the rod and points in the direction of the torque.

    Args:
        torque_limit: The torque whose arrow sweeps 150 degrees, in N m. Arrows of larger torques
            have the same length.

    Raises:
        ConfigError: If the torque limit is not positive and finite.
    """

    torque_limit: float

    def __post_init__(self) -> None:
        limit = check_number("torque_limit", self.torque_limit, positive=True)
        object.__setattr__(self, "torque_limit", limit)

    @property
    def world(self) -> World:
        """The circle of the bob, and space for the figures at the top."""
        return World(-1.5, -1.4, 1.5, 1.75)

    def draw(self, canvas: Canvas, frame: PendulumFrame) -> None:
        """Draw the circle of the bob, the torque, the rod and its pivot.

        Raises:
            ConfigError: If the frame lacks a number.
        """
        angle, torque = _numbers(frame, "angle", "torque")
        self._draw_circle(canvas)
        self._draw_torque(canvas, angle, torque)
        self._draw_rod(canvas, angle)

    def _draw_circle(self, canvas: Canvas) -> None:
        canvas.ring((0.0, 0.0), 1.0, 0.014, palette.FAINT)
        for quarter in range(4):
            x, y = direction(math.pi / 2 * quarter)
            color = palette.MUTED if quarter == 1 else palette.FAINT
            canvas.line((1.21 * x, 1.21 * y), (1.27 * x, 1.27 * y), 0.022, color)

    def _draw_torque(self, canvas: Canvas, angle: float, torque: float) -> None:
        sweep = _LARGEST_SWEEP * min(max(torque / self.torque_limit, -1.0), 1.0)
        start = angle + math.pi / 2 + math.copysign(_HALF_ROD / _TORQUE_RADIUS, torque)
        canvas.arc_arrow((0.0, 0.0), _TORQUE_RADIUS, start, sweep, 0.075, palette.ACCENT)

    def _draw_rod(self, canvas: Canvas, angle: float) -> None:
        tip = direction(angle + math.pi / 2)
        canvas.line((0.0, 0.0), tip, 2.0 * _HALF_ROD, palette.STEEL)
        canvas.circle(tip, 0.145, palette.INK)
        canvas.circle((0.0, 0.0), 0.115, palette.INK)
        canvas.circle((0.0, 0.0), 0.05, palette.BACKGROUND)


def _numbers(frame: object, *names: str) -> list[float]:
    """Return numbers of a frame, which may be NaN or infinite."""
    try:
        return [float(getattr(frame, name)) for name in names]
    except Exception:  # a frame may be any object
        wanted = ", ".join(names)
        raise ConfigError(f"a frame needs the numbers {wanted}: {shown(frame)}") from None
