"""Odd arguments of ``fmugym.control.identification``: each call works or is refused."""

import functools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from odd_values import ODD, odd_calls, working_or_refused

from fmugym import FMUGymError, bundled_fmu
from fmugym.control.identification import Trajectory, fit_parameters, plot_comparison

TIME = np.arange(0.0, 0.4, 0.02)
SWING = {"q": np.cos(9.9 * TIME), "q_dot": -9.9 * np.sin(9.9 * TIME)}
MEASURED = {"time": TIME, "outputs": SWING, "inputs": {"tau": 0.0}, "label": "x"}
FIT = {
    "fmu": str(bundled_fmu("Pendulum")),
    "parameters": {"l": (0.05, 0.2)},
    "trajectories": [Trajectory(TIME, SWING)] * 3,
    "initial_states": {"q_0": "q"},
    "fixed": {"g": 9.81},
    "scales": {"q": 1.0},
    "time_step": 0.02,
    "wash_in": 0.1,
    "candidates": 1,
}


@functools.cache
def fitted():
    return fit_parameters(**FIT)


CALLS = {
    "fit_parameters": (fit_parameters, FIT),
    "Trajectory": (Trajectory, MEASURED),
    "select": (FIT["trajectories"][0].select, {"chosen": slice(3)}),
    "intervals": (lambda **odd: fitted().confidence_intervals(**odd), {"level": 0.95}),
    "rms": (lambda **odd: fitted().rms(**odd), {"output": "q"}),
    "rows": (lambda **odd: fitted().rows(**odd), {"count": 3, "seed": 0}),
    "predict": (lambda **odd: fitted().predict(**odd), {"trajectories": FIT["trajectories"]}),
    "residuals": (lambda **odd: fitted().comparison.residuals(**odd), {"output": "q"}),
    "plot": (
        lambda labels, of=None: plot_comparison(fitted().comparison if of is None else of, labels),
        {"labels": {"q": "angle"}, "of": None},
    ),
}


@pytest.mark.parametrize("name", CALLS)
def test_sound_arguments_work(name):
    call, arguments = CALLS[name]
    call(**arguments)


@pytest.mark.parametrize("name", FIT)
@pytest.mark.parametrize("odd", ["\x1b[31m", -1j, object()], ids=type)
def test_a_fit_with_a_wrong_argument_is_refused(name, odd):
    with pytest.raises(FMUGymError):
        fit_parameters(**FIT | {name: odd})


@given(odd_calls(CALLS))
def test_a_call_with_odd_arguments_works_or_is_refused(drawn):
    call, arguments = drawn
    with working_or_refused():
        call(**arguments)


@given(
    st.sampled_from(("parameters", "initial_states", "fixed", "scales")),
    st.sampled_from(("l", "m", "q", "q_0", "zzz")),
    ODD,
)
def test_a_fit_with_an_odd_value_of_a_variable_works_or_is_refused(argument, name, odd):
    with working_or_refused():
        fit_parameters(**FIT | {argument: {name: odd}})


@given(st.sampled_from(("outputs", "inputs")), ODD)
def test_a_trajectory_with_an_odd_signal_works_or_is_refused(argument, odd):
    with working_or_refused():
        Trajectory(**MEASURED | {argument: {"q": odd}})
