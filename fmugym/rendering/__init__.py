"""Pictures of environments: a renderer, an anti-aliased canvas and scenes.

A `Renderer` draws the frames of a scene into a window (`render_mode="human"`) or into arrays
(`render_mode="rgb_array"`, which needs no display). The bundled models have the scenes
`CartPoleScene` and `PendulumScene`. For another FMU, write a class with the protocol `Scene`:

    class TankScene:
        world = World(left=-1.0, bottom=0.0, right=1.0, top=2.0)  # m

        def draw(self, canvas: Canvas, frame: float) -> None:
            canvas.rectangle((0.0, frame / 2.0), 1.0, frame, palette.ACCENT)

    renderer = Renderer(TankScene(), size=(400, 400), fps=20, render_mode="rgb_array")
    picture = renderer.render(0.8)
"""

from fmugym.rendering import palette
from fmugym.rendering.canvas import Canvas, Color, Point, World
from fmugym.rendering.renderer import Overlay, Renderer, Scene
from fmugym.rendering.scenes import CartPoleFrame, CartPoleScene, PendulumFrame, PendulumScene

__all__ = [
    "Canvas",
    "CartPoleFrame",
    "CartPoleScene",
    "Color",
    "Overlay",
    "PendulumFrame",
    "PendulumScene",
    "Point",
    "Renderer",
    "Scene",
    "World",
    "palette",
]
