"""Odd values by the thousand: nothing but the package's own errors may come of them.

    python tests/tools/fuzz_face.py --count 10000 --seed 0

Each case is a call of the public face with one to three odd values: in the config, as arguments of
constructors, as seeds, options and actions, in distributions, as attributes, and as results of
hooks. Either the value is accepted and the environment works with it, or it is refused with an
error of ``FMUGymError``. Then it works as before. See ``fuzz_driver.py``.
"""

import contextlib
import itertools
import math
import sys

import fuzz_odd_values as odd_values
import gymnasium
import numpy as np
from fmu_tools import PlainEnv
from fuzz_driver import Case, describe, main
from fuzz_odd_values import hostile
from ways import in_way

import fmugym
from fmugym import Choice, FMUVectorEnv, LogUniform, Normal, Uniform
from fmugym.checks import integer_of
from fmugym.environment import env_checker
from fmugym.environment.config import EnvConfig
from fmugym.fmi import ArchiveLimits
from fmugym.pool import Paced


class Sampled:
    """A distribution that draws an odd value."""

    def __init__(self, value):
        self.value = value

    def sample(self, rng):
        return self.value


class Frozen:
    """The same in the form of ``scipy.stats``."""

    def __init__(self, value):
        self.value = value

    def rvs(self, random_state=None):
        return self.value


OWN = (
    lambda: {"q": 1},
    lambda: {"q_0": None},
    lambda: {"q_0": [1.0]},
    lambda: {"q_0": 10**400},
    lambda: {"q_0": {}},
    lambda: np.array([0.1]),
    lambda: np.array([1e39]),
    lambda: np.ones(3, bool),
    lambda: np.array([True, False]),
    lambda: np.array([1, 0]),
    lambda: Uniform(0, 1),
    lambda: Normal(0, 1),
    lambda: Choice([1, 2]),
    lambda: Choice(["q"]),
    lambda: Sampled(None),
    lambda: Sampled("q"),
    lambda: Sampled(math.nan),
    lambda: Sampled(1),
    lambda: Sampled([1.0]),
    lambda: Sampled(np.ones(2)),
    lambda: Sampled(10**400),
    lambda: Sampled(np.float32(0.5)),
    lambda: Frozen(None),
    lambda: Frozen(np.array([1.0])),
    lambda: Frozen("q"),
    lambda: Frozen(0.5),
    lambda: hostile("sample"),
    lambda: hostile("rvs"),
    lambda: {"distribution": "uniform"},
    lambda: {"distribution": []},
    lambda: {"distribution": "normal", "mean": "q"},
    lambda: {"distribution": "choice"},
    lambda: {"distribution": "uniform", "low": 0, "high": 1},
)
"""Values of which this package could make something."""


def odd(rng):
    """Draw a value of which few calls can make use; texts can be looked up, and none is endless."""
    value = odd_values.odd(rng) if rng.random() < 0.7 else rng.choice(OWN)()
    return "text" if isinstance(value, (odd_values.OddText, itertools.repeat)) else value


# Environments


def is_small(config):
    """Whether steps and resets take no time to speak of."""
    step = config.time_step or 0.02
    return config.substeps < 1000 and not 1000 < config.warm_up / step < math.inf


class Swing(fmugym.FMUEnv):
    """A pendulum whose config may be changed at will."""

    def __init__(self, changes=None, **options):
        config = swing_config()
        config.update(changes or {})
        super().__init__(options.pop("fmu_path", fmugym.bundled_fmu("Pendulum")), config, **options)

    def _is_done(self):
        return abs(self.state[0]) > 50.0


class Tracking(Swing):
    """One with episode variables, and attributes that hooks read."""

    def __init__(self, changes=None, **options):
        self.weight = 1.0
        variables = {"target": Uniform(-1.0, 1.0), "integral": 0.0}
        super().__init__({"episode_variables": variables} | (changes or {}), **options)

    def _update(self):
        error = self.state[0] - self.variables["target"]
        self.variables["integral"] = self.variables["integral"] + 0.02 * error

    def _reward_policy(self):
        return -self.weight * abs(self.variables["integral"])


def swing_config():
    return {
        "model_input_names": ["tau"],
        "model_output_names": ["q", "q_dot"],
        "model_parameters": {"q_0": 1.0, "max_step": 1.0},
        "time_step": 0.02,
        "bounds": {"tau": (-1.0, 1.0)},
    }


KEYS = (
    *("model_input_names", "model_output_names", "model_parameters", "time_step"),
    *("positive_reward", "negative_reward", "max_episode_steps", "start_time", "stop_time"),
    *("tolerance", "substeps", "warm_up", "monitor_names", "episode_variables", "bounds"),
    *("on_fault", "fault_retries", "fault_reward", "leak_limit", "archive_limits", "preload"),
    *("probe_timeout", "isolation", "call_timeout"),
)


def use(env, seed=0):
    """Run an environment for some steps."""
    space = getattr(env, "action_space", None)
    env.reset(seed=seed)
    space.seed(0)
    for _ in range(3):
        *_, terminated, truncated, _ = env.step(space.sample())
        if np.any(terminated) or np.any(truncated):
            env.reset()


def make_and_use(make):
    with contextlib.closing(make()) as env:
        if is_small(env.config) and env.config.isolation is None:
            use(env)


def pick(rng, names, count=None):
    return rng.sample(names, count or rng.choice((1, 1, 1, 2, 3)))


# Kinds of cases: each returns the odd values, and a function to be called with them.


def in_config(rng):
    changes = {key: odd(rng) for key in pick(rng, KEYS)}
    if rng.random() < 0.05:
        changes[rng.choice(("timestep", 1, None, "", ("a",)))] = 1
    return changes, lambda: make_and_use(lambda: Swing(changes))


def nested_in_config(rng):
    value = odd(rng)
    place = rng.choice(("model_parameters", "episode_variables", "bounds"))
    name = rng.choice(("q_0", "m", "solver", "max_step", "tau", "target", "q"))
    inner = rng.choice((value, [value], (value, 1.0), (0.0, value)))
    changes = {place: {**swing_config().get(place, {}), name: inner}}
    return changes, lambda: make_and_use(lambda: Tracking(changes))


def as_config(rng):
    value = odd(rng)
    return value, lambda: make_and_use(lambda: PlainEnv(fmugym.bundled_fmu("Pendulum"), value))


def as_argument(rng):
    names = ("log_level", "render_mode", "backend", "isolation", "fmu_path", "isolatoin")
    arguments = {name: odd(rng) for name in pick(rng, names)}
    arguments = {name: v for name, v in arguments.items() if not is_left_out(name, v)}
    return arguments, lambda: make_and_use(lambda: Swing(**arguments))


BUNDLED = {
    "CartPole": ("sutton_barto_reward", "fmi_version", "model_parameters", "render_mode", "lo"),
    "Pendulum": ("g", "fmi_version", "model_parameters", "log_level", "gg"),
    "ModelicaCartPole": (
        *("m_cart", "m_pole", "theta_0", "theta_dot_0", "time_step", "positive_reward"),
        *("negative_reward", "force", "log_level", "fmu_path", "fmi_version", "x"),
    ),
    "CloudPendulum": (
        *("torque_limit", "backend", "model_parameters", "user_token", "gym_token", "gym_time"),
        *("session_time", "fmi_version", "render_mode"),
    ),
}


def of_bundled(rng):
    name = rng.choice(list(BUNDLED))
    arguments = {key: odd(rng) for key in pick(rng, BUNDLED[name])}
    arguments = {name: v for name, v in arguments.items() if not is_left_out(name, v)}
    cls = getattr(fmugym.envs, f"{name}Env")
    return (name, arguments), lambda: make_and_use(lambda: cls(**arguments))


class Stage:
    """Environments that serve many cases: a refused value must leave them as good as new."""

    _CASES = 50

    def __init__(self):
        self._envs = {}
        self._cases = 0

    def begin_case(self):
        """Make the environments anew now and then."""
        self._cases += 1
        if self._cases % self._CASES == 0:
            self.close()

    def single(self, cls=Tracking):
        if cls not in self._envs:
            self._envs[cls] = cls()
        return self._envs[cls]

    def vector(self, hooks, cls=Tracking, mode="next_step"):
        key = cls, hooks, mode
        if key not in self._envs:
            self._envs[key] = FMUVectorEnv(in_way(hooks, cls), 3, autoreset_mode=mode)
        return self._envs[key]

    def forget(self, env):
        self._envs = {key: one for key, one in self._envs.items() if one is not env}
        env.close()

    def close(self):
        for env in self._envs.values():
            env.close()
        self._envs = {}


def tried(env, call):
    """Try a call on an environment that has begun, and show that it works afterwards."""
    env.reset(seed=1)
    try:
        call()
    finally:
        use(env)


def of_seed(rng, stage):
    seed = odd(rng)
    env = stage.single()
    return seed, lambda: tried(env, lambda: env.reset(seed=seed))


def of_options(rng, stage):
    cls = rng.choice((Tracking, fmugym.envs.CartPoleEnv, fmugym.envs.PendulumEnv))
    names = (*cls.reset_options, "odd")
    options = {name: odd(rng) for name in pick(rng, names, 1)}
    if rng.random() < 0.4:
        options = {"model_parameters": {rng.choice(("q_0", "m", "theta_0", "solver")): odd(rng)}}
    options = rng.choice((options, options, options, odd(rng)))
    env = stage.single(cls)
    return options, lambda: tried(env, lambda: env.reset(options=options))


def of_action(rng, stage):
    cls = rng.choice((Tracking, fmugym.envs.CartPoleEnv, fmugym.envs.PendulumEnv))
    action = odd(rng)
    env = stage.single(cls)
    return action, lambda: tried(env, lambda: env.step(action))


def of_reading(rng, stage):
    env, name, value = stage.single(), odd(rng), odd(rng)
    calls = (
        lambda: env.read_variables(name),
        lambda: env.out[name],
        lambda: env.out.get(name),
        lambda: name in env.out,
        lambda: env.variables.__setitem__(name, value),
        lambda: env.variables.update(name),
        lambda: env.fmu.variable(name),
        lambda: fmugym.bundled_fmu(name, value),
        lambda: fmugym.bundled_fmu("Pendulum", value),
    )
    call = rng.choice(calls)
    return (calls.index(call), name, value), lambda: tried(env, call)


def of_distribution(rng):
    cls = rng.choice((Uniform, LogUniform, Normal, Choice))
    count = {Normal: rng.choice((2, 3, 4)), Choice: rng.choice((1, 2))}.get(cls, 2)
    arguments = [rng.choice((0.5, 1, 2.0)) for _ in range(count)]
    arguments[rng.randrange(count)] = odd(rng)
    if cls is Choice:
        arguments[0] = rng.choice((arguments[0], [odd(rng), 1.0], [1, 2]))

    def call():
        value = cls(*arguments)
        changes = {
            "model_parameters": {"q_0": value, "max_step": 1.0},
            "episode_variables": {"target": value},
        }
        make_and_use(lambda: Swing(changes))

    return (cls.__name__, arguments), call


VECTOR_ARGUMENTS = (
    *("num_envs", "max_episode_steps", "autoreset_mode", "backend", "threads"),
    *("private_libraries", "isolation", "workers", "call_timeout", "thread"),
)


def is_left_out(name, value):
    """Whether a sound value would take too much of the machine, or is a function of the caller's.

    What such a function raises is the caller's own.
    """
    if name == "backend" and callable(value):
        return True
    if name == "num_envs":
        return 100 < (integer_of(value) or 0) < 2**62
    return is_text(value, "process", "human")


def is_text(value, *texts):
    return type(value) is str and value in texts


def as_vector_argument(rng):
    arguments = {name: odd(rng) for name in pick(rng, VECTOR_ARGUMENTS)}
    arguments = {name: v for name, v in arguments.items() if not is_left_out(name, v)}
    other = odd(rng)
    make = rng.choice((Swing, Swing, Swing, Swing if callable(other) else other))

    def call():
        with contextlib.closing(FMUVectorEnv(make, **{"num_envs": 2, **arguments})) as env:
            use(env)

    return (describe(make), arguments), call


HOOKS = (None, "arrays", "one by one")


def of_vector(rng, stage):
    env = stage.vector(rng.choice(HOOKS), rng.choice((Tracking, fmugym.envs.CartPoleEnv)))
    value = odd(rng)
    name = rng.choice(("weight", "q_0", "m", "state", "logger", "pool", "config", "np_random"))
    calls = {
        "seed": lambda: env.reset(seed=value),
        "seeds": lambda: env.reset(seed=[value, 1, 2]),
        "mask": lambda: env.reset(options={"reset_mask": value}),
        "options": lambda: env.reset(options=value),
        "parameters": lambda: env.reset(options={"model_parameters": {"m": value}}),
        "actions": lambda: env.step(value),
        "action": lambda: env.step([value, value, value]),
        "get_attr": lambda: env.get_attr(value),
        "call": lambda: env.call(value),
    }
    kind = rng.choice(list(calls))
    return (kind, name, value), lambda: tried(env, calls[kind])


def of_attribute(rng, stage):
    """Attributes stay, and so does what they break: the environment is not used again."""
    env = stage.vector(rng.choice(HOOKS))
    value = odd(rng)
    name = rng.choice(("weight", "q_0", "m", "weigth", value))
    values = rng.choice((value, [value, value, value], [value]))

    def call():
        try:
            env.reset(seed=1)
            env.set_attr(name, values)
            if not is_text(name, "weight"):
                use(env)
        finally:
            stage.forget(env)

    return (name, values), call


def of_functions(rng):
    value, other = odd(rng), odd(rng)
    calls = {
        "FMU": lambda: fmugym.FMU(value).close(),
        "limits": lambda: fmugym.FMU(fmugym.bundled_fmu("Pendulum"), limits=value).close(),
        "preload": lambda: fmugym.FMU(fmugym.bundled_fmu("Pendulum"), preload=value).close(),
        "timeout": lambda: fmugym.FMU(fmugym.bundled_fmu("Pendulum"), probe_timeout=value).close(),
        "ArchiveLimits": lambda: ArchiveLimits(max_ratio=value),
        "EnvConfig": lambda: EnvConfig.from_dict(value),
        "Paced": lambda: Paced(other, hold_after=value),
        "check_fmu_env": lambda: env_checker.check_fmu_env(value),
        "check_hooks": lambda: callable(value) or env_checker.check_hooks(value),
        "register": lambda: register(rng.choice((value, "fuzz/Odd-v0")), other),
    }
    kind = rng.choice(list(calls))
    return (kind, value, other), calls[kind]


def register(env_id, env):
    try:
        fmugym.register(env_id, env)
    finally:
        gymnasium.registry.pop("fuzz/Odd-v0", None)


WHOLE = {
    in_config: 6,
    nested_in_config: 3,
    as_config: 1,
    as_argument: 2,
    of_bundled: 4,
    of_distribution: 3,
    as_vector_argument: 4,
    of_functions: 2,
}
STAGED = {of_seed: 1, of_options: 2, of_action: 3, of_reading: 1, of_vector: 4, of_attribute: 1}
KINDS = WHOLE | STAGED


@contextlib.contextmanager
def program():
    """See ``fuzz_driver.run``."""
    stage = Stage()

    def make(rng, folder):
        stage.begin_case()
        kind = rng.choices(list(KINDS), list(KINDS.values()))[0]
        values, call = kind(rng, stage) if kind in STAGED else kind(rng)
        return Case(call, kind.__name__, values, keeps=kind in STAGED)

    with contextlib.closing(stage):
        yield make


if __name__ == "__main__":
    sys.exit(main(program, __doc__, 10_000))
