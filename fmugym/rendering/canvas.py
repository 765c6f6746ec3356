"""An anti-aliased drawing surface in world coordinates."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fmugym.checks import check_integer, check_number, items_of
from fmugym.errors import ConfigError, shown
from fmugym.rendering._pygame import pygame

Color: TypeAlias = tuple[int, int, int]
Point: TypeAlias = tuple[float, float]
_Points: TypeAlias = NDArray[np.float64]

_ARC_STEP: Final = math.radians(2.0)  # keeps chords within 0.1 pixel up to a radius of 600 pixels
_HEAD_LENGTH: Final = 2.6  # of an arrow, in shaft thicknesses
_HEAD_HALF_WIDTH: Final = 1.55  # of an arrow, in shaft thicknesses
_SUPERSAMPLING: Final = 4  # a power of two: for others, pygame's weights do not sum to one
_MOST_PIXELS: Final = 2**28  # of the supersampled picture, about 1 GB

_CallT = TypeVar("_CallT", bound=Callable[..., Any])


def _drawing(method: _CallT) -> _CallT:
    """Name the method in errors about its arguments."""

    @functools.wraps(method)
    def draw(self: "Canvas", *arguments: Any, **options: Any) -> Any:
        try:
            return method(self, *arguments, **options)
        except ConfigError:
            raise
        except Exception as error:  # objects may do anything when they are converted
            what = shown((*arguments, options))
            raise ConfigError(
                f"Canvas.{method.__name__} cannot draw {what}: {shown(error)}"
            ) from error

    return cast(_CallT, draw)


@dataclass(frozen=True)
class World:
    """The part of the world that a picture shows at least; y points up.

    Args:
        left: Smallest x, in the unit of the scene, usually m.
        bottom: Smallest y.
        right: Largest x.
        top: Largest y.

    Raises:
        ConfigError: If the bounds are not finite or enclose no area.
    """

    left: float
    bottom: float
    right: float
    top: float

    def __post_init__(self) -> None:
        for name in ("left", "bottom", "right", "top"):
            object.__setattr__(self, name, check_number(f"bounds: {name}", getattr(self, name)))
        spans = (self.right - self.left, self.top - self.bottom)
        if not all(math.isfinite(span) and span > 0.0 for span in spans):
            raise ConfigError(f"bounds must be finite, with left < right, bottom < top: {self}")


class Canvas:
    """Draws filled shapes at four times the picture's size and scales them down smoothly.

    The world is centred in the picture, with the same scale for both axes. The canvas omits
    shapes with coordinates that are not finite, and clips shapes outside the picture.

    Args:
        size: Width and height of the picture, in pixels.
        world: The part of the world to show.

    Raises:
        ConfigError: If an argument has a wrong type or is out of its range. The methods raise it
            for arguments that cannot be drawn.
    """

    def __init__(self, size: tuple[int, int], world: World) -> None:
        if not isinstance(world, World):
            raise ConfigError(f"expected a World, not {shown(world)}")
        width, height = self.size = size = checked_size(size)
        self._drawn = pygame.Surface((width * _SUPERSAMPLING, height * _SUPERSAMPLING), 0, 32)
        self._picture = pygame.Surface(size, 0, 32)
        self._fonts: dict[int, pygame.font.Font] = {}
        self._set_view(world)

    def _set_view(self, world: World) -> None:
        width, height = self._drawn.get_size()
        self._scale = min(width / (world.right - world.left), height / (world.top - world.bottom))
        self._origin = (
            0.5 * width - self._scale * 0.5 * (world.left + world.right),
            0.5 * height + self._scale * 0.5 * (world.bottom + world.top),
        )

    @_drawing
    def clear(self, color: Color) -> None:
        """Fill the picture with one colour."""
        self._drawn.fill(color)

    @_drawing
    def polygon(self, points: ArrayLike, color: Color) -> None:
        """Fill a polygon.

        Args:
            points: Three or more corners in world coordinates, shape (corners, 2).
            color: Colour of the inside.
        """
        corners = np.asarray(points, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[1] != 2:
            raise ConfigError(f"points must have the shape (corners, 2), not {corners.shape}")
        pixels = self._pixels(corners)
        if pixels is not None:
            pygame.draw.polygon(self._drawn, color, pixels)

    @_drawing
    def rectangle(
        self, center: Point, width: float, height: float, color: Color, radius: float = 0.0
    ) -> None:
        """Fill an upright rectangle, with corners rounded by `radius` (world units)."""
        across, up = 0.5 * width - radius, 0.5 * height - radius
        signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
        centers = [(center[0] + x * across, center[1] + y * up) for x, y in signs]
        corners = [
            _arc(one, radius, turn * math.pi / 2, math.pi / 2) for turn, one in enumerate(centers)
        ]
        self.polygon(np.concatenate(corners), color)

    @_drawing
    def circle(self, center: Point, radius: float, color: Color) -> None:
        """Fill a circle."""
        self.polygon(_arc(center, radius, 0.0, math.tau), color)

    @_drawing
    def ring(self, center: Point, radius: float, thickness: float, color: Color) -> None:
        """Draw a circular line of a thickness, with its middle at `radius`."""
        self.polygon(_band(center, radius, thickness, 0.0, math.tau), color)

    @_drawing
    def sector(
        self, center: Point, radius: float, start: float, sweep: float, color: Color
    ) -> None:
        """Fill the sector of a circle.

        Args:
            center: Centre of the circle.
            radius: Radius of the circle, in world units.
            start: Angle of the first edge from the x axis, counter-clockwise, in rad.
            sweep: Angle from the first edge to the second, in rad.
            color: Colour of the inside.
        """
        self.polygon(np.concatenate([[center], _arc(center, radius, start, sweep)]), color)

    @_drawing
    def line(self, start: Point, end: Point, thickness: float, color: Color) -> None:
        """Draw a straight line with round ends."""
        angle = math.atan2(end[1] - start[1], end[0] - start[0])
        ends = [
            _arc(start, 0.5 * thickness, angle + math.pi / 2, math.pi),
            _arc(end, 0.5 * thickness, angle - math.pi / 2, math.pi),
        ]
        self.polygon(np.concatenate(ends), color)

    @_drawing
    def arrow(self, start: Point, end: Point, thickness: float, color: Color) -> None:
        """Draw a straight arrow with its tip at `end`, unless its length is 0.

        Args:
            start: Middle of the blunt end, in world coordinates.
            end: The tip, in world coordinates.
            thickness: Thickness of the shaft, in world units; a short arrow is thinner.
            color: Colour of the arrow.
        """
        length = math.hypot(end[0] - start[0], end[1] - start[1])
        if not 0.0 < length < math.inf:
            return
        along = np.subtract(end, start) / length
        across = np.array([-along[1], along[0]])
        thickness = min(thickness, length / _HEAD_LENGTH)
        outline = _arrow_outline(length, thickness)
        self.polygon(np.asarray(start) + outline @ np.array([along, across]), color)

    @_drawing
    def arc_arrow(
        self,
        center: Point,
        radius: float,
        start: float,
        sweep: float,
        thickness: float,
        color: Color,
    ) -> None:
        """Draw an arrow along a circle, unless its sweep is 0.

        Args:
            center: Centre of the circle, in world coordinates.
            radius: Radius of the middle of the shaft, in world units.
            start: Angle of the blunt end from the x axis, counter-clockwise, in rad.
            sweep: Angle from there to the tip, counter-clockwise positive, in rad, within a turn.
            thickness: Thickness of the shaft, in world units; a short arrow is thinner.
            color: Colour of the arrow.
        """
        sweep = min(max(sweep, -math.tau), math.tau)
        if not abs(sweep) > 0.0:
            return
        thickness = min(thickness, radius * abs(sweep) / _HEAD_LENGTH)
        head = math.copysign(_HEAD_LENGTH * thickness / radius, sweep)
        outline = _arc_arrow_outline(radius, sweep, head, thickness)
        angles, radii = start + outline[:, 0], outline[:, 1:]
        self.polygon(np.asarray(center) + radii * _directions(angles), color)

    @_drawing
    def text(
        self, position: Point, text: str, size: int, color: Color, anchor: str = "center"
    ) -> None:
        """Write one line of text at a position in the world.

        Args:
            position: The position of the anchor, in world coordinates.
            text: The text.
            size: Height of the font, in pixels of the picture.
            color: Colour of the text.
            anchor: The point of the text at the position: "center", "midtop", "topleft" or
                another attribute of a `pygame.Rect`.
        """
        pixels = self._pixels(np.array([position]))
        if pixels is not None:
            self._write((pixels[0][0], pixels[0][1]), text, size, color, anchor)

    @_drawing
    def caption(self, pixel: tuple[int, int], text: str, size: int, color: Color) -> None:
        """Write a line of text, with its upper left corner at a pixel of the picture."""
        x, y = pixel[0] * _SUPERSAMPLING, pixel[1] * _SUPERSAMPLING
        self._write((x, y), text, size, color, "topleft")

    def picture(self) -> pygame.Surface:
        """Return the picture; the next call overwrites the surface."""
        pygame.transform.smoothscale(self._drawn, self.size, self._picture)
        return self._picture

    def _pixels(self, points: _Points) -> list[list[int]] | None:
        """Return pixels in or near the picture, or None if a coordinate is not finite."""
        if not np.isfinite(points).all():
            return None
        pixels = np.asarray(self._origin) + points * (self._scale, -self._scale)
        limit = 2 * max(self._drawn.get_size())
        clipped: list[list[int]] = np.rint(np.clip(pixels, -limit, limit)).astype(int).tolist()
        return clipped

    def _write(
        self, drawn: tuple[int, int], text: str, size: int, color: Color, anchor: str
    ) -> None:
        label = self._label(text.replace("\0", ""), size * _SUPERSAMPLING, color)
        self._drawn.blit(label, label.get_rect(**{anchor: drawn}))

    def _label(self, text: str, size: int, color: Color) -> pygame.Surface:
        try:
            return self._font(size).render(text, True, color)
        except pygame.error:  # pygame.quit() in another package closes all fonts
            self._fonts.clear()
            return self._font(size).render(text, True, color)

    def _font(self, size: int) -> pygame.font.Font:
        if size not in self._fonts:
            pygame.font.init()
            self._fonts[size] = pygame.font.Font(None, size)
        return self._fonts[size]


def checked_size(size: Any) -> tuple[int, int]:
    """Return the size of a picture: width and height, in pixels.

    Raises:
        ConfigError: If the size is not a pair of positive integers, or is too large.
    """
    sides = items_of(size)
    if len(sides) != 2:
        raise ConfigError(f"size must be a width and a height, not {shown(size)}")
    width, height = (check_integer("width and height", side, 1, 2**15) for side in sides)
    if width * height * _SUPERSAMPLING**2 > _MOST_PIXELS:
        raise ConfigError(f"a picture of {width} x {height} pixels is too large")
    return width, height


def direction(angle: float) -> Point:
    """Return the unit vector at an angle from the x axis in rad; NaN for an infinite angle."""
    if not math.isfinite(angle):
        return math.nan, math.nan
    return math.cos(angle), math.sin(angle)


def _directions(angles: NDArray[np.float64]) -> _Points:
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _arc(center: Point, radius: float, start: float, sweep: float) -> _Points:
    """Return the points of an arc; NaN if an angle is not finite."""
    if not math.isfinite(start) or not math.isfinite(sweep):
        return np.full((3, 2), math.nan)
    count = 2 + math.ceil(min(abs(sweep), math.tau) / _ARC_STEP)
    return np.asarray(center) + radius * _directions(np.linspace(start, start + sweep, count))


def _band(center: Point, radius: float, thickness: float, start: float, sweep: float) -> _Points:
    """Return the outline of an arc with a thickness."""
    outer = _arc(center, radius + 0.5 * thickness, start, sweep)
    inner = _arc(center, radius - 0.5 * thickness, start + sweep, -sweep)
    return np.concatenate([outer, inner])


def _arrow_outline(length: float, thickness: float) -> _Points:
    """Return the outline of an arrow along the x axis, from the origin."""
    neck, half, wide = (
        length - _HEAD_LENGTH * thickness,
        0.5 * thickness,
        _HEAD_HALF_WIDTH * thickness,
    )
    upper: Sequence[Point] = ((0.0, half), (neck, half), (neck, wide), (length, 0.0))
    lower: Sequence[Point] = ((neck, -wide), (neck, -half), (0.0, -half))
    return np.array([*upper, *lower])


def _arc_arrow_outline(radius: float, sweep: float, head: float, thickness: float) -> _Points:
    """Return the outline of an arrow from angle 0, as rows of angle and radius."""
    neck = sweep - head
    angles = np.linspace(0.0, neck, 2 + math.ceil(abs(neck) / _ARC_STEP))
    half, wide = 0.5 * thickness, _HEAD_HALF_WIDTH * thickness
    outer = np.column_stack([angles, np.full_like(angles, radius + half)])
    inner = np.column_stack([angles[::-1], np.full_like(angles, radius - half)])
    tip = [(neck, radius + wide), (sweep, radius), (neck, radius - wide)]
    return np.concatenate([outer, tip, inner])
