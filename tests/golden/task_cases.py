"""Golden cases of tasks: what users see of them, by the names that stay.

A case is a function of a folder for FMUs and files. It gives rows, see ``plays.py``. Cases use
nothing but the public face: classes with a config and hooks, task files, ``gymnasium.make``,
``make_vec``, ``fmugym.load``, ``FMUVectorEnv``, ``rollout``, snapshots and the command line.
"""

import ctypes
import json
import re
import shutil
import subprocess
from contextlib import closing, contextmanager
from functools import cache, partial
from importlib import import_module
from itertools import product
from pathlib import Path

import c_fmus
import gymnasium
import numpy as np
import user_tasks
import zoo_tools
from building import compiler
from busy import BusyEnv
from export_tools import network_for
from fmpy import extract, read_model_description
from fmpy.simulation import instantiate_fmu
from golden import classes, plays
from golden.plays import MODES, NUM_ENVS, action_in, actions_in, labelled, of_each, plain
from makers import by_python

import fmugym
from fmugym import Uniform
from fmugym.cli.command_line import run_command_line
from fmugym.deployment.export import agent_of, write_c, write_fmu, write_onnx

TASKS = Path(__file__).with_name("tasks")
BUNDLED = ("CartPole", "Pendulum", "ModelicaCartPole", "CloudPendulum", "House")
OF_USERS = ("SwingUp", "Tracking", "Uncompiled", "Goal", "Building")
PLANTS = ("drive.toml", "room.toml")
LIMIT = 9
"""Steps of the longest episode in the cases of vector environments."""


@cache
def files(folder):
    """The task files, beside an FMU and the data that they name."""
    place = folder / "tasks"
    shutil.copytree(TASKS, place)
    shutil.copy(fmugym.bundled_fmu("House"), place / "House.fmu")
    shutil.copy(Path(fmugym.envs.__file__).with_name("house_year.csv"), place)
    return place


@cache
def building(folder):
    return c_fmus.build_building(folder)


@cache
def busy(folder):
    return c_fmus.build_busy(folder)


@cache
def zoo(folder):
    return zoo_tools.zoo_fmu(folder, 2)


@cache
def of_pythonfmu(script, folder, **options):
    """The FMU of a script; without pythonfmu, the test is skipped."""
    return by_python("pythonfmu", script, **options)(folder)


@cache
def home(folder):
    """A house in C, with a roof and a battery in Python."""
    battery = of_pythonfmu(TASKS.with_name("golden_battery.py"), folder)
    return fmugym.FMUSystem(
        {
            "roof": of_pythonfmu(TASKS.with_name("golden_roof.py"), folder),
            "house": fmugym.bundled_fmu("House"),
            "battery": fmugym.Component(battery, feedthrough=False),
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


def of_file(name, folder, **options):
    """The environment of a task file."""
    return fmugym.load(files(folder) / name, **options)


def of_plant(name, folder):
    """The environment of a task file over a plant of the benchmarks in Python."""
    script = Path(c_fmus.__file__).with_name(f"plant_{Path(name).stem}.py")
    of_pythonfmu(script, files(folder), canGetAndSetFMUstate="true")
    return of_file(name, folder)


def of_id(name, folder):
    """A bundled environment without wrappers."""
    return getattr(fmugym.envs, f"{name}Env")()


def of_class(name, folder):
    """A class of a page or an example."""
    return getattr(classes, name)()


def of_user(name, folder):
    """A class of the benchmarks."""
    return getattr(user_tasks, name)(*[building(folder)] * (name == "Building"))


def of_busy(folder):
    """What the benchmarks do over steps that take long: here 20 us, or 50 us."""
    return BusyEnv(busy(folder), mean=20.0, sigma=0.5, rare=0.2, rare_time=50.0)


def of_home(folder):
    """An example's house with solar cells and a battery."""
    return classes.Home(home(folder))


OF_PAGES = (
    *("BrakeOfPage", "BrakeOfExample", "Brake", "Discretized", "Track", "Delayed", "Reach"),
    *("Houses", "SwingUpOfExample", "Cell", "PushedCartPole"),
    *("Integral", "IntegralOnArrays", "IntegralOfEach"),
)


def makers():
    """Functions from a folder to an environment, by name."""
    found = {name: partial(of_id, name) for name in BUNDLED}
    found |= {f"{name} of users": partial(of_user, name) for name in OF_USERS}
    found |= {name: partial(of_class, name) for name in OF_PAGES}
    found |= {"Busy": of_busy, "Home": of_home}
    found |= {path.name: partial(of_file, path.name) for path in sorted(TASKS.glob("*.toml"))}
    return found | {name: partial(of_plant, name) for name in PLANTS}


# Steps and resets.


def single(make, folder):
    """Two episodes of a single environment."""
    return plays.single(make(folder))


def vector(make, mode, folder, **options):
    """Steps of five environments, with a limit of steps."""
    options = {"max_episode_steps": LIMIT, "autoreset_mode": mode} | options
    return plays.vector(fmugym.FMUVectorEnv(partial(make, folder), NUM_ENVS, **options))


def registered(name, folder):
    """As users of Gymnasium make them."""
    yield from labelled("make", plays.single(gymnasium.make(f"fmugym/{name}-v0")))
    envs = gymnasium.make_vec(f"fmugym/{name}-v0", NUM_ENVS)
    yield from labelled("make_vec", plays.vector(envs, steps=40))


def rig(folder):
    """An environment with a rig in the place of the FMU."""
    return plays.single(classes.Rig())


def scenario(name, folder):
    """The scenarios of a task."""
    file, which = name.split()
    return plays.single(of_file(file, folder, scenario=which))


def physical(name, folder):
    """The form of a task that controllers play."""
    return plays.single(of_file(name, folder, physical=True))


def version(name, fmi_version, folder):
    """A bundled environment over the FMU of another version."""
    return plays.single(getattr(fmugym.envs, f"{name}Env")(fmi_version=fmi_version))


# Faults.


FORMS = {
    "compiled": classes.Faulty,
    "on arrays": classes.FaultyOnArrays,
    "of each": classes.FaultyOfEach,
    "a file": classes.faulty_task,
}


ON_FAULT = ("truncate", "terminate", "raise")


def fault(form, on_fault, mode, folder):
    """Faults, and ends in the same step."""
    make = partial(FORMS[form], zoo(folder), on_fault)
    if mode == "single":
        return plays.single(make(), seeds=(5, *[None] * 299))
    return plays.vector(fmugym.FMUVectorEnv(make, NUM_ENVS, autoreset_mode=mode), steps=190)


# Options, seeds and masks.


def options(folder):
    """Options of ``reset`` in a single environment."""
    given = (
        {"model_parameters": {"m": 0.06, "b": Uniform(0.0, 1e-4)}},
        {"release_angle": 0.5},
        {"model_parameters": {"q_0": Uniform(0.2, 0.3)}},
        None,
    )
    env = classes.Brake()
    rng = np.random.default_rng(3)
    with closing(env):
        for seed, own in zip((3, None, 4, None), given, strict=True):
            observation, info = env.reset(seed=seed, options=own)
            yield plays.reset_row(observation, plain(info))
            for _ in range(3):
                *result, info = env.step(action_in(env.action_space, rng))
                yield plays.step_row(*result, plain(info))


def masks(make, mode, folder):
    """Options, lists of seeds and masks of a vector environment, and values of its attributes."""
    rng = np.random.default_rng(3)
    some = np.array([True, False, True, True, False])
    resets = (
        {"seed": 3},
        {"seed": [11, 12, None, 14, 15]},
        {"options": {"reset_mask": some}},
        {"seed": 8, "options": {"reset_mask": ~some}},
        {"options": {"model_parameters": {"q_0": 0.25}}},
        {"seed": 9, "options": {"reset_mask": some, "model_parameters": {"m": Uniform(0.05, 1)}}},
        {},
    )
    envs = fmugym.FMUVectorEnv(partial(make, folder), NUM_ENVS, autoreset_mode=mode)
    with closing(envs):
        for number, given in enumerate(resets):
            if number == 6:
                envs.set_attr("m", [0.05, 0.06, 0.07, 0.08, 0.09])
            observations, infos = envs.reset(**given)
            yield plays.reset_row(observations, of_each(infos))
            for _ in range(2):
                *result, infos = envs.step(actions_in(envs.single_action_space, rng))
                yield plays.step_row(*result, of_each(infos))


def resting(make, folder):
    """Some environments rest while others step."""
    rng = np.random.default_rng(3)
    envs = fmugym.FMUVectorEnv(partial(make, folder), NUM_ENVS, max_episode_steps=4)
    with closing(envs):
        observations, infos = envs.reset(seed=3)
        yield plays.reset_row(observations, of_each(infos))
        for _ in range(8):
            still = rng.uniform(size=NUM_ENVS) < 0.4
            *result, infos = envs.step_around(actions_in(envs.single_action_space, rng), still)
            yield plays.step_row(*result, of_each(infos))


# Snapshots and rollouts.


def snapshot(make, folder):
    """Return to a moment of an episode, in the same environment and in others."""
    rng = np.random.default_rng(3)

    def steps(env, count):
        for _ in range(count):
            *result, info = env.step(action_in(env.action_space, rng))
            yield plays.step_row(*result, plain(info))
            if result[2] or result[3]:
                observation, info = env.reset()
                yield plays.reset_row(observation, plain(info))

    with closing(make(folder)) as env, closing(make(folder)) as twin:
        env.reset(seed=5)
        yield from steps(env, 4)
        saved = env.save_state()
        yield from labelled("before", steps(env, 4))
        yield {"observation": plain(env.restore_state(saved))}
        yield from labelled("restored", steps(env, 4))
        yield {"observation": plain(twin.restore_state(saved))}
        yield from labelled("another", steps(twin, 6))
        observation, info = twin.reset()
        yield plays.reset_row(observation, plain(info))
        yield from labelled("of many", _restored(make, saved, folder))


def _restored(make, saved, folder):
    rng = np.random.default_rng(4)
    envs = fmugym.FMUVectorEnv(partial(make, folder), NUM_ENVS, max_episode_steps=LIMIT)

    def steps(count):
        for _ in range(count):
            *result, infos = envs.step(actions_in(envs.single_action_space, rng))
            yield plays.step_row(*result, of_each(infos))

    with closing(envs):
        yield {"observation": plain(envs.restore_state(saved))}
        yield from steps(3)
        of_all = envs.save_state()
        yield from steps(8)
        yield {"observation": plain(envs.restore_state(of_all[2], where=[0, 1]))}
        yield from steps(4)
        yield {"observation": plain(envs.restore_state(of_all))}
        yield from steps(8)


def rollout(make, given, folder):
    """Candidates from a snapshot of one environment, from one of many, and of a policy."""
    rng = np.random.default_rng(3)
    many = fmugym.FMUVectorEnv(partial(make, folder), NUM_ENVS)
    with closing(make(folder)) as env, closing(many) as envs:
        space = env.action_space
        env.reset(seed=5)
        env.step(action_in(space, rng))
        candidates = np.array([[action_in(space, rng) for _ in range(8)] for _ in range(12)])
        yield from _rolled("one", envs.rollout(env.save_state(), candidates, **given))
        envs.reset(seed=9)
        present = actions_in(space, rng)
        envs.step(present)
        yield from _rolled("all", envs.rollout(None, candidates[:NUM_ENVS], **given))
        policy = envs.rollout(None, lambda observations: present, horizon=6, **given)
        yield from _rolled("policy", policy)
        *result, infos = envs.step(present)
        yield plays.step_row(*result, of_each(infos))


def _rolled(label, result):
    for index, length in enumerate(np.asarray(result.lengths).tolist()):
        yield {
            "scene": f"{label}, candidate {index}",
            "observation": plain(_of_candidate(result.observations, index)),
            **{name: plain(getattr(result, name)[index]) for name in ENDS},
            "costs": {name: plain(values[index]) for name, values in result.costs.items()},
            "length": length,
        }


ENDS = ("rewards", "terminated", "truncated")


def _of_candidate(observations, index):
    if isinstance(observations, dict):
        return {name: values[index] for name, values in observations.items()}
    return observations[index]


ROLLOUTS = {
    "CartPole": {},
    "Pendulum": {},
    "Track": {"parameters": {"b": 2e-4}},
    "Integral": {},
    "IntegralOnArrays": {},
    "IntegralOfEach": {},
    "Reach": {},
    "House": {"offsets": {"T_op": 0.3}},
    "house.toml": {
        "data": {"T_out": ([0.0, 86400.0 * 364], [-5.0, 5.0])},
    },
    "swing_costs.toml": {"offsets": {"q": 0.1}},
    "sensors.toml": {"seed": 11},
    "levels.toml": {},
    "change.toml": {},
    "swing_memory.toml": {},
}
"""What rollouts of a task are given beside the actions."""


# Trainings and agents.


def training(name, rounds, folder):
    """The agent that a search finds, and its rewards in the test."""
    agent = trained(name, folder, rounds)
    facts = json.loads((agent / "agent.json").read_text(encoding="utf-8"))
    policy = json.loads((agent / "policy.json").read_text(encoding="utf-8"))
    weights = np.round(policy["weights"], 6)  # processors round the last digits in their own ways
    yield {"scene": "found", "steps": facts["steps"], "weights": plain(weights)}
    for who, scores in facts["test"].items():
        rewards = {place: plain(values) for place, values in scores["rewards"].items()}
        yield {"scene": who, "rewards": rewards, "costs": plain(scores["mean_costs"])}


@cache
def trained(name, folder, rounds):
    output = folder / f"agent of {Path(name).stem}"
    arguments = ["--rounds", str(rounds), "--seed", "1", "--episodes", "3", "--quiet"]
    assert (
        run_command_line(["train", str(files(folder) / name), "--output", str(output), *arguments])
        == 0
    )
    return output


def exported(form, name, folder):
    """What an exported agent does with the measurements of an episode with random actions.

    The agent is a network with random weights.
    """
    measurements = measured(name, folder)
    actions = FORMS_OF_AGENTS[form](name, folder, measurements)
    for row, action in zip(measurements, actions, strict=True):
        yield {"measurements": plain(row), "actions": plain(action)}


@contextmanager
def agent_for(name, folder):
    with closing(of_file(name, folder)) as env:
        yield agent_of(env, network_for(env), name="agent")


@cache
def exports(name, folder):
    """A folder with the same agent in all forms but ONNX."""
    place = folder / f"exported {Path(name).stem}"
    place.mkdir()
    with agent_for(name, folder) as agent:
        write_c(agent, place)
        for fmi_version in ("2.0", "3.0"):
            write_fmu(agent, place / f"agent{fmi_version}.fmu", fmi_version=fmi_version)
    return place


@cache
def measured(name, folder):
    """The plant's values that the agent measures, a row for each sample."""
    names = names_of(read_model_description(str(exports(name, folder) / "agent2.0.fmu")), "input")
    rng, rows = np.random.default_rng(3), []
    with closing(of_file(name, folder)) as env:
        env.reset(seed=5)
        for _ in range(12):
            rows.append([float(env.read_variables(*names)[one]) for one in names])
            env.step(action_in(env.action_space, rng))
    return np.array(rows)


def names_of(description, causality):
    return [v.name for v in description.modelVariables if v.causality == causality]


def in_c(name, folder, measurements):
    """Compile the agent, and take samples."""
    place = exports(name, folder)
    library = place / "agent.so"
    flags = ("-std=c99", "-O2", "-ffp-contract=off", "-shared", "-fPIC")
    subprocess.run(
        [*compiler(), *flags, "-o", str(library), str(place / "agent.c"), "-lm"], check=True
    )
    agent, state = ctypes.CDLL(str(library)), ctypes.create_string_buffer(2**20)
    actions = (ctypes.c_double * 16)()
    count = len(re.findall(r"^    AGENT_ACTION_", (place / "agent.h").read_text(), re.M))
    agent.agent_init(state)
    for row in measurements:
        assert agent.agent_step(state, (ctypes.c_double * len(row))(*row), actions) == 0
        yield actions[:count]


def in_fmu(fmi_version, name, folder, measurements):
    """Simulate the agent in FMPy."""
    path = exports(name, folder) / f"agent{fmi_version}.fmu"
    folder = extract(str(path), unzipdir=str(path.with_suffix("")))
    description = read_model_description(folder)
    references = {v.name: v.valueReference for v in description.modelVariables}
    inputs, outputs = (
        [references[name] for name in names_of(description, kind)] for kind in ("input", "output")
    )
    agent = instantiate_fmu(folder, description, "CoSimulation")
    if fmi_version == "2.0":
        agent.setupExperiment(startTime=0.0)
        write, read = agent.setReal, agent.getReal
    else:
        write, read = agent.setFloat64, agent.getFloat64
    agent.enterInitializationMode()
    write(inputs, measurements[0].tolist())
    agent.exitInitializationMode()
    period = float(description.defaultExperiment.stepSize)
    for count, row in enumerate(measurements):
        write(inputs, row.tolist())
        agent.doStep(count * period, period)
        yield list(read(outputs))
    agent.terminate()
    agent.freeInstance()


def in_onnx(name, folder, measurements):
    """Run the agent in ONNX Runtime."""
    with agent_for(name, folder) as agent:
        path = write_onnx(agent, folder / f"{name}.onnx")
    session = import_module("onnxruntime").InferenceSession(str(path))
    types = {"tensor(double)": np.float64, "tensor(float)": np.float32, "tensor(int64)": np.int64}
    types = {one.name: types[one.type] for one in session.get_inputs()}
    starts = json.loads(session.get_modelmeta().custom_metadata_map["memory"])
    memory = {name: np.array([start], types[name]) for name, start in starts.items()}
    names = ["actions", *(f"next_{name}" for name in memory)]
    for row in measurements:
        actions, *latest = session.run(names, {"measurements": row[None], **memory})
        memory = dict(zip(memory, latest, strict=True))
        yield actions[0]


FORMS_OF_AGENTS = {
    "C": in_c,
    "FMI 2.0": partial(in_fmu, "2.0"),
    "FMI 3.0": partial(in_fmu, "3.0"),
    "ONNX": in_onnx,
}
EXPORTED = ("cart_pole.toml", "sensors.toml", "levels.toml", "house.toml", "change.toml")
TRAINED = {"cart_pole.toml": 40, "swing_memory.toml": 3, "house.toml": 2}
"""Tasks, and the rounds of their searches: a network, a PID controller, and a choice of both."""


SAVED = (
    *("CartPole", "House", "Integral", "IntegralOnArrays", "IntegralOfEach", "Reach"),
    *("sensors.toml", "levels.toml", "change.toml", "season.toml", "houses.toml"),
    *("swing_data.toml", "swing_kpis.toml"),
)
"""Tasks whose episodes are saved and restored."""


def cases():
    """The functions by name; each takes a folder."""
    made = makers()
    return {
        **{f"single {name}": partial(single, make) for name, make in made.items()},
        **{f"vector {n} {mode}": partial(vector, make, mode) for (n, make), mode in by_mode(made)},
        **{f"registered {name}": partial(registered, name) for name in BUNDLED},
        **{f"version {n} {one}": partial(version, n, one) for n, one in VERSIONS},
        "rig": rig,
        **{f"scenario {name}": partial(scenario, name) for name in SCENARIOS},
        **{f"physical {name}": partial(physical, name) for name in UNPHYSICAL},
        **{f"fault {' '.join(one)}": partial(fault, *one) for one in product(FORMS, ON_FAULT, ALL)},
        "options": options,
        **{f"masks {n} {mode}": partial(masks, made[n], mode) for n, mode in by_mode(MASKED)},
        **{f"resting {name}": partial(resting, made[name]) for name in RESTING},
        **{f"snapshot {name}": partial(snapshot, made[name]) for name in SAVED},
        **{f"rollout {n}": partial(rollout, made[n], given) for n, given in ROLLOUTS.items()},
        **{f"exported {form} {n}": partial(exported, form, n) for form, n in AGENTS},
        **{f"training {n}": partial(training, n, rounds) for n, rounds in TRAINED.items()},
    }


def by_mode(made):
    return product(made.items() if isinstance(made, dict) else made, MODES)


VERSIONS = tuple(product(("CartPole", "Pendulum"), ("1.0", "3.0")))
SCENARIOS = ("house.toml autumn", "house.toml frost", "swing_scenarios.toml peak")
UNPHYSICAL = ("levels.toml", "change.toml", "sensors.toml", "house.toml")
MASKED = ("Brake", "Track", "Reach", "sensors.toml")
RESTING = ("Track", "IntegralOnArrays", "IntegralOfEach", "swing_memory.toml")
ALL = ("single", *MODES)
AGENTS = tuple(
    (form, name)
    for form, name in product(FORMS_OF_AGENTS, EXPORTED)
    if (form, name) != ("ONNX", "sensors.toml")  # which has random set points
)
