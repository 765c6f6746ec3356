"""The renderer, its window, the canvas and the scenes of the bundled models."""

import logging
import math
import os
import pickle
import subprocess
import sys

import numpy as np
import pygame
import pytest
from combinations import in_turn

from fmugym.errors import ConfigError
from fmugym.rendering import (
    Canvas,
    CartPoleFrame,
    CartPoleScene,
    Overlay,
    PendulumFrame,
    PendulumScene,
    Renderer,
    World,
    palette,
)

CART_POLE = CartPoleScene(x_threshold=2.4, pole_length=1.0, angle_threshold=math.radians(12))
PENDULUM = PendulumScene(torque_limit=2.0)
UPRIGHT = CartPoleFrame(x=0.0, angle=0.0)
FAR_VALUES = [math.nan, math.inf, -math.inf, 1e308, -1e308, 1e6, np.float32(3e38)]


def cart_pole_picture(frame, overlay=None, scene=CART_POLE):
    return Renderer(scene, size=(600, 400)).render(frame, overlay)


def pendulum_picture(frame, overlay=None):
    return Renderer(PENDULUM, size=(500, 500)).render(frame, overlay)


def mask(picture, color):
    return (np.abs(picture.astype(int) - color) <= 2).all(axis=2)


def middle(picture, color):
    """Mean position of a colour, x to the right and y up, in pixels."""
    rows, columns = np.nonzero(mask(picture, color))
    return columns.mean(), -rows.mean()


def area(picture, color):
    return mask(picture, color).sum()


class TestArrays:
    @pytest.mark.parametrize("size", [(600, 400), (500, 500), (123, 77)])
    def test_shape_is_height_width_and_colours(self, size):
        picture = Renderer(CART_POLE, size=size).render(UPRIGHT)
        assert picture.shape == (size[1], size[0], 3)
        assert picture.dtype == np.uint8

    def test_arrays_are_fresh_and_writable(self):
        renderer = Renderer(CART_POLE)
        first = renderer.render(CartPoleFrame(-1.0, 0.2))
        kept = first.copy()
        second = renderer.render(CartPoleFrame(1.0, -0.2))
        np.testing.assert_array_equal(first, kept)
        assert (first != second).any()
        second[:] = 0
        np.testing.assert_array_equal(renderer.render(CartPoleFrame(-1.0, 0.2)), kept)

    def test_nothing_of_the_last_frame_is_left(self):
        renderer = Renderer(CART_POLE)
        renderer.render(CartPoleFrame(1.0, 0.2, 10.0), Overlay(9.0, "+10.0 N", 1.0, 9.0))
        again = renderer.render(UPRIGHT)
        np.testing.assert_array_equal(again, cart_pole_picture(UPRIGHT))

    def test_background_is_off_white_to_the_corners(self):
        picture = cart_pole_picture(UPRIGHT)
        assert tuple(picture[0, 0]) == tuple(picture[-1, -1]) == palette.BACKGROUND

    def test_edges_are_smooth(self):
        picture = cart_pole_picture(CartPoleFrame(0.0, 0.3), scene=CartPoleScene(2.4, 1.0))
        beside_the_pole = picture[150:230, 300:340].reshape(-1, 3)
        assert len(np.unique(beside_the_pole, axis=0)) > 8

    def test_no_video_driver_is_needed_and_nothing_is_printed(self):
        code = (
            "import os, warnings, fmugym\n"
            "os.environ.pop('PYGAME_HIDE_SUPPORT_PROMPT', None)  # gymnasium sets it for good\n"
            "before = dict(os.environ)\n"
            "warnings.simplefilter('error')\n"
            "from fmugym.rendering import Overlay, PendulumFrame, PendulumScene, Renderer\n"
            "assert dict(os.environ) == before\n"
            "picture = Renderer(PendulumScene(2.0)).render(PendulumFrame(1.0, 1.0), Overlay(0.0))\n"
            "import pygame\n"
            "assert picture.std() > 0 and not pygame.display.get_init()"
        )
        hidden = ("DISPLAY", "WAYLAND_DISPLAY")
        environment = {name: value for name, value in os.environ.items() if name not in hidden}
        environment["SDL_VIDEODRIVER"] = "there is none of this name"
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")

    def test_text_survives_another_package_quitting_pygame(self):
        renderer = Renderer(PENDULUM)
        before = renderer.render(PendulumFrame(0.3), Overlay(1.0))
        pygame.quit()
        np.testing.assert_array_equal(before, renderer.render(PendulumFrame(0.3), Overlay(1.0)))

    def test_closing_twice_is_fine_and_arrays_are_still_made(self):
        renderer = Renderer(PENDULUM)
        renderer.close()
        before = renderer.render(PendulumFrame(0.3))
        renderer.close()
        renderer.close()
        np.testing.assert_array_equal(before, renderer.render(PendulumFrame(0.3)))

    def test_an_unused_renderer_can_be_pickled(self):
        copy = pickle.loads(pickle.dumps(Renderer(CART_POLE)))
        np.testing.assert_array_equal(copy.render(UPRIGHT), cart_pole_picture(UPRIGHT))

    def test_unknown_render_mode_is_refused_by_name(self):
        with pytest.raises(ConfigError, match="'ansi'"):
            Renderer(CART_POLE, render_mode="ansi")


class TestCartPole:
    @pytest.mark.parametrize("angle", [0.5, 0.1, -0.5])
    def test_pole_is_where_the_angle_says(self, angle):
        """The middle of a rod is at half its length, seen from the axle."""
        x0, y0 = middle(cart_pole_picture(CartPoleFrame(0.0, 0.0)), palette.STEEL)
        x, y = middle(cart_pole_picture(CartPoleFrame(0.0, angle)), palette.STEEL)
        scale = 600 / (2 * 1.32 * 2.4)  # pixels per m
        assert x - x0 == pytest.approx(0.5 * scale * math.sin(angle), abs=3.0)
        assert y - y0 == pytest.approx(0.5 * scale * (math.cos(angle) - 1.0), abs=3.0)

    def test_cart_follows_x(self):
        left, right = (cart_pole_picture(CartPoleFrame(x, 0.0)) for x in (-1.0, 1.0))
        distance = middle(right, palette.INK)[0] - middle(left, palette.INK)[0]
        assert distance == pytest.approx(2.0 * 600 / (2 * 1.32 * 2.4), abs=1.0)

    def test_force_arrow_appears_flips_and_grows(self):
        none, left, right, weak = (
            cart_pole_picture(CartPoleFrame(0.0, 0.0, force)) for force in (0.0, -10.0, 10.0, 5.0)
        )
        assert area(none, palette.ACCENT) == 0
        assert middle(left, palette.ACCENT)[0] < 280 < 320 < middle(right, palette.ACCENT)[0]
        assert 0 < area(weak, palette.ACCENT) < area(right, palette.ACCENT)

    def test_force_arrow_at_the_limit_is_in_view(self):
        inside, at_limit = (cart_pole_picture(CartPoleFrame(x, 0.0, 10.0)) for x in (0.0, 2.2))
        areas = [area(picture, palette.ACCENT) for picture in (inside, at_limit)]
        assert areas[1] == pytest.approx(areas[0], rel=0.1)

    def test_limits_are_marked_on_both_sides(self):
        columns = np.nonzero(mask(cart_pole_picture(UPRIGHT)[220:280], palette.MUTED))[1]
        scale = 600 / (2 * 1.32 * 2.4)
        assert columns.min() == pytest.approx(300 - 2.4 * scale, abs=4)
        assert columns.max() == pytest.approx(300 + 2.4 * scale, abs=4)

    def test_angle_limit_is_shown_only_if_there_is_one(self):
        assert area(cart_pole_picture(UPRIGHT), palette.SHADE) > 1000
        assert area(cart_pole_picture(UPRIGHT, scene=CartPoleScene(2.4, 1.0)), palette.SHADE) < 50

    def test_a_hanging_pole_is_in_view(self):
        scene = CartPoleScene(x_threshold=0.4, pole_length=1.2)
        areas = [
            area(cart_pole_picture(CartPoleFrame(0.0, angle), scene=scene), palette.STEEL)
            for angle in (0.0, math.pi)
        ]
        assert areas[1] == pytest.approx(areas[0], rel=0.1)

    @in_turn({"value": FAR_VALUES, "name": ["x", "angle", "force"]})
    def test_values_out_of_range_leave_the_track(self, name, value):
        frame = CartPoleFrame(**{"x": 0.0, "angle": 0.0, "force": 0.0, name: value})
        picture = cart_pole_picture(frame, Overlay(value, "", value, value))
        assert area(picture, palette.FAINT) > 100

    @in_turn(
        {
            "value": [0.0, -1.0, math.inf, math.nan],
            "name": ["x_threshold", "pole_length", "angle_threshold"],
        }
    )
    def test_impossible_measures_are_refused_by_name(self, name, value):
        measures = {"x_threshold": 2.4, "pole_length": 1.0, "angle_threshold": 0.2, name: value}
        with pytest.raises(ConfigError, match=name):
            CartPoleScene(**measures)


class TestPendulum:
    @pytest.mark.parametrize("angle", [0.5, -0.5, 2.0, math.pi])
    def test_rod_is_where_the_angle_says(self, angle):
        """The tip is at (-sin angle, cos angle)."""
        x0, y0 = middle(pendulum_picture(PendulumFrame(0.0)), palette.STEEL)
        x, y = middle(pendulum_picture(PendulumFrame(angle)), palette.STEEL)
        seen = 0.5 * (0.115 + 0.855) * 500 / 3.15  # from the pivot's edge to the bob's, in pixels
        assert x - x0 == pytest.approx(-seen * math.sin(angle), abs=4.0)
        assert y - y0 == pytest.approx(seen * (math.cos(angle) - 1.0), abs=4.0)

    def test_torque_arrow_appears_and_flips_side(self):
        none, left, right = (
            pendulum_picture(PendulumFrame(0.0, torque)) for torque in (0.0, 1.0, -1.0)
        )
        assert area(none, palette.ACCENT) == 0
        assert middle(left, palette.ACCENT)[0] < 240 < 260 < middle(right, palette.ACCENT)[0]

    def test_torque_arrow_grows_up_to_the_limit(self):
        torques = (0.2, 1.0, 2.0, 200.0)
        areas = [
            area(pendulum_picture(PendulumFrame(0.0, torque)), palette.ACCENT) for torque in torques
        ]
        assert 0 < areas[0] < areas[1] < areas[2] == areas[3]

    @in_turn({"value": FAR_VALUES, "name": ["angle", "torque"]})
    def test_values_out_of_range_leave_the_circle(self, name, value):
        frame = PendulumFrame(**{"angle": 0.0, "torque": 0.0, name: value})
        assert area(pendulum_picture(frame), palette.FAINT) > 100

    def test_a_torque_limit_of_zero_is_refused(self):
        with pytest.raises(ConfigError, match="torque_limit"):
            PendulumScene(0.0)


class TestOverlay:
    def test_every_figure_changes_the_picture(self):
        plain = {"time": 1.0, "action": "+10.0 N", "reward": 1.0, "episode_return": 5.0}
        other = {"time": 1.01, "action": "-10.0 N", "reward": None, "episode_return": 4.0}
        before = cart_pole_picture(UPRIGHT, Overlay(**plain))
        for name, value in other.items():
            after = cart_pole_picture(UPRIGHT, Overlay(**{**plain, name: value}))
            assert (before != after).any(), name

    @pytest.mark.parametrize("scene", [CART_POLE, PENDULUM])
    def test_figures_are_above_the_scene(self, scene):
        frame = UPRIGHT if scene is CART_POLE else PendulumFrame(0.0)
        size = (600, 400) if scene is CART_POLE else (500, 500)
        renderer = Renderer(scene, size=size)
        plain = renderer.render(frame)
        written = renderer.render(frame, Overlay(12.34, "+10.0 N", 1.0, 200.0))
        rows = np.nonzero((plain != written).any(axis=(1, 2)))[0]
        assert (plain[: rows.max() + 1] == palette.BACKGROUND).all()
        assert area(written[: rows.max() + 1], palette.INK) > 100

    def test_long_and_odd_texts_are_clipped(self):
        overlay = Overlay(math.nan, "a\0" * 500, -1e300, math.inf)
        assert cart_pole_picture(UPRIGHT, overlay).shape == (400, 600, 3)


class TestCanvas:
    @pytest.fixture
    def canvas(self):
        canvas = Canvas((200, 100), World(left=0.0, bottom=0.0, right=2.0, top=1.0))
        canvas.clear(palette.BACKGROUND)
        return canvas

    def draw_area(self, canvas):
        pixels = pygame.surfarray.array3d(canvas.picture()).transpose(1, 0, 2)
        return (
            np.abs(pixels.astype(int) - palette.BACKGROUND).sum()
            / np.abs(np.subtract(palette.INK, palette.BACKGROUND)).sum()
        )

    def test_areas_of_shapes(self, canvas):
        """100 pixels are one world unit; an edge may be off by a third of a pixel."""
        shapes = [
            (lambda: canvas.circle((1.0, 0.5), 0.4, palette.INK), math.pi * 40**2),
            (lambda: canvas.rectangle((1.0, 0.5), 1.5, 0.6, palette.INK), 150 * 60),
            (lambda: canvas.ring((1.0, 0.5), 0.3, 0.2, palette.INK), math.pi * (40**2 - 20**2)),
            (lambda: canvas.sector((1.0, 0.1), 0.8, 0.5, 1.0, palette.INK), 0.5 * 80**2),
            (lambda: canvas.polygon([(0, 0), (1, 0), (0, 1)], palette.INK), 100 * 100 / 2),
        ]
        for draw, expected in shapes:
            canvas.clear(palette.BACKGROUND)
            draw()
            assert self.draw_area(canvas) == pytest.approx(expected, rel=0.03)

    def test_y_points_up(self, canvas):
        canvas.circle((0.2, 0.9), 0.05, palette.INK)
        assert canvas.picture().get_at((20, 10))[:3] == palette.INK

    def test_one_scale_serves_both_axes(self):
        canvas = Canvas((300, 100), World(-1.0, -1.0, 1.0, 1.0))
        canvas.clear(palette.BACKGROUND)
        canvas.rectangle((0.0, 0.0), 2.0, 2.0, palette.INK)
        picture = canvas.picture()
        assert picture.get_at((104, 50))[:3] == picture.get_at((195, 50))[:3] == palette.INK
        assert picture.get_at((95, 50))[:3] == picture.get_at((204, 50))[:3] == palette.BACKGROUND

    def test_arrow_ends_at_its_tip(self, canvas):
        canvas.arrow((0.2, 0.5), (1.2, 0.5), 0.1, palette.INK)
        picture = pygame.surfarray.array3d(canvas.picture()).transpose(1, 0, 2)
        columns = np.nonzero((picture != palette.BACKGROUND).any(axis=(0, 2)))[0]
        assert (columns.min(), columns.max()) == pytest.approx((20, 120), abs=1)

    def test_text_is_placed_in_the_world_and_skipped_at_nan(self, canvas):
        canvas.text((math.nan, 0.5), "lost", 30, palette.INK)
        assert self.draw_area(canvas) == 0
        canvas.text((1.5, 0.5), "here", 30, palette.INK)
        picture = pygame.surfarray.array3d(canvas.picture()).transpose(1, 0, 2)
        assert middle(picture, palette.INK) == pytest.approx((150, -50), abs=5)

    @pytest.mark.parametrize("bounds", [(0, 0, 0, 1), (0, 1, 1, 0), (0, 0, math.inf, 1)])
    def test_a_world_without_area_is_refused(self, bounds):
        with pytest.raises(ConfigError, match="bounds"):
            World(*bounds)


def test_a_scene_of_the_users_own():
    class TankScene:
        world = World(left=-1.0, bottom=0.0, right=1.0, top=2.0)

        def draw(self, canvas, level):
            canvas.rectangle((0.0, level / 2.0), 1.0, level, palette.ACCENT)

    renderer = Renderer(TankScene(), size=(100, 100))
    assert area(renderer.render(1.0), palette.ACCENT) == pytest.approx(50 * 50, rel=0.05)


class TestWindow:
    @pytest.fixture(autouse=True)
    def no_display(self, monkeypatch):
        monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
        pygame.display.quit()
        yield
        pygame.display.quit()

    @pytest.fixture
    def open_window(self, opened):
        def open_window(scene=CART_POLE, size=(600, 400), fps=1000.0, **options):
            return opened(Renderer(scene, size, fps, render_mode="human", **options))

        return open_window

    def test_a_frame_is_shown(self, open_window):
        assert open_window(title="My cart").render(UPRIGHT) is None
        shown = pygame.surfarray.array3d(pygame.display.get_surface()).transpose(1, 0, 2)
        np.testing.assert_array_equal(shown, cart_pole_picture(UPRIGHT))
        assert pygame.display.get_caption()[0] == "My cart"

    def test_frames_take_their_time(self, open_window):
        renderer = open_window(fps=50.0)
        renderer.render(UPRIGHT)
        before = pygame.time.get_ticks()
        for _ in range(5):
            renderer.render(UPRIGHT)
        assert pygame.time.get_ticks() - before >= 80  # ms, of 100

    def test_nothing_opens_before_the_first_frame(self, open_window):
        open_window().close()
        assert not pygame.display.get_init()

    def test_closing_twice_closes_the_display_once(self, open_window):
        renderer = open_window()
        renderer.render(UPRIGHT)
        renderer.close()
        assert not pygame.display.get_init()
        pygame.display.init()
        renderer.close()
        assert renderer.render(UPRIGHT) is None
        assert pygame.display.get_init()
        assert pygame.display.get_surface() is None

    def test_closing_one_leaves_the_other(self, open_window):
        one, other = open_window(), open_window(PENDULUM, size=(500, 500))
        one.render(UPRIGHT)
        other.render(PendulumFrame(0.1))
        one.close()
        assert pygame.display.get_surface().get_size() == (500, 500)
        other.render(PendulumFrame(0.2))
        other.close()
        assert not pygame.display.get_init()

    def test_arrays_do_not_touch_the_window(self, open_window):
        window, arrays = open_window(), Renderer(CART_POLE)
        window.render(UPRIGHT)
        arrays.render(UPRIGHT)
        arrays.close()
        assert pygame.display.get_surface() is not None
        window.close()
        assert arrays.render(UPRIGHT).shape == (400, 600, 3)

    def test_a_display_opened_by_the_program_stays(self, open_window):
        pygame.display.init()
        renderer = open_window()
        renderer.render(UPRIGHT)
        renderer.close()
        assert pygame.display.get_init()

    def test_the_user_may_close_the_window(self, open_window, caplog):
        one, other = open_window(), open_window()
        one.render(UPRIGHT)
        other.render(UPRIGHT)
        pygame.event.post(pygame.event.Event(pygame.QUIT))
        with caplog.at_level(logging.INFO):
            for renderer in (one, other, one, other):
                assert renderer.render(UPRIGHT) is None
        assert not pygame.display.get_init()
        assert [record.name for record in caplog.records] == ["fmugym.rendering.renderer"]
        one.close()

    def test_keys_are_left_to_the_program(self, open_window):
        renderer = open_window()
        renderer.render(UPRIGHT)
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_LEFT))
        pygame.event.post(pygame.event.Event(pygame.MOUSEMOTION, pos=(0, 0)))
        renderer.render(UPRIGHT)
        assert [event.key for event in pygame.event.get(pygame.KEYDOWN)] == [pygame.K_LEFT]
        assert not pygame.event.get(pygame.MOUSEMOTION)

    def test_the_window_comes_back_when_another_package_quits_pygame(self, open_window):
        renderer = open_window()
        renderer.render(UPRIGHT)
        pygame.quit()
        renderer.render(UPRIGHT, Overlay(1.0))
        assert pygame.display.get_surface() is not None

    def test_a_new_window_may_follow_a_closed_one(self, open_window):
        first = open_window()
        first.render(UPRIGHT)
        pygame.event.post(pygame.event.Event(pygame.QUIT))
        first.render(UPRIGHT)
        open_window().render(UPRIGHT)
        assert pygame.display.get_surface() is not None


def test_a_window_without_a_display_says_so_each_time(monkeypatch):
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "no such driver")
    renderer = Renderer(PendulumScene(1.0), render_mode="human")
    for _ in range(2):
        with pytest.raises(ConfigError, match="needs a display"):
            renderer.render(PendulumFrame(0.0))
    renderer.close()
