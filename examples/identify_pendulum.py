"""Find the parameters of a pendulum cell from its free swings, in three ways.

    pip install -e ".[examples,identification]"
    python examples/identify_pendulum.py

The cell is simulated: a pendulum with viscous and Coulomb friction. Its log at 50 Hz has the
resolution of an encoder and a noisy velocity. The program prints the parameters that each fit
finds, with the half width of the 95 % confidence interval:

- Least squares without a Coulomb term makes p1 far too large.
- Least squares with a Coulomb term leaves the error of central differences at 50 Hz. The interval
  does not include this error.
- The fit by simulation has neither error.

It writes a plot of a swing that no fit has seen, measured and simulated.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path

import numpy as np

import fmugym
from fmugym.identification import (
    FitResult,
    SwingFit,
    Trajectory,
    fit_parameters,
    fit_swing,
    plot_comparison,
)

CELL = {"m": 0.06, "l": 0.1, "b": 4e-4, "c": 2e-3}  # the true values: kg, m, N m s/rad, N m
SAMPLING = 0.02  # s
ENCODER_STEP = 4.794e-5  # rad
VELOCITY_NOISE = 0.04  # rad/s
INERTIA = CELL["m"] * CELL["l"] ** 2
TRUTH = {"p1": CELL["b"] / INERTIA, "p2": 9.81 / CELL["l"], "p3": CELL["c"] / INERTIA, **CELL}
UNITS = {"p1": "1/s", "p2": "1/s^2", "p3": "rad/s^2", "l": "m", "b": "N m s/rad", "c": "N m"}


class Cell(fmugym.FMUEnv):
    """The cell, swinging freely."""

    def __init__(self, angle: float) -> None:
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {**CELL, "q_0": angle},
            "time_step": SAMPLING,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config)

    def _is_done(self) -> bool:
        return False


def log_swing(angle: float, seconds: float, rng: np.random.Generator) -> Trajectory:
    """Let the cell swing from an angle [rad] and return the log."""
    cell = Cell(angle)
    cell.reset()
    states = [cell.state]
    for _ in range(round(seconds / SAMPLING)):
        cell.step(np.zeros(1))
        states.append(cell.state)
    cell.close()
    q, q_dot = np.array(states).T
    q = ENCODER_STEP * np.round(q / ENCODER_STEP)
    q_dot = q_dot + rng.normal(0.0, VELOCITY_NOISE, len(q_dot))
    return Trajectory(np.arange(len(q)) * SAMPLING, {"q": q, "q_dot": q_dot})


def regressions(swings: list[Trajectory]) -> dict[str, SwingFit]:
    """Fit by linear least squares, without and with Coulomb friction."""
    q, q_dot = ([swing.outputs[name] for swing in swings] for name in ("q", "q_dot"))
    return {
        "least squares": fit_swing(SAMPLING, q, q_dot),
        "least squares, with Coulomb friction": fit_swing(SAMPLING, q, q_dot, coulomb=True),
    }


def simulation_fit(swings: list[Trajectory]) -> FitResult:
    """Fit the FMU's parameters and each swing's initial state by simulation."""
    return fit_parameters(
        fmugym.bundled_fmu("Pendulum"),
        {"l": (0.05, 0.2), "b": (1e-3, 0.0, 0.01), "c": (1e-3, 0.0, 0.01)},
        swings,
        initial_states={"q_0": "q", "q_dot_0": "q_dot"},
        fixed={"m": CELL["m"]},  # a free swing does not reveal the mass
        scales={"q": ENCODER_STEP, "q_dot": VELOCITY_NOISE},
    )


def print_rows(
    title: str, values: Mapping[str, float], intervals: Mapping[str, tuple[float, float]]
) -> None:
    """Print the parameters that one fit has found."""
    print(f"\n{title}")
    for name, (low, high) in intervals.items():
        half = (high - low) / 2
        found = f"{values[name]:10.5g} +- {half:.1g}"
        print(f"  {name:3} {found:22} true {TRUTH[name]:9.5g} {UNITS[name]}")


def main() -> None:
    """Log swings, fit them, print the results and plot a comparison."""
    parser = argparse.ArgumentParser(description="Identify a simulated pendulum cell.")
    parser.add_argument("--swings", type=int, default=4, help="number of swings (%(default)s)")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of each (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of angles and noise (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("identified_pendulum.png"))
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    angles = rng.uniform(-np.pi, np.pi, options.swings)
    swings = [log_swing(angle, options.seconds, rng) for angle in angles]

    for title, fit in regressions(swings).items():
        print_rows(title, {**fit.values, "l": fit.l}, fit.confidence_intervals())
    found = simulation_fit(swings)
    print_rows("simulation", found.values, found.confidence_intervals())

    unseen = found.predict([log_swing(2.5, options.seconds, rng)])
    print(f"\nunseen swing: RMS {np.degrees(unseen.rms('q')):.3f} degrees")
    figure = plot_comparison(unseen, labels={"q": "q [rad]", "q_dot": "q_dot [rad/s]"})
    figure.savefig(options.output, dpi=120)
    print(f"plot: {options.output}")


if __name__ == "__main__":
    main()
