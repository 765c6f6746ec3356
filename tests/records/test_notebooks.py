"""What a notebook shows: objects in a line, figures as pictures, bars."""

import sys
import types

import pytest
from fmu_tools import HERE

import fmugym
from fmugym.envs import CartPoleEnv
from fmugym.records.progress_bars import no_progress, progress_bar


def test_objects_are_shown_in_one_informative_line(make_envs):
    env = CartPoleEnv()
    single = "<CartPoleEnv of CartPole.fmu: f -> x, x_dot, phi, phi_dot every 0.02 s>"
    assert repr(env) == single
    many = make_envs(CartPoleEnv, 3)
    assert repr(many) == f"<FMUVectorEnv of 3: {single}>"
    path = fmugym.bundled_fmu("House")
    told = f"FMU({str(path)!r}: House, FMI 2.0, 4 inputs, 9 outputs, 17 parameters)"
    assert repr(fmugym.FMU(path)) == told
    task = fmugym.Task.read(HERE.parent / "examples" / "cart_pole.toml")
    assert repr(task).startswith("Task('cart_pole.toml': ['f'] -> ['x', ")
    assert repr(fmugym.Task.from_dict({"class": "a:B"})) == "Task('task': 'a:B')"
    env.close()


class Failing(fmugym.FMI2CSEnv):
    """Its step size is that of the FMU; without one, its constructor fails."""

    def __init__(self, fmu_path):
        config = {"model_input_names": "tau", "model_output_names": "q"}
        try:
            super().__init__(fmu_path, config)
        except fmugym.FMULoadError:
            self.shown = repr(self)

    def _is_done(self):
        return False


def test_environments_can_be_shown_at_any_time():
    assert "Failing object" in Failing("absent.fmu").shown
    env = Failing(fmugym.bundled_fmu("Pendulum"))
    assert repr(env) == "<Failing of Pendulum.fmu: tau -> q every 0.01 s>"
    env.close()


def test_figures_are_pictures_without_a_magic_line():
    pytest.importorskip("matplotlib", reason="needs matplotlib: the extra test")
    env = fmugym.records.RecordSeries(CartPoleEnv())
    env.reset(seed=0)
    env.step(0)
    assert fmugym.records.plot(env.series)._repr_png_().startswith(b"\x89PNG")
    env.close()


def test_bars_are_shown_in_notebooks(monkeypatch):
    drawn = []

    class Bar:
        def __init__(self, **options):
            drawn.append(options["total"])

        def __enter__(self):
            return self

        def __exit__(self, *_):
            """Nothing is open."""

        def update(self, steps):
            drawn.append(steps)

    stream = type("OutStream", (), {"__module__": "ipykernel.iostream", "isatty": lambda _: False})
    monkeypatch.setitem(sys.modules, "tqdm", types.SimpleNamespace(tqdm=Bar))
    with progress_bar(7, "play") as advance:
        assert advance is no_progress
    monkeypatch.setattr(sys, "stderr", stream())
    with progress_bar(7, "play") as advance:
        advance(3)
    assert drawn == [7, 3]
