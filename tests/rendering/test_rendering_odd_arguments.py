"""Odd arguments of ``fmugym.rendering``: each call draws, or is refused with an error."""

import pytest
from hypothesis import given
from odd_values import Unspeakable, odd_calls, working_or_refused

from fmugym import ConfigError
from fmugym.rendering import (
    Canvas,
    CartPoleFrame,
    CartPoleScene,
    Overlay,
    PendulumFrame,
    PendulumScene,
    Renderer,
    World,
)

RED, HERE = (255, 0, 0), (0.0, 0.0)
BOUNDS = {"left": -1.0, "bottom": -1.0, "right": 1.0, "top": 1.0}
CANVAS = {"size": (40, 40), "world": World(**BOUNDS)}
PENDULUM, FRAME, OVERLAY = PendulumScene(1.0), PendulumFrame(1.0), Overlay(0.0)
RENDERER = {"scene": PENDULUM, "fps": 50.0, "size": (40, 40), "render_mode": "rgb_array"}


def drawing(shape):
    """A function that draws a shape."""

    def draw(**arguments):
        canvas = Canvas(**CANVAS)
        getattr(canvas, shape)(**arguments)
        return canvas.picture()

    return draw


def render(scene=PENDULUM, frame=FRAME, overlay=None, **options):
    return Renderer(scene, **{"size": (40, 40)} | options).render(frame, overlay)


SHAPES = {
    "clear": {},
    "polygon": {"points": [(0, 0), (1, 0), (0, 1)]},
    "rectangle": {"center": HERE, "width": 0.5, "height": 0.4, "radius": 0.1},
    "circle": {"center": HERE, "radius": 0.5},
    "ring": {"center": HERE, "radius": 0.5, "thickness": 0.1},
    "sector": {"center": HERE, "radius": 0.5, "start": 0.0, "sweep": 1.0},
    "line": {"start": HERE, "end": (0.5, 0.5), "thickness": 0.1},
    "arrow": {"start": HERE, "end": (0.5, 0.5), "thickness": 0.1},
    "arc_arrow": {"center": HERE, "radius": 0.5, "start": 0.0, "sweep": 1.0, "thickness": 0.1},
    "text": {"position": HERE, "text": "x", "size": 12, "anchor": "center"},
    "caption": {"pixel": (1, 1), "text": "x", "size": 12},
}
SHAPES = {shape: (drawing(shape), {**sound, "color": RED}) for shape, sound in SHAPES.items()}
PICTURES = {
    "canvas": (Canvas, CANVAS),
    "world": (lambda **odd: Canvas((40, 40), World(**odd)).circle(HERE, 0.5, RED), BOUNDS),
    "scene of a cart-pole": (
        lambda **odd: render(CartPoleScene(**odd), CartPoleFrame(0.1, 0.1)),
        {"x_threshold": 2.4, "pole_length": 1.0, "angle_threshold": 0.2, "force_scale": 1.0},
    ),
    "scene of a pendulum": (lambda **odd: render(PendulumScene(**odd)), {"torque_limit": 1.0}),
    "frame": (lambda **odd: render(frame=PendulumFrame(**odd)), {"angle": 1.0, "torque": 0.5}),
    "overlay": (
        lambda **odd: render(overlay=Overlay(**odd)),
        {"time": 0.0, "action": "+1 N", "reward": 1.0, "episode_return": 2.0},
    ),
    "picture": (render, {"frame": FRAME, "overlay": OVERLAY}),
    "renderer": (render, RENDERER | {"title": "x"}),
}


@pytest.mark.parametrize("name", SHAPES | PICTURES)
def test_sound_arguments_are_drawn(name):
    call, arguments = (SHAPES | PICTURES)[name]
    call(**arguments)


@pytest.mark.parametrize("odd", [None, "x", [[]], Unspeakable()], ids=type)
def test_a_radius_that_is_no_length_is_refused(odd):
    draw, arguments = SHAPES["circle"]
    with pytest.raises(ConfigError, match="circle"):
        draw(**arguments | {"radius": odd})


@given(odd_calls(SHAPES))
def test_a_shape_with_odd_arguments_is_drawn_or_refused(drawn):
    call, arguments = drawn
    with working_or_refused():
        call(**arguments)


@given(odd_calls(PICTURES))
def test_a_picture_with_odd_arguments_is_drawn_or_refused(drawn):
    call, arguments = drawn
    with working_or_refused():
        call(**arguments)
