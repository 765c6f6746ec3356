"""Classes whose episodes are golden: those of the pages and programs, as they were at first.

They are copies, so that pages, examples and benchmarks may change without a change of results.
"""

import numpy as np
from gymnasium import spaces

import fmugym
from fmugym import Choice, Uniform

# The pages.


class BrakeOfPage(fmugym.FMI2CSEnv):
    """Bring a swinging pendulum of unknown mass to rest."""

    vectorized = True

    def __init__(self, largest_torque=0.01, **options):
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"m": Uniform(0.05, 0.07), "q_0": Uniform(-1.0, 1.0), "b": 1e-5},
            "bounds": {
                "tau": (-largest_torque, largest_torque),
                "q": (-4.0, 4.0),
                "q_dot": (-50.0, 50.0),
            },
            "time_step": 0.02,
            "max_episode_steps": 300,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config, **options)

    def _is_done(self):
        q, q_dot = self.state
        at_rest = (abs(q) < 0.05) & (abs(q_dot) < 0.3)
        return at_rest | (abs(q) > 3.0)

    def _reward_policy(self):
        q, q_dot = self.state
        return -(q**2) - 0.01 * q_dot**2


class BrakeOfExample(BrakeOfPage):
    """The same in the program to copy, with another reward."""

    vectorized = True

    def _is_at_rest(self):
        q, q_dot = self.state
        return (abs(q) < 0.05) & (abs(q_dot) < 0.3)

    def _is_done(self):
        return self._is_at_rest() | (abs(self.state[0]) > 3.0)

    def _reward_policy(self):
        q, q_dot = self.state
        return 10.0 * self._is_at_rest() - q**2 - 0.01 * q_dot**2


class Brake(fmugym.FMI2CSEnv):
    """The class of the page about hooks; it has an option of its own."""

    vectorized = True

    reset_options = ("model_parameters", "release_angle")

    def __init__(self, **changes):
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"q_0": Uniform(-1.0, 1.0)},
            "bounds": {"tau": (-0.01, 0.01), "q": (-4.0, 4.0), "q_dot": (-50.0, 50.0)},
            "time_step": 0.02,
            "max_episode_steps": 300,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config | changes)

    def _is_done(self):
        return abs(self.out["q"]) > 3.0

    def _get_episode_parameters(self, options):
        angle = {"q_0": options["release_angle"]} if "release_angle" in options else {}
        return super()._get_episode_parameters(options) | angle


class Discretized(Brake):
    """Three torques, and an observation in which the angle does not jump."""

    vectorized = True

    def _get_action_space(self):
        return spaces.Discrete(3)

    def _get_inputs(self):
        return 0.01 * (self.action - 1.0)

    def _get_observation_space(self):
        return spaces.Box(-np.inf, np.inf, (3,), np.float32)

    def _get_observation(self):
        q, q_dot = self.state
        return np.array([np.cos(q), np.sin(q), q_dot], dtype=np.float32)


class Track(Brake):
    """Follow a target angle; the integral of the error is observed, too."""

    vectorized = True

    def __init__(self, **changes):
        variables = {"target": Uniform(-0.1, 0.1), "error_integral": 0.0}
        super().__init__(episode_variables=variables, **changes)

    def _update(self):
        error = self.variables["target"] - self.out["q"]
        self.variables["error_integral"] = self.variables["error_integral"] + 0.02 * error

    def _reward_policy(self):
        return -abs(self.variables["target"] - self.out["q"])

    def _get_observation_space(self):
        high = np.array([4.0, 50.0, 0.1, 30.0], dtype=np.float32)
        return spaces.Box(-high, high)

    def _get_observation(self):
        target, integral = self.variables["target"], self.variables["error_integral"]
        return np.array([*self.state, target, integral], dtype=np.float32)


class Delayed(Brake):
    """The torque takes effect three steps later."""

    vectorized = True

    def __init__(self, **changes):
        super().__init__(episode_variables={"queue": [0.0, 0.0, 0.0]}, **changes)

    def _get_inputs(self):
        return [self.variables["queue"][0]]

    def _update(self):
        newest = np.stack([self.action[0]])
        self.variables["queue"] = np.concatenate([self.variables["queue"][1:], newest])


class Reach(Track):
    """A goal task."""

    vectorized = True

    _reward_policy = fmugym.FMUEnv._reward_policy  # the default again, which calls _goal_reward

    def _get_observation_space(self):
        angle = spaces.Box(-4.0, 4.0, (1,), np.float32)
        state = fmugym.FMUEnv._get_observation_space(self)
        return spaces.Dict({"observation": state, "achieved_goal": angle, "desired_goal": angle})

    def _get_observation(self):
        return {
            "observation": np.array(self.state, dtype=np.float32),
            "achieved_goal": np.array([self.out["q"]], dtype=np.float32),
            "desired_goal": np.array([self.variables["target"]], dtype=np.float32),
        }

    def _goal_reward(self, achieved_goal, desired_goal):
        distance = np.linalg.norm(achieved_goal - desired_goal, axis=-1)
        return -(distance > 0.05).astype(np.float64)


class Houses(fmugym.FMUEnv):
    """Two houses, one of which warms the other."""

    def __init__(self):
        house = fmugym.bundled_fmu("House")
        system = fmugym.FMUSystem(
            {"east": house, "west": fmugym.Component(house, start_values={"T_m_0": 290.0})},
            connections=[
                "outside -> east.T_out",
                "outside -> west.T_out",
                fmugym.Connection("east.Q_em", "west.Q_int", gain=0.1),
                "east.T_air -> warmth",
            ],
            units={"outside": "degC", "warmth": "degC"},
            step_size=60.0,
        )
        config = {
            "model_input_names": ["east.u", "west.u"],
            "model_output_names": ["warmth", "west.T_air"],
            "model_parameters": {"east.A_f": Uniform(100, 200), "outside": 3.0},
            "time_step": 900.0,
            "substeps": 15,
        }
        super().__init__(system, config)

    def _is_done(self):
        return self.out["warmth"] > 30.0


class Flywheel:
    """What stands in for the FMU of ``Rig``."""

    def reset(self, start_values):
        self.q, self.q_dot = start_values["q_0"], 0.0
        return {"q": self.q, "q_dot": self.q_dot}

    def step(self, inputs):
        self.q_dot += 0.02 * inputs["tau"] / 6e-4
        self.q += 0.02 * self.q_dot
        return {"q": self.q, "q_dot": self.q_dot}, 0

    def stop(self):
        """Nothing moves by itself."""


class Rig(fmugym.FMI2CSEnv):
    """A flywheel by hand, in the place of the FMU."""

    def __init__(self):
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"q_0": Uniform(-0.1, 0.1)},
            "bounds": {"tau": (-0.15, 0.15)},
            "time_step": 0.02,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config, backend=Flywheel())

    def _is_done(self):
        return abs(self.out["q"]) > 3.0


# The examples and the benchmarks; others are in ``benchmarks/user_tasks.py``.


class SwingUpOfExample(fmugym.FMI2CSEnv):
    """Reach the upright position from below, and stay there."""

    vectorized = True

    def __init__(self):
        plant = {"m": 1.0, "l": 1.0, "g": 10.0, "b": 0.05, "body": 2, "tau_max": 2.0}
        solver = {"solver": 3, "max_step": 0.025}
        config = {
            "model_input_names": "tau",
            "model_output_names": ["theta", "theta_dot"],
            "model_parameters": plant | solver | {"theta_0": -np.pi},
            "bounds": {"tau": (-2.0, 2.0)},
            "time_step": 0.05,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config)

    def _is_done(self):
        return self.out["theta"] != self.out["theta"]

    def _reward_policy(self):
        theta, theta_dot = self.state
        return -(4 * (1 - np.cos(theta)) + 0.1 * theta_dot**2 + 0.001 * self.inputs[0] ** 2)


class Cell(fmugym.FMUEnv):
    """A pendulum that swings freely."""

    def __init__(self):
        cell = {"m": 0.06, "l": 0.1, "b": 4e-4, "c": 2e-3}
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "model_parameters": cell | {"q_0": 2.5},
            "time_step": 0.02,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config)

    def _is_done(self):
        return False


class PushedCartPole(fmugym.FMI2CSEnv):
    """A cart-pole that is pushed."""

    vectorized = True

    def __init__(self):
        config = {
            "model_input_names": "f",
            "model_output_names": ["x", "x_dot", "theta", "theta_dot"],
            "time_step": 0.02,
        }
        super().__init__(fmugym.bundled_fmu("CartPole"), config)

    def _is_done(self):
        return abs(self.state[0]) > 2.4


class Home(fmugym.FMUEnv):
    """A house with a roof of solar cells and a battery, at a price that changes."""

    def __init__(self, system):
        config = {
            "model_input_names": ["heating", "charging"],
            "model_output_names": ["house.T_air", "battery.charge", "roof.P_pv", "grid"],
            "model_parameters": {"house.T_m_0": Uniform(291.0, 294.0)},
            "bounds": {"heating": (0.0, 1.0), "charging": (-1.0, 1.0)},
            "time_step": 900.0,
            "max_episode_steps": 96,
        }
        super().__init__(system, config)

    def _is_done(self):
        return False

    def _reward_policy(self):
        temperature, _, _, grid = self.state
        hour = self.time / 3600 % 24
        price = np.where((hour >= 17) & (hour < 22), 0.60, 0.20)
        sold = np.minimum(grid, 0.0) * 0.06
        cost = (np.maximum(grid, 0.0) * price + sold) * 900.0 / 3.6e6
        cold = np.maximum(293.15 - temperature, 0.0)
        return -cost - cold * 0.25


# An integral, with ends that each episode draws.


class Integral(Brake):
    """An integral and a count in ``_update``; an episode ends after 2, 3, 5 or 40 steps."""

    vectorized = True

    def __init__(self):
        last = Choice([2.0, 3.0, 5.0, 40.0])
        super().__init__(episode_variables={"last": last, "total": 0.5, "past": [0.0, 0.0]})

    def _update(self):
        total, angle = self.variables["total"], self.out["q"]
        self.variables["total"] = total + 0.5 * (angle + self.previous_state[0])
        self.variables["past"] = np.stack([angle + 0.0 * total, self.variables["past"][0]])

    def _is_done(self):
        return self.step_count >= self.variables["last"]

    def _is_truncated(self):
        return abs(self.variables["total"]) > 2.0

    def _reward_policy(self):
        ended = 1.0 * self.done
        return self.variables["total"] - 10.0 * ended + np.float64(self.previous_action[0])

    def _get_observation_space(self):
        return spaces.Box(-np.inf, np.inf, (4,), np.float64)

    def _get_observation(self):
        past = self.variables["past"]
        return np.array([self.out["q"], self.variables["total"], past[0], past[1]])

    def _get_info(self):
        return {"total": self.variables["total"], "steps": self.step_count}


class IntegralOnArrays(Integral):
    """The same with a median, which numpy finds on arrays only."""

    vectorized = True

    def _reward_policy(self):
        ended = 1.0 * self.done
        return self.variables["total"] - 10.0 * ended + self.previous_action[0]

    def _get_observation(self):
        past = self.variables["past"]
        middle = np.partition(np.array([self.out["q"], past[0], past[1]]), 1, axis=0)[1]
        return np.array([self.out["q"], self.variables["total"], middle, past[1]])


class IntegralOfEach(Integral):
    """The same with branches, for one environment at a time."""

    def _reward_policy(self):
        if self.done:
            return self.variables["total"] - 10.0
        return self.variables["total"] + self.previous_action[0]


# Faults. An episode draws the step of the fault, its kind, and an end in the same step.

NO_FAULT, ASKED_FOR, NOT_A_NUMBER = 0.0, 12.0, 13.0
"""Faults of the FMU in ``zoo/zoo.c``: none, a status, an output."""

STEP_CALL = 6.0
LIMIT = 4
"""Steps of the longest episode: the limit comes in the step of half of the faults."""

PARAMETERS = {
    "at": [2.0, 4.0],  # the step
    "fault": [NO_FAULT, ASKED_FOR, NOT_A_NUMBER],
    "status": [2.0, 3.0],  # a discarded step, an error
}
VARIABLES = {
    "end": [0.0, 1.0, 2.0],  # none, terminated, truncated
    "spoiled": [0.0, 1.0, 2.0],  # nothing, the reward, the observation
}


class Faulty(fmugym.FMUEnv):
    """The FMU integrates the action. There is a fault, an end or both in the step ``at``.

    Args:
        path: The FMU of ``zoo/zoo.c``.
        on_fault: As in the config.
    """

    vectorized = True

    def __init__(self, path, on_fault):
        parameters = {name: Choice(values) for name, values in PARAMETERS.items()}
        variables = {name: Choice(values) for name, values in VARIABLES.items()}
        config = {
            "model_input_names": "u",
            "model_output_names": "y",
            "model_parameters": {**parameters, "call": STEP_CALL},
            "episode_variables": {**variables, "total": 0.0},
            "time_step": 0.5,
            "bounds": {"u": (-1.0, 1.0)},
            "on_fault": on_fault,
            "fault_reward": -7.0,
            "max_episode_steps": LIMIT,
        }
        super().__init__(path, config)

    def _is_now(self, name, number):
        return (self.step_count == self.parameters["at"]) & (self.variables[name] == number)

    def _update(self):
        self.variables["total"] = self.variables["total"] + self.out["y"]

    def _is_done(self):
        return self._is_now("end", 1.0)

    def _is_truncated(self):
        return self._is_now("end", 2.0)

    def _reward_policy(self):
        reward = self.out["y"] + self.variables["total"]
        return np.where(self._is_now("spoiled", 1.0), np.nan, reward)

    def _get_observation_space(self):
        return spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def _get_observation(self):
        total = self.variables["total"]
        spoiled = np.where(self._is_now("spoiled", 2.0), np.nan, total)
        return np.array([self.out["y"] + 0.0 * total, spoiled])

    def _get_info(self):
        return {"total": self.variables["total"]}


class FaultyOnArrays(Faulty):
    """The same with a function that is not compiled."""

    vectorized = True

    def _get_info(self):
        return {"total": np.nansum(np.array([self.variables["total"]]), axis=0)}


class FaultyOfEach(Faulty):
    """The same with a branch, for one environment at a time."""

    def _reward_policy(self):
        if self._is_now("spoiled", 1.0):
            return np.nan
        return self.out["y"] + self.variables["total"]


def faulty_task(path, on_fault):
    """The same as a task."""

    def drawn(values):
        return {"distribution": "choice", "values": values}

    now, bad = "step == at", "sqrt(-1 - abs(y))"
    task = {
        "fmu": str(path),
        "time_step": 0.5,
        "episode_length": 0.5 * LIMIT,
        "terminated": f"{now} and end == 1",
        "truncated": f"{now} and end == 2",
        "variables": {"u": {"min": -1, "max": 1}},
        "parameters": {name: drawn(values) for name, values in PARAMETERS.items()}
        | {"call": STEP_CALL},
        "memory": {name: {"start": drawn(values)} for name, values in VARIABLES.items()}
        | {"total": {"start": 0, "update": "total + y"}},
        "expressions": {"seen": f"{bad} if {now} and spoiled == 2 else total"},
        "agent": {"actions": ["u"], "observations": ["y", "seen"]},
        "reward": f"{bad} if {now} and spoiled == 1 else y + total",
        "costs": {"all": "abs(total)"},
        "kpis": {"largest": {"max": "abs(y)"}, "sum": {"sum": "y"}},
        "config": {"on_fault": on_fault, "fault_reward": -7.0},
    }
    return fmugym.load(task)
