"""Train on a system of three FMUs of two makers: a house in C, a roof and a battery in Python.

The agent runs the heat pump of the house and charges the battery. The sun shines on the roof at
noon, electricity is dear in the evening. Cross-entropy search finds a linear policy in seconds; a
thermostat that leaves the battery alone is the measure.

    pip install '.[examples]' pythonfmu
    python examples/train_system.py --folder results

writes the FMUs and the learning curve.
"""

import argparse
import math
from pathlib import Path

import numpy as np
from pythonfmu.builder import FmuBuilder

import fmugym

ROOF = '''
import math
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class Roof(Fmi2Slave):
    """Weather of a clear day in March, and solar cells under it."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.area, self.T_out, self.I_sol, self.P_pv = 14.0, 278.0, 0.0, 0.0
        self.register_variable(
            Real("area", causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable)
        )
        for name in ("T_out", "I_sol", "P_pv"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        hour = (current_time + step_size) / 3600 % 24
        self.T_out = 278.0 - 6.0 * math.cos((hour - 3.0) * math.pi / 12)
        self.I_sol = max(0.0, 700.0 * math.sin((hour - 6.0) * math.pi / 12))
        self.P_pv = 0.2 * self.area * self.I_sol
        return True
'''

BATTERY = '''
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class Battery(Fmi2Slave):
    """A battery between a house, its solar cells and the grid."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.P_house, self.P_pv, self.command = 0.0, 0.0, 0.0
        self.P_grid, self.charge = 0.0, 0.2
        self.capacity, self.P_max = 10.0 * 3.6e6, 4000.0
        for name in ("P_house", "P_pv", "command"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        for name in ("P_grid", "charge"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))
        for name in ("capacity", "P_max"):
            self.register_variable(
                Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable)
            )

    def do_step(self, current_time, step_size):
        most = (1.0 - self.charge) * self.capacity / step_size / 0.95
        least = -self.charge * self.capacity / step_size
        limit = max(-self.P_max, least), min(self.P_max, most)
        power = min(max(self.command * self.P_max, limit[0]), limit[1])
        self.charge += power * (0.95 if power > 0 else 1.0) * step_size / self.capacity
        self.P_grid = self.P_house - self.P_pv + power / (0.95 if power < 0 else 1.0)
        return True
'''

DAY = 96
"""Steps of 15 minutes."""

TEST_SEED = 10_000
"""Seed of the days on which policies are compared; no day of the training has it."""


def make_system(folder):
    """Build the FMUs and connect them."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, program in (("roof", ROOF), ("battery", BATTERY)):
        (folder / f"{name}.py").write_text(program)
        FmuBuilder.build_FMU(folder / f"{name}.py", dest=folder)
    return fmugym.FMUSystem(
        {
            "roof": folder / "Roof.fmu",
            "house": fmugym.bundled_fmu("House"),
            # Its outputs change in do_step only, which pythonfmu has no way to tell.
            "battery": fmugym.Component(folder / "Battery.fmu", feedthrough=False),
        },
        [
            "roof.T_out -> house.T_out",
            "roof.I_sol -> house.I_sol",
            "roof.P_pv -> battery.P_pv",
            "house.P -> battery.P_house",
            "heating -> house.u",
            "charging -> battery.command",
            "battery.P_grid -> grid",
        ],
        name="house with battery",
        step_size=900.0,
    )


def price(hour):
    """Euro per kWh; thrice as much from 17 to 22 o'clock."""
    return np.where((hour >= 17) & (hour < 22), 0.60, 0.20)


class HomeEnv(fmugym.FMUEnv):
    """A day in March. The reward is the cost in euro, negative, as is a euro for a kelvin hour."""

    vectorized = True

    def __init__(self, system, **options):
        config = {
            "model_input_names": ["heating", "charging"],
            "model_output_names": ["house.T_air", "battery.charge", "roof.P_pv", "grid"],
            "model_parameters": {"house.T_m_0": fmugym.Uniform(291.0, 294.0)},
            "bounds": {"heating": (0.0, 1.0), "charging": (-1.0, 1.0)},
            "time_step": 900.0,
            "max_episode_steps": DAY,
        }
        super().__init__(system, config, **options)

    def _is_done(self):
        return False

    def _reward_policy(self):
        temperature, _, _, grid = self.state
        hour = self.time / 3600 % 24
        sold = np.minimum(grid, 0.0) * 0.06
        cost = (np.maximum(grid, 0.0) * price(hour) + sold) * 900.0 / 3.6e6
        cold = np.maximum(293.15 - temperature, 0.0)
        return -cost - cold * 0.25


def features(observation, step):
    """What the policy sees, each of the order of 1; shape (n, 6)."""
    temperature, charge, power, _ = observation.T
    angle = 2 * math.pi * step / DAY
    ones = np.ones_like(charge)
    parts = (ones, temperature - 293.15, charge - 0.5, power / 2000.0)
    return np.stack([*parts, math.sin(angle) * ones, math.cos(angle) * ones], axis=1)


def returns_of(envs, weights, seed):
    """Play a day with each policy; shape (n,)."""
    observation, _ = envs.reset(seed=seed)
    low, high = envs.single_action_space.low, envs.single_action_space.high
    total = np.zeros(len(weights))
    for step in range(DAY):
        raw = np.einsum("nf,nfa->na", features(observation, step), weights)
        action = np.clip(raw, low, high).astype(np.float32)
        observation, reward, *_ = envs.step(action)
        total += reward
    return total


def thermostat(envs, seed):
    """Heat below 20.2 degrees Celsius, and leave the battery alone."""
    observation, _ = envs.reset(seed=seed)
    total = np.zeros(envs.num_envs)
    for _ in range(DAY):
        action = np.zeros((envs.num_envs, 2), np.float32)
        action[:, 0] = observation[:, 0] < 293.35
        observation, reward, *_ = envs.step(action)
        total += reward
    return total


def train(envs, generations, seed):
    """Search by the cross-entropy method; yield the mean policy and the best returns."""
    draw = np.random.default_rng(seed)
    mean, deviation = np.zeros((6, 2)), np.ones((6, 2))
    mean[0, 0] = 0.3
    for generation in range(generations):
        weights = mean + deviation * draw.normal(size=(envs.num_envs, 6, 2))
        total = returns_of(envs, weights, seed + generation)
        best = weights[np.argsort(total)[-envs.num_envs // 5 :]]
        mean, deviation = best.mean(axis=0), best.std(axis=0) + 0.02
        yield mean, total


def draw_curve(curve, reference, path):
    """Draw the median returns of the generations beside that of the thermostat."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.subplots()
    axes.plot(range(1, len(curve) + 1), curve, marker="o", label="cross-entropy search")
    axes.axhline(reference, color="#d55e00", ls="--", label="thermostat, battery idle")
    axes.set_ylim(bottom=min(reference, *curve[-len(curve) // 2 :]) - 1.0)
    axes.set_xlim(0.5, len(curve) + 0.5)
    axes.set_xlabel("generation")
    axes.set_ylabel("median return of a day in euro")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)


def main(argv=None):
    """Make the system, train, and compare on days that the training did not see."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=Path("results"))
    parser.add_argument("--generations", type=int, default=20)
    parser.add_argument("--envs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(argv)
    system = make_system(options.folder)
    envs = fmugym.FMUVectorEnv(lambda: HomeEnv(system), options.envs, autoreset_mode="Disabled")
    reference = float(np.mean(thermostat(envs, TEST_SEED)))
    curve, policy = [], np.zeros((6, 2))
    for number, found in enumerate(train(envs, options.generations, options.seed), 1):
        policy, total = found
        curve.append(float(np.median(total)))
        print(f"generation {number}: median return {curve[-1]:.2f} euro")
    weights = np.broadcast_to(policy, (options.envs, 6, 2))
    final = float(np.mean(returns_of(envs, weights, TEST_SEED)))
    envs.close()
    draw_curve(curve, reference, options.folder / "curve.png")
    print(f"thermostat: {reference:.2f} euro a day; trained policy: {final:.2f} euro a day")
    return final, reference


if __name__ == "__main__":
    main()
