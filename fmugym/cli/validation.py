"""Validation of a task: checks of an environment, with cures.

Unlike ``fmugym.environment.env_checker``, which checks that a class keeps the contract of
environments, these checks look for tasks that run but cannot be learned.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from fmugym.checks import normal_form
from fmugym.cli.accuracy import Replay
from fmugym.cli.advice import Advice, CheckResult, ValidationReport, advise, advise_episodes
from fmugym.cli.class_skeleton import rounded_down
from fmugym.control.candidate_evaluation import most_steps_of
from fmugym.control.controller import Controller
from fmugym.control.controller_parsing import (
    controller_of,
    has_range,
    plans_ahead,
    simple_controllers,
)
from fmugym.control.controller_table import ControllerTable, is_table, named_controllers, parts_of
from fmugym.deployment.export.logic import logic_of
from fmugym.environment.distributions import draw, is_distribution
from fmugym.environment.env import FMUEnv
from fmugym.environment.episode import Quantity
from fmugym.environment.hooks import is_overridden
from fmugym.environment.vector import FMUVectorEnv
from fmugym.environment.vector.hook_check import CURE, find_difference, own_hooks
from fmugym.environment.vector.task_choice import hook_of_one, no_arrays
from fmugym.errors import FMUGymError
from fmugym.pool.failure_texts import asked_for
from fmugym.pool.pool import FloatArray
from fmugym.pool.trial.verdict import known_verdict
from fmugym.records.players import action_of
from fmugym.records.recorded_quantities import quantities_of
from fmugym.task import Task, TaskEnv, load
from fmugym.task.likely_units import Misreading, finite_values, misreadings
from fmugym.training.search.policy_search import tuning_steps
from fmugym.training.search.probe import MOST_PROBED

__all__ = ["validate"]

_MOST_STEPS: Final = 200
_SECONDS: Final = 5.0
"""Real time after which an episode of a check is cut short."""

_STEPS_BEFORE_RESTORE: Final = 10

_ENVS: Final = ((100e-6, 64), (1e-3, 16))
"""Numbers of environments that share the effort of a call, by the largest seconds of a step."""

_FEWEST_ENVS: Final = 8

_WIDE: Final = 100.0
"""An observation that is larger by this factor than another one hides it from most networks."""

_TINY: Final = 1e-5
"""Algorithms with gradients take smaller rewards for noise, and smaller differences beside the size
of rewards."""

_EXPLORED: Final = (0.1, 10.0)
"""Between these sizes are actions that they find by steps of about 1."""

_UNEVEN: Final = "of very different sizes"
"""Beginning of the finding for which ``normalize`` is recommended."""


@dataclass(frozen=True)
class _Episode:
    """Results of an episode of a check; arrays have one row for each step, the reset first.

    Attributes:
        observations: Shape (n + 1, k).
        rewards: Shape (n,).
        terminated: Whether the task has ended.
        fault: The reason of a fault; None if there was none.
        reset_time, step_time: Seconds of real time of the reset, and of a step.
    """

    observations: FloatArray
    rewards: FloatArray
    terminated: bool
    fault: str | None
    reset_time: float
    step_time: float


def validate(make_env: Callable[[], FMUEnv]) -> ValidationReport:
    """Check a task by some short episodes.

    Args:
        make_env: A function that makes the environment.

    Raises:
        FMUGymError: If the environment cannot be made.
    """
    with closing(make_env()) as env:
        env.action_space.seed(0)
        first = _play(env, env.action_space.sample)
        findings = [*_findings(env, first)]
        costs = {
            "step": first.step_time,
            "reset": _play(env, env.action_space.sample, most_steps=0).reset_time,
            "restore": _restore_time(env),
        }
        hooks, execution = _hooks(make_env), env.pool.execution
        recommended = _recommended(env, first.step_time, hooks, findings)
        others = [*_other_advices(env, recommended), *_advice_of_reward(env, first.rewards)]
        replay = Replay.of(env)
        steps = None if first.terminated else most_steps_of(env)
    more, advices = _repeated(replay, steps)
    advices += others
    checks = {one.check for one in more}
    before = (one for one in findings if one.verdict != "ok" or one.check not in checks)
    recommended |= {one.key: one.value for one in advices}
    return ValidationReport(
        (*before, *more),
        costs,
        hooks,
        execution,
        recommended["reset_method"],
        recommended,
        tuple(advices),
    )


def _repeated(replay: Replay, steps: int | None) -> tuple[list[CheckResult], list[Advice]]:
    """Check of repeated episodes."""
    found = list(advise(replay))
    findings = [one for one in found if isinstance(one, CheckResult)]
    advices = [one for one in found if isinstance(one, Advice)]
    known = {one.key for one in advices}
    for one in () if steps is None else advise_episodes(replay, steps):
        if one.key not in known:
            advices.append(one)
            if one.key == "episode_length":
                findings.append(CheckResult("warning", "length", one.why, f"give {one.line}"))
    return findings, advices


def _other_advices(env: FMUEnv, recommended: Mapping[str, Any]) -> Iterator[Advice]:
    """Advice that follows from other checks."""
    if recommended.get("normalize") and _has_limits(env.observation_space):
        yield Advice("agent", "normalize", True, f"observations are {_UNEVEN}")
    space: Any = env.action_space
    if _has_limits(space):
        size = np.abs([space.low, space.high]).max()
        if not _EXPLORED[0] <= size <= _EXPLORED[1]:
            why = f"actions reach {size:.3g}, which algorithms of other libraries do not expect"
            yield Advice("agent", "rescale", True, why)
    verdict = known_verdict(env.fmu)
    if verdict is not None and verdict.isolate:
        yield Advice("config", "isolation", "process", "instances disturb each other, or crash")


def _has_limits(space: spaces.Space[Any]) -> bool:
    """Whether observations or actions can be scaled by their limits."""
    return isinstance(space, spaces.Box) and bool(np.isfinite([space.low, space.high]).all())


def _restore_time(env: FMUEnv) -> float | None:
    """The seconds that it takes to go back to a state in the middle of an episode."""
    episode = _play(env, _always(_middle(env.action_space)), most_steps=_STEPS_BEFORE_RESTORE)
    if episode.fault is not None:
        return None
    try:
        snapshot = env.save_state()
        begin = time.perf_counter()
        env.restore_state(snapshot)
    except FMUGymError:
        return None
    return time.perf_counter() - begin


def _recommended(
    env: FMUEnv, step_time: float, hooks: str, findings: Sequence[CheckResult]
) -> dict[str, Any]:
    """Settings that suit the measurements."""
    settings: dict[str, Any] = {"reset_method": env.reset_method}
    if hooks != "none":
        settings["envs"] = next((n for most, n in _ENVS if step_time < most), _FEWEST_ENVS)
    if any(finding.text.startswith(_UNEVEN) for finding in findings):
        settings["normalize"] = True
    return settings


def _play(
    env: FMUEnv,
    choose: Callable[[], Any],
    options: Mapping[str, Any] | None = None,
    most_steps: int = _MOST_STEPS,
    seed: int = 0,
) -> _Episode:
    """Play an episode, or only its beginning."""
    begin = time.perf_counter()
    observation, _ = env.reset(seed=seed, options=options)
    after_reset = time.perf_counter()
    observations: list[Any] = [_flat(observation)]
    rewards: list[float] = []
    fault, terminated = None, False
    while len(rewards) < most_steps:
        observation, reward, terminated, truncated, info = env.step(choose())
        observations.append(_flat(observation))
        rewards.append(reward)
        fault = info.get("fault")
        if terminated or truncated or time.perf_counter() - after_reset > _SECONDS:
            break
    took = (time.perf_counter() - after_reset) / max(1, len(rewards))
    arrays = np.array(observations), np.array(rewards, np.float64)
    return _Episode(*arrays, terminated, fault, after_reset - begin, took)


def _flat(observation: Any) -> FloatArray:
    if isinstance(observation, Mapping):
        return np.concatenate([_flat(part) for part in observation.values()])
    return np.asarray(observation, np.float64).reshape(-1)


def _findings(env: FMUEnv, first: _Episode) -> Iterator[CheckResult]:
    yield _of_faults(first)
    if first.fault is not None and len(first.rewards) == 1:
        return  # nothing has moved: all else would only follow from that
    yield _of_repetition(env, first)
    pairs = {
        name: [_play(env, _always(value)) for value in ends]
        for name, *ends in _extremes(env.action_space, env.interface.input_names)
    }
    yield from _of_actions(env, pairs)
    yield from _of_parameters(env)
    yield from _of_inputs(env)
    yield _of_reward(first, [episode for pair in pairs.values() for episode in pair])
    misread = _misread(env)
    yield from _of_units(misread)
    second = _play(env, env.action_space.sample, seed=1)
    yield from _of_observations(env, first, second, misread)
    yield _of_length(env)
    yield from _of_controllers(env)
    yield from _of_hooks(env)
    yield _of_export(env)


def _of_faults(first: _Episode) -> CheckResult:
    steps = len(first.rewards)
    if first.fault is None:
        return CheckResult("ok", "run", f"{steps} steps with random actions")
    cure = "narrow the limits of the actions, shorten the time step, or use more substeps"
    if "the reward" in first.fault or "_reward_policy" in first.fault:
        cure = "look for a division by 0, a logarithm, a root or a power in the reward"
    elif key := asked_for(first.fault):
        cure = f"set {key} in the config"
    text = f"step {steps} of random actions failed: {first.fault}"
    return CheckResult("error", "run", text, cure)


def _of_repetition(env: FMUEnv, first: _Episode) -> CheckResult:
    env.action_space.seed(0)
    again = _play(env, env.action_space.sample)
    count = min(len(first.observations), len(again.observations))
    if np.array_equal(first.observations[:count], again.observations[:count]):
        return CheckResult("ok", "repetition", "the same seed gives the same episode")
    return CheckResult(
        "error",
        "repetition",
        "the same seed gives another episode",
        "the FMU is not deterministic, or keeps something over a reset: try isolation = "
        '"process" under [config] and reset_method = "process" under [foreign]',
    )


def _of_actions(env: FMUEnv, pairs: Mapping[str, Sequence[_Episode]]) -> Iterator[CheckResult]:
    """Compare episodes in which one action is at its lowest and its highest value."""
    unseen = [
        name
        for name, (low, high) in pairs.items()
        if np.array_equal(low.observations, high.observations)
    ]
    if unseen:
        yield CheckResult(
            "warning",
            "actions",
            f"no effect on observations: {', '.join(unseen)}",
            "leave them out, or name what they change in observations under [agent]",
        )
    elif _is_simple(env.action_space):
        yield CheckResult("ok", "actions", "each action has an effect")


def _is_simple(space: spaces.Space[Any]) -> bool:
    kinds = spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary
    return isinstance(space, kinds)


def _ends(space: Any) -> tuple[Any, Any]:
    """The lowest and the highest action, as arrays."""
    if isinstance(space, spaces.Box):
        return space.low, space.high
    low = np.full(space.shape, getattr(space, "start", 0), space.dtype)
    counts = getattr(space, "n" if isinstance(space, spaces.Discrete) else "nvec", 2)
    return low, np.asarray(low + counts - 1, space.dtype)


def _middle(space: Any) -> Any:
    if not _is_simple(space):
        return space.sample()
    low, high = _ends(space)
    return ((low.astype(np.float64) + high) / 2).astype(space.dtype)[()]


def _extremes(space: Any, names: tuple[str, ...]) -> Iterator[tuple[str, Any, Any]]:
    """For each element of an action, a name and actions that differ in this element only."""
    low, high = _ends(space) if _is_simple(space) else (np.empty(0),) * 2
    for index, place in enumerate(np.ndindex(low.shape)):
        first, second = np.array(_middle(space)), np.array(_middle(space))
        first[place], second[place] = low[place], high[place]
        name = names[index] if len(names) == low.size else f"element {index}"
        yield name if low.ndim else "the action", first[()], second[()]


def _always(action: Any) -> Callable[[], Any]:
    return lambda: action


def _differ(first: _Episode, second: _Episode) -> bool:
    same = np.array_equal(first.observations, second.observations)
    return not same or not np.array_equal(first.rewards, second.rewards)


def _of_parameters(env: FMUEnv) -> Iterator[CheckResult]:
    """Compare episodes with two values of each parameter of the task, or of all of an array."""
    given = {name: _numbers_of(env, name) for name in env.config.model_parameters}
    useless = [name for name, values in given.items() if not _has_effect(env, values)]
    if useless:
        yield CheckResult(
            "warning",
            "parameters",
            f"without an effect: {', '.join(useless)}",
            "look for another parameter that the model uses, or leave them out",
        )
    elif given:
        yield CheckResult("ok", "parameters", "each parameter of the task has an effect")


def _numbers_of(env: FMUEnv, name: str) -> dict[str, Any]:
    """Numbers of a parameter by scalar; none for Strings and structural parameters."""
    known = env.interface.parameters
    scalars = env.fmu.description.scalars(name)
    return {v.name: known[v.name] for v in scalars if v.name in known}


def _has_effect(env: FMUEnv, given: Mapping[str, Any]) -> bool:
    """Whether two values give different episodes; also true if only one value is possible."""
    pairs = {name: _two_values(env, name, value) for name, value in given.items()}
    if all(first == second for first, second in pairs.values()):
        return True
    # The middle action, at which a process may rest, and another one.
    others = itertools.islice(_extremes(env.action_space, ()), 1)
    actions = [_middle(env.action_space), *(first for _, first, _ in others)]
    options = [
        {"model_parameters": {name: pair[place] for name, pair in pairs.items()}}
        for place in (0, 1)
    ]
    try:
        return any(
            _differ(*(_play(env, _always(action), one) for one in options)) for action in actions
        )
    except FMUGymError:  # the FMU does not take a value that was made up here
        return True


def _two_values(env: FMUEnv, name: str, value: Any) -> list[Any]:
    """Two draws, or a constant and another number near it."""
    if is_distribution(value):
        rng = np.random.default_rng(0)
        return [draw(value, rng) for _ in range(2)]
    if env.fmu.variable(name).kind != "real":
        return [value, value]
    return [value, 1.1 * value if value else 0.1]


def _of_inputs(env: FMUEnv) -> Iterator[CheckResult]:
    """Tell the inputs of the FMU that nobody writes."""
    interface = env.interface
    written = {*interface.input_names, *interface.parameters}
    idle = [
        variable.name
        for variable in env.fmu.description.variables.values()
        if variable.causality == "input"
        and not variable.ticking
        and variable.is_number
        and written.isdisjoint(one.name for one in variable.elements)
    ]
    if idle:
        yield CheckResult(
            "warning",
            "inputs",
            f"stay at their start values: {', '.join(idle)}",
            "write them by actions, [inputs] or data, or fix them under [parameters]",
        )


def _of_reward(first: _Episode, others: Sequence[_Episode]) -> CheckResult:
    rewards = first.rewards
    low, high = rewards.min(), rewards.max()
    if low == high:
        text = f"always {low:g} with random actions"
        cure = "an agent learns from differences; that is fine only if episodes end early"
    elif (
        first.fault is None
        and others
        and all(np.array_equal(rewards, one.rewards) for one in others)
    ):
        text = f"the same in {len(rewards)} steps, whatever the actions"
        cure = "let it depend on what the actions change"
    elif first.terminated and high < 0.0 and rewards[-1] > 2.0 * rewards[:-1].min(initial=0.0):
        text = f"from {low:.4g} to {high:.4g} until the task ends: never positive, so an end pays"
        cure = "that is fine if the end is a goal; otherwise take off much where 'done' is true"
    elif factor := _factor_of(rewards):
        text = f"from {low:.4g} to {high:.4g} with random actions, a difference of {high - low:.2g}"
        cure = f"multiply what differs by {factor:g}; only --algorithm minds"
    else:
        return CheckResult("ok", "reward", f"from {low:.4g} to {high:.4g} with random actions")
    return CheckResult("warning", "reward", text, cure)


def _factor_of(rewards: FloatArray) -> float:
    """Rounded factor that brings tiny rewards or differences near 1; 0 if none are tiny."""
    size, spread = np.abs(rewards).max(), np.ptp(rewards)
    tiny = size if size < _TINY else spread
    return rounded_down(1 / tiny) if 0.0 < tiny < _TINY * max(1.0, size) else 0.0


def _advice_of_reward(env: FMUEnv, rewards: FloatArray) -> Iterator[Advice]:
    """The line with larger rewards."""
    given, factor, low = _document(env).get("reward"), _factor_of(rewards), rewards.min()
    if factor and isinstance(given, str):
        offset = "" if abs(low) < _TINY else f" {'+' if low < 0 else '-'} {abs(low):.17g}"
        why = f"rewards differ by {np.ptp(rewards):.2g}, which algorithms take for noise"
        yield Advice("", "reward", f"{factor:g} * ({given}{offset})", why)


def _document(env: FMUEnv) -> Mapping[str, Any]:
    """Declarations of an environment's task; an empty dict for a class without a task."""
    task = getattr(env, "task", None)
    return task.document if isinstance(task, Task) else {}


def _misread(env: FMUEnv) -> list[Misreading]:
    """The variables of a declared task whose values seem to be in another unit."""
    if not isinstance(env, TaskEnv):
        return []
    quantities, rows = quantities_of(env), list[Any]()

    def choose() -> Any:
        rows.append(quantities.read(env))
        return env.action_space.sample()

    env.action_space.seed(0)
    _play(env, choose)
    columns = zip(quantities.all, zip(*rows, strict=True), strict=True)
    seen = {one.name: finite_values(values) for one, values in columns}
    return list(misreadings(env, seen))


def _of_units(misread: Sequence[Misreading]) -> Iterator[CheckResult]:
    """Report likely units of numbers to which the FMU gives no unit."""
    for one in misread:
        verdict = "warning" if one.is_converted else "ok"
        verdict = "error" if one.contradicts else verdict
        yield CheckResult(verdict, "units", one.text, f"write {one.line} under [variables]")


def _of_observations(
    env: FMUEnv, first: _Episode, second: _Episode, misread: Sequence[Misreading]
) -> Iterator[CheckResult]:
    space, seen = env.observation_space, first.observations
    if not isinstance(space, spaces.Box):
        return
    names = env.observation_names or tuple(f"element {i}" for i in range(seen.shape[1]))
    contradicting = {one.name for one in misread if one.contradicts}
    findings = [*_of_limits(env, space, names, seen, contradicting | _erring(env, names))]
    if not _is_normalized(env):
        findings += _of_sizes(names, seen)
    findings += _of_still(env, names, np.concatenate([seen, second.observations]))
    fine = CheckResult("ok", "observations", "within their limits, and of similar sizes")
    yield from findings or [fine]


def _is_normalized(env: FMUEnv) -> bool:
    """Whether a task maps observations from their limits to the range from -1 to 1."""
    return _document(env).get("agent", {}).get("normalize") in (True, "limits")


def _of_limits(
    env: FMUEnv, space: spaces.Box, names: tuple[str, ...], seen: Any, misread: Set[str]
) -> Iterator[CheckResult]:
    """Report observations beyond their limits, except those in another unit or with errors."""
    outside = ((seen < space.low.reshape(-1)) | (seen > space.high.reshape(-1))).any(axis=0)
    outside &= [name not in misread for name in names]
    if outside.any():
        listing = ", ".join(_range(env, names[i], seen[:, i]) for i in np.flatnonzero(outside))
        yield CheckResult(
            "warning", "observations", f"outside of their limits: {listing}", "widen min and max"
        )


def _erring(env: FMUEnv, names: Sequence[str]) -> set[str]:
    """The forecasts with errors, which may exceed any limits."""
    task = getattr(env, "task", None)
    if not isinstance(task, Task):
        return set()
    forecasts = [one.value for one in task.root.child("agent").child("forecast").elements()]
    erring = {normal_form(name) for one in forecasts if one.get("error") for name in one["of"]}
    parts = ((name, *normal_form(name).partition("[+")) for name in names)
    return {name for name, own, sign, _ in parts if sign and own in erring}


def _range(env: FMUEnv, name: str, values: Any) -> str:
    """The values of an observation, in the unit of the task."""
    found = {one.name: one for one in quantities_of(env).all}.get(name, Quantity(name, "output"))
    if _is_normalized(env) and math.isfinite(found.high - found.low):
        values = found.low + (values + 1.0) / 2.0 * (found.high - found.low)
    return f"{name} ({values.min():.4g} to {values.max():.4g} {found.unit}".rstrip() + ")"


def _of_sizes(names: tuple[str, ...], seen: Any) -> Iterator[CheckResult]:
    sizes = np.abs(seen).max(axis=0)
    if sizes.max() > _WIDE * max(1.0, sizes.min()):
        largest = names[int(sizes.argmax())]
        yield CheckResult(
            "warning",
            "observations",
            f"{_UNEVEN}: {largest} reaches {sizes.max():.4g}",
            "give min and max and normalize = true under [agent], or another unit",
        )


def _of_still(env: FMUEnv, names: tuple[str, ...], seen: Any) -> Iterator[CheckResult]:
    """Tell continuous outputs that have one value in two episodes."""
    outputs = {one.name for one in quantities_of(env).all if one.kind == "output"}
    still = [
        name
        for name in itertools.compress(names, np.ptp(seen, axis=0) == 0.0)
        if name in outputs and env.fmu.variable(_own_name(env, name)).variability == "continuous"
    ]
    if still:
        text = f"never change, whatever the actions: {', '.join(still)}"
        cure = "leave them out of observations under [agent]"
        yield CheckResult("warning", "observations", text, cure)


def _own_name(env: FMUEnv, name: str) -> str:
    """Name in the FMU of a variable that has another name in the task."""
    return str(_document(env).get("variables", {}).get(name, {}).get("name", name))


def _of_length(env: FMUEnv) -> CheckResult:
    steps, stop_time = most_steps_of(env), env.config.stop_time
    if steps is not None or stop_time is not None:
        what = f"at most {steps} steps" if steps is not None else f"until t = {stop_time} s"
        return CheckResult("ok", "length", f"an episode takes {what}")
    return CheckResult(
        "warning",
        "length",
        "an episode has no limit of steps",
        "give episode_length, unless every episode terminates",
    )


def _of_controllers(env: FMUEnv) -> Iterator[CheckResult]:
    """Tell whether each controller of the task file can act, and which actions none moves."""
    task = getattr(env, "task", None)
    if not isinstance(task, Task):
        return
    given = task.root.child("controllers").value or {}
    texts, names = named_controllers(given), env.action_names or ()
    wrong, moved = _tried(env, task, texts) if texts else ([], set[str]())
    yield from wrong
    most = MOST_PROBED + tuning_steps(most_steps_of(env), not env.episode_start.drawn_names)
    steps = f"{most:,} steps at most"
    if texts and not wrong:
        tuned = ", ".join(name for name, one in texts.items() if has_range(one))
        more = f"; 'fmugym train' tunes {tuned} with {steps} each" if tuned else ""
        yield CheckResult("ok", "controllers", f"each can act: {', '.join(texts)}{more}")
    rest = [name for name in names if name not in moved]
    if len(names) > 1 and rest:
        table = ", ".join(f"{name} = ..." for name in names)
        yield CheckResult(
            "warning" if texts else "ok",
            "controllers",
            f"none of the file moves {', '.join(rest)}; ranges of one for all actions are tuned "
            f"with {steps}",
            f"give a table, {{ {table} }}",
        )


def _tried(env: FMUEnv, task: Task, texts: Mapping[str, Any]) -> tuple[list[CheckResult], set[str]]:
    """Check controllers: their mistakes, and the actions that they move.

    Those that stand in tables, or act in the warm-up, need not fit all actions.
    """
    wrong, moved, parts = list[CheckResult](), set[str](), _parts(task)
    given_to_env = {} if env.spec is None else env.spec.kwargs
    master = {name: one for name, one in given_to_env.items() if name == "master"}
    with closing(load(task.physical(), **master)) as physical:
        for name, text in texts.items():
            try:
                with task.root.child("controllers").child(name).placing():
                    moved.update(_moved(_bound(physical, text), env.action_names or ()))
            except FMUGymError as error:
                cure = "let it measure what the agent observes, and give a number for each action"
                found = CheckResult("error", "controllers", str(error), cure)
                wrong += [] if name in parts else [found]
    return wrong, moved


def _parts(task: Task) -> set[Any]:
    """The names of controllers that stand in tables or act in the warm-up."""
    known = task.root.child("controllers").value or {}
    warm = task.root.child("warm_up").child("controller").value
    return parts_of({**known, "": warm}) | {None if is_table(warm) else warm}


def _bound(env: FMUEnv, given: Any) -> Controller | None:
    """Bind a controller; returns None for a constant action.

    The copies that an MPC plans with take too long.
    """
    if not isinstance(given, str):
        action_of(env, str(given))
        return None
    if plans_ahead(given):
        controller = controller_of(given)
        if isinstance(warm := getattr(controller, "warm", None), Controller):
            warm.bind(env)
        return controller
    (controller,) = simple_controllers({"": given})
    return controller.bind(env)


def _moved(controller: Controller | None, names: Sequence[str]) -> Sequence[str]:
    """Actions that a bound controller moves."""
    if isinstance(controller, ControllerTable):
        return controller.moved
    return () if controller is None else names


def _of_hooks(env: FMUEnv) -> Iterator[CheckResult]:
    """Tell whether the hooks of a class work on arrays, and whether the class says so."""
    if is_overridden(env, "step") or is_overridden(env, "reset") or not own_hooks(env):
        return
    difference, hook = no_arrays(env) or find_difference(env), hook_of_one(type(env))
    if difference is None and hook is None:
        yield CheckResult("ok", "hooks", "they give on arrays what they give one by one")
    elif difference is None:
        text = f"{hook} works on arrays, but its class does not say so"
        yield CheckResult("warning", "hooks", text, "write vectorized = True in the class")
    elif hook is None:
        cure = f"{CURE}; or take vectorized = True out of the class"
        yield CheckResult("error", "hooks", difference, cure)
    else:
        text = f"a vector environment calls them one by one: {difference}"
        yield CheckResult("warning", "hooks", text, f"{CURE}, and vectorized = True")


def _of_export(env: FMUEnv) -> CheckResult:
    """Tell before the training whether its agent can leave Python."""
    try:
        measured = [variable.name for variable in logic_of(env).measurements]
    except FMUGymError as error:
        cure = "an agent acts in Python all the same; docs/deploy.md says what can be exported"
        return CheckResult("warning", "export", str(error), cure)
    names = ", ".join(measured) or "nothing"
    return CheckResult("ok", "export", f"an agent can be exported; it measures {names}")


def _hooks(make_env: Callable[[], FMUEnv]) -> str:
    try:
        envs = FMUVectorEnv(make_env, 1)
    except FMUGymError:
        return "none"
    envs.close()
    return envs.task.way
