"""Odd arguments of ``fmugym.rendering``: each call ends well or in an error of the package.

    python tests/tools/fuzz_rendering.py --count 4000 --seed 0

A case makes one object or draws one shape with one or two arguments of a wrong type, range or
shape. See ``fuzz_driver.py``.
"""

import sys

from fuzz_driver import main, of_kinds
from odd_values import odd, spoil

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

BOUNDS = {"left": -1.0, "bottom": -1.0, "right": 1.0, "top": 1.0}
RED, HERE = (255, 0, 0), (0.0, 0.0)
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
RENDERER = {
    "scene": PendulumScene(1.0),
    "size": (40, 40),
    "fps": 50.0,
    "render_mode": "rgb_array",
    "title": "x",
}
OVERLAY = {"time": 0.0, "action": "+1 N", "reward": 1.0, "episode_return": 2.0}


def shape(rng, folder):
    name = rng.choice(tuple(SHAPES))
    arguments = spoil(rng, SHAPES[name] | {"color": RED})
    canvas = Canvas((40, 40), World(**BOUNDS))
    return lambda: (getattr(canvas, name)(**arguments), canvas.picture())


def canvas(rng, folder):
    spoiled = spoil(rng, {"size": (40, 40), "world": World(**BOUNDS)})
    return lambda: Canvas(**spoiled)


def world(rng, folder):
    spoiled = spoil(rng, BOUNDS)
    return lambda: Canvas((40, 40), World(**spoiled)).circle(HERE, 0.5, RED)


def scene(rng, folder):
    arguments = {"x_threshold": 2.4, "pole_length": 1.0, "angle_threshold": 0.2}
    spoiled = spoil(rng, arguments | {"force_scale": 1.0})
    if rng.random() < 0.3:
        limit = odd(rng)
        return lambda: Renderer(PendulumScene(limit), (40, 40)).render(PendulumFrame(0.1, 1.0))
    return lambda: Renderer(CartPoleScene(**spoiled), (40, 40)).render(CartPoleFrame(0.1, 0.1))


def frame(rng, folder):
    """Draw an odd frame, or a frame of odd values, perhaps with an odd overlay."""
    spoiled = spoil(rng, {"angle": 1.0, "torque": 0.5})
    overlay = spoil(rng, OVERLAY)
    value = rng.choice((odd, lambda _: PendulumFrame(**spoiled)))(rng)
    corner = rng.choice((lambda: None, lambda: odd(rng), lambda: Overlay(**overlay)))
    return lambda: Renderer(PendulumScene(1.0), (40, 40)).render(value, corner())


def renderer(rng, folder):
    spoiled = spoil(rng, RENDERER)
    return lambda: Renderer(**spoiled).render(PendulumFrame(1.0), Overlay(0.0))


program = of_kinds((shape, shape, canvas, world, scene, frame, renderer))


if __name__ == "__main__":
    sys.exit(main(program, __doc__))
