"""Components with clocks in systems: they tick as they do in an FMU that runs alone."""

import clocks_tools
import numpy as np
import pytest
from fmu_tools import PlainEnv
from pool_tools import open_pool, start, step
from system_tools import (
    closing_pools,  # noqa: F401  # the fixture "make"
    linear,
    linear_fmu,
)

from fmugym import FMU, Component, ConfigError, FMUSystem

COUNTS = tuple(f"count of {name}" for name in clocks_tools.CLOCKS)
LASTS = tuple(f"last {name}" for name in clocks_tools.CLOCKS)
INPUTS = ("strike", "command", "pace")
OUTPUTS = (*COUNTS, *LASTS, "x", "sample", "bell", "countdown", "strike")


@pytest.fixture(scope="module", name="fmus")
def compiled(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clocks")
    names = "CoSimulation", "ModelExchange"
    return {n: clocks_tools.clocks_fmu(folder / f"{n}.fmu", n) for n in names} | {
        "linear": linear_fmu(folder / "linear.fmu", 3),
        "without": clocks_tools.clocks_fmu(folder / "without.fmu", event_mode=False),
    }


def named(names):
    return [f"c.{name}" for name in names]


def run(pool, commands):
    start(pool)
    return np.array([step(pool, *inputs) for inputs in commands])


def commands(count=30, seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack(
        [rng.integers(0, 2, count), rng.normal(size=count), rng.uniform(0.05, 0.6, count)]
    )


@pytest.mark.parametrize("interface", ["CoSimulation", "ModelExchange"])
def test_a_component_does_what_the_fmu_does_alone(make, opened, fmus, interface):
    """A clock that is set ticks once in a step of the environment, in the first of its substeps."""
    fmu = FMU(fmus[interface], probe_timeout=None)
    alone = opened(open_pool(fmu, INPUTS, OUTPUTS, 0.17, 2, substeps=3))
    system = FMUSystem({"c": fmus[interface]})
    pool = make(system, named(INPUTS), named(OUTPUTS), 2, 0.17, substeps=3)
    expected = run(alone, commands())
    assert expected[-1, 6, 0] > 5, "the clock that is set"
    assert run(pool, commands()).tobytes() == expected.tobytes()


def with_follower(fmus, **options):
    """A linear component adds what clocks do to its state, and drives an input with a clock."""
    follower = linear("f", fmus["linear"], b=[[1, 0], [0, 1]], c=np.eye(2))
    return FMUSystem(
        {"c": fmus["CoSimulation"], "f": Component(follower.path, dict(follower.starts))},
        ["c.count of constant -> f.u1", "c.sample -> f.u2", "f.y1 -> c.command"],
        **options,
    )


@pytest.mark.parametrize("master", ["gauss_seidel", "jacobi"])
def test_a_follower_adds_up_what_clocks_do(make, fmus, master):
    """Its inputs are constant over a step: what the clocks have done after it, or before it."""
    names = ["c.count of constant", "c.sample", "f.y1", "f.y2"]
    pool = make(with_follower(fmus, master=master), ["c.strike"], names, 2)
    counts, samples, *sums = run(pool, commands()[:, :1])[:, :, 0].T
    assert counts.tolist() == list(range(1, 31))
    assert np.abs(samples).max() > 0
    for driving, found in zip((counts, samples), sums, strict=True):
        late = master == "jacobi"
        expected = np.cumsum(0.1 * np.append([0.0] * late, driving)[: len(driving)])
        assert found == pytest.approx(expected)


class Env(PlainEnv):
    def __init__(self, fmu, inputs="c.strike", outputs=("c.x", "c.bell", "c.strike", "f.y2")):
        config = {
            "model_input_names": inputs,
            "model_output_names": outputs,
            "time_step": 0.1,
            "max_episode_steps": 8,
        }
        super().__init__(fmu, config)


class TestRefusals:
    @pytest.mark.parametrize(
        "connection", ["c.bell -> d.strike", "c.x -> d.strike", "c.bell -> told", "go -> c.strike"]
    )
    def test_clocks_are_not_connected(self, fmus, connection):
        path = fmus["CoSimulation"]
        with pytest.raises(ConfigError, match=r"[cd]\.(bell|strike) is a clock") as error:
            FMUSystem({"c": path, "d": path}, [connection])
        assert connection in str(error.value)

    def test_clocks_that_tick_by_themselves_are_no_inputs(self, fmus):
        system = FMUSystem({"c": fmus["CoSimulation"]})
        names = {port.name for port in system.open_inputs}
        assert {"c.strike", "c.plain"} <= names
        assert "c.constant" not in names
        with pytest.raises(ConfigError, match=r"'c\.constant'.*triggered"):
            Env(system, "c.constant", "c.x")

    def test_clocks_need_event_mode(self, fmus):
        system = FMUSystem({"c": fmus["without"], "d": fmus["CoSimulation"]})
        with pytest.raises(ConfigError, match=r"'c\.strike'.*event mode"):
            Env(system, "c.strike", "c.x")

    def test_clocks_have_no_start_values(self, fmus):
        with pytest.raises(ConfigError, match=r"c\.strike"):
            FMUSystem({"c": Component(fmus["CoSimulation"], {"strike": 1})})
