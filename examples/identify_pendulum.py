"""Find the parameters of a pendulum cell from its free swings.

    pip install -e ".[examples,identification]"
    python examples/identify_pendulum.py

The cell is simulated: a pendulum with viscous and Coulomb friction. Its log at 50 Hz has the
resolution of an encoder and a noisy velocity. The program prints the parameters that two fits find,
with the half width of the 95 % confidence interval, and how the residuals of the angle depend on
those before:

- A model without Coulomb friction makes b far too large. Its residuals are no noise.
- The model with Coulomb friction finds the truth.

It writes a plot of a swing that no fit has seen, measured and simulated.
"""

import argparse
from pathlib import Path

import numpy as np

import fmugym
from fmugym.identification import (
    FitResult,
    Trajectory,
    fit_parameters,
    plot_comparison,
)

CELL = {"m": 0.06, "l": 0.1, "b": 4e-4, "c": 2e-3}  # the true values: kg, m, N m s/rad, N m
SAMPLING = 0.02  # s
ENCODER_STEP = 4.794e-5  # rad
VELOCITY_NOISE = 0.04  # rad/s
UNITS = {"l": "m", "b": "N m s/rad", "c": "N m"}


class Cell(fmugym.FMUEnv):
    """The cell, swinging freely."""

    vectorized = True

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


def fit(swings: list[Trajectory], *, coulomb: bool) -> FitResult:
    """Fit the FMU's parameters and each swing's initial state by simulation."""
    friction = {"c": (1e-3, 0.0, 0.01)} if coulomb else {}
    return fit_parameters(
        fmugym.bundled_fmu("Pendulum"),
        {"l": (0.05, 0.2), "b": (1e-3, 0.0, 0.01), **friction},
        swings,
        initial_states={"q_0": "q", "q_dot_0": "q_dot"},
        fixed={"m": CELL["m"]},  # a free swing does not reveal the mass
        scales={"q": ENCODER_STEP, "q_dot": VELOCITY_NOISE},
    )


def print_rows(title: str, found: FitResult) -> None:
    """Print the parameters that one fit has found."""
    print(f"\n{title}: autocorrelation {found.correlations['q'].first:.2f}")
    for name, (low, high) in found.confidence_intervals().items():
        text = f"{found.values[name]:10.5g} +- {(high - low) / 2:.1g}"
        print(f"  {name:3} {text:22} true {CELL[name]:9.5g} {UNITS[name]}")


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

    print_rows("viscous friction only", fit(swings, coulomb=False))
    found = fit(swings, coulomb=True)
    print_rows("with Coulomb friction", found)

    unseen = found.predict([log_swing(2.5, options.seconds, rng)])
    print(f"\nunseen swing: RMS {np.degrees(unseen.rms('q')):.3f} degrees")
    figure = plot_comparison(unseen, labels={"q": "q [rad]", "q_dot": "q_dot [rad/s]"})
    figure.savefig(options.output, dpi=120)
    print(f"plot: {options.output}")


if __name__ == "__main__":
    main()
