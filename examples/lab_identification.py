"""Measure the length of a pendulum in the simulated lab, with four cells at a time.

Each of four threads lets its cell fall from several random angles. Least squares over all swings
gives the parameters of q'' = -p1 q' - p2 sin(q), and p2 = g / l gives the length. This takes 18 s
in real time. With `--fast`, the program advances the lab's clock itself and takes about 1 s.

For the real lab, change the import of `Client` and `CellType`, leave out `Lab`, and use your token.
"""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmugym.lab import CellType, Client, Lab, ManualClock

CELLS = 4
SWINGS = 3  # per cell
LEASE = 30  # s
SWING_TIME = 5.0  # s
PERIOD = 0.02  # s, between two samples
GRAVITY = 9.81  # m/s^2

Swing = tuple[list[float], list[float]]


def record_swing(gym_token: str, angle: float, clock: Any) -> Swing:
    """Let a cell fall from an angle [rad]; return the angles [rad] and velocities [rad/s]."""
    client = Client()
    positions, velocities = [], []
    token, _ = client.start_episode(
        gym_token, "SimplePendulum", SWING_TIME, initial_position=[angle]
    )
    client.set_impedance_controller_params([0.0], [0.0], token)  # torque control without torque
    start = clock.time()
    for tick in range(1, round(SWING_TIME / PERIOD)):
        positions.append(client.get_position(token))
        velocities.append(client.get_velocity(token))
        clock.sleep(max(0.0, start + tick * PERIOD - clock.time()))
    client.stop_episode(token)
    return positions, velocities


def collect(user_token: str, angles: Sequence[float], clock: Any = time) -> list[Swing]:
    """Reserve the cells and record a swing from each angle, with one thread per cell.

    Args:
        user_token: Your token.
        angles: The start angles [rad].
        clock: Gives the time and sleeps: `time`, or the lab's clock.
    """
    client, swings = Client(), []
    make_thread = getattr(clock, "thread", None) or (
        lambda target, args: threading.Thread(target=target, args=args)
    )
    gym_token = client.start_gym(user_token, LEASE, [CellType.SINGLE] * CELLS)

    def work(own_angles: Sequence[float]) -> None:
        swings.extend(record_swing(gym_token, angle, clock) for angle in own_angles)

    threads = [make_thread(work, (angles[cell::CELLS],)) for cell in range(CELLS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    client.stop_gym(gym_token)
    return swings


def fit(swings: Sequence[Swing], with_coulomb: bool = False) -> NDArray[np.float64]:
    """Return p1 [1/s], p2 [1/s^2] and, if requested, the Coulomb friction [1/s^2]."""
    q, v = np.array(swings).transpose(1, 0, 2)  # each of shape (swings, samples)
    acceleration = (v[:, 2:] - v[:, :-2]) / (2 * PERIOD)
    q, v = q[:, 1:-1], v[:, 1:-1]
    regressor = [-v, -np.sin(q)] + [-np.tanh(v / 0.05)] * with_coulomb
    columns = np.stack([column.ravel() for column in regressor], axis=1)
    return np.linalg.lstsq(columns, acceleration.ravel(), rcond=None)[0]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the experiment and print the results."""
    parser = argparse.ArgumentParser(description="Measure the length of the lab's pendulum.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fast", action="store_true", help="do not wait for real time")
    options = parser.parse_args(arguments)
    angles = np.random.default_rng(options.seed).uniform(-np.pi, np.pi, CELLS * SWINGS)
    clock = ManualClock() if options.fast else None
    with Lab(clock=clock, seed=options.seed):
        swings = collect("my token", angles, clock or time)
    p1, p2 = fit(swings)
    print(f"{len(swings)} swings: p1 = {p1:.3f} 1/s, length = {100 * GRAVITY / p2:.2f} cm")
    p1, p2, p3 = fit(swings, with_coulomb=True)
    inertia = 0.06 * 0.1**2  # kg m^2
    print(f"with Coulomb friction: p1 = {p1:.3f} 1/s, length = {100 * GRAVITY / p2:.2f} cm,")
    print(f"  b = {1e3 * p1 * inertia:.3f} mN m s/rad, c = {1e3 * p3 * inertia:.2f} mN m")


if __name__ == "__main__":
    main()
