"""Model predictive control: the next action of the best plan that copies of the FMU have found."""

from __future__ import annotations

import copy
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from time import perf_counter
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.baselines.base import Controller, FloatArray
from fmugym.baselines.cma import CMA
from fmugym.checks import check_number, check_seed, duration
from fmugym.distributions import is_distribution
from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, shown
from fmugym.task.future import Future
from fmugym.task.snapshot import Snapshot
from fmugym.vector import FMUVectorEnv
from fmugym.vector.rollouts import costs_in

__all__ = ["MPC"]

_DAY: Final = 86400.0
_SIGMA: Final = 0.25
"""Of the first candidates, as a part of the range of an action."""

_SAMPLES: Final = 1001
"""The nominal value of what is drawn is the median of so many samples."""

_PENALTY: Final = 1e9
"""How much more a unit of a cost beyond its limit counts than one of the reward."""

_FORECAST: Final = re.compile(r"(.+)\[\+(.+) s\]")


class MPC(Controller):
    """Model predictive control with copies of the FMU as the model.

    In each step, candidates for the actions until the horizon play on copies of the environment,
    and the first action of the best one is taken. The reward is that of the task. A plan has a few
    moves, each of which holds for the same number of steps. Plans that keep the limits of costs
    come first. The search begins with the plan of the step before, and goes on by the adaptation of
    a covariance matrix (``fmugym.baselines.cma``).

    The controller sees what an agent sees. A copy begins in the nominal state of the task and gets
    the same actions. It reads data as they were observed, and ahead as they are forecast. Beyond a
    forecast, the value of a day before is repeated; data that are not observed have their mean,
    without that of the scenarios.
    Differences between what is observed and what the copy gives, filtered, become offsets of the
    outputs. The controller is told the episode variables, such as the clock, but no noise.

    Args:
        horizon: How far plans go: seconds, or a text such as ``"24h"``.
        moves: The most moves of a plan.
        candidates: How many candidates play in a decision.
        rounds: How often the search learns from them in a decision.
        warm: A controller whose actions are a candidate, too, bound to nothing else.
        correction: By which part the offsets follow the differences in a step, from 0 to 1.
        budget: How long a decision may take, in seconds of real time, if the FMU cannot save its
            state; None for any time.
        states: For plants that a copy would not stay close to, such as unstable ones: by the name
            of an observation the parameter of the FMU in which an episode begins with this state,
            in the same unit, as a dict or as ``"theta:theta_0,theta_dot:theta_dot_0"``. Each
            decision then begins in the state that was observed, corrected by ``correction``. It
            needs all states, and a task without data.
        perfect: Whether the true state and the true future are known. Nobody can beat this but by
            a better search; it shows how much there is to gain.
        seed: Of the candidates. The same arguments give the same actions.
    """

    def __init__(
        self,
        horizon: Any,
        moves: float = 24,
        candidates: float = 256,
        rounds: float = 4,
        warm: Controller | None = None,
        correction: float = 0.3,
        budget: float | None = 1.0,
        states: Mapping[str, str] | str | None = None,
        perfect: bool | str = False,
        seed: float = 0,
    ) -> None:
        self.horizon = check_number("horizon", duration("horizon", horizon), positive=True)
        self.moves, self.rounds = _whole("moves", moves, 1), _whole("rounds", rounds, 1)
        self.candidates = _whole("candidates", candidates, 8 * self.rounds)
        self.warm = warm
        self.correction = check_number("correction", correction, 0.0, 1.0)
        self.budget = None if budget is None else check_number("budget", budget, positive=True)
        if perfect not in (True, False, "true", "false"):
            raise ConfigError(f"perfect must be true or false, got {shown(perfect)}")
        self.perfect = perfect in (True, "true")
        self.states = _pairs(states)
        self.seed = check_seed(_whole("seed", seed, 0)) or 0
        self._envs: list[FMUVectorEnv] = []

    def bind(self, env: Any, names: Any = None) -> MPC:
        """See ``Controller.bind``.

        Raises:
            ConfigError: Also if the environment cannot be saved, its actions have no limits or are
                no numbers, or the horizon is shorter than a step or longer than the data.
        """
        self._env: Any = env.unwrapped
        return super().bind(env, names)

    def close(self) -> None:
        """Free the copies."""
        while self._envs:
            self._envs.pop().close()

    def _prepare(self) -> None:
        self.close()
        self._low, self._high = _limits(self.space)
        steps = round(self.horizon / self.time_step)
        if steps < 1:
            raise ConfigError(
                f"the horizon of {self.horizon:g} s is shorter than the step of "
                f"{self.time_step:g} s"
            )
        length = -(-steps // self.moves)
        self._move_of = np.arange(steps) // length
        self._count_of_moves = int(self._move_of[-1]) + 1
        self._size = self._count_of_moves * self._low.size
        with _single(self._env, 0) as env:
            if env.inside.pool.save_method is None:
                raise ConfigError(
                    "MPC needs an FMU that it can copy, but a backend stands in for this one"
                )
            make = partial(copy.copy, env)
            self._cost_limits = getattr(env, "cost_limits", {})
            self._step_limit = env.inside.step_limit
            future = env.inside.future or Future({}, (), float)
        lookups = future.lookups
        for name, lookup in lookups.items():
            _require_within(self.horizon, name, lookup.period)
        self._places = [self._place_of(name) for name in self.states]
        if self.states and lookups:
            raise ConfigError(
                f"MPC takes 'states' for tasks without data only, but there is {min(lookups)!r}"
            )
        self._foresight = _Foresight(self.names, future, self.time_step, steps)
        for count in (1, self.candidates // self.rounds):
            self._envs.append(FMUVectorEnv(make, count, autoreset_mode="Disabled"))
        if self.warm is not None:
            self.warm.bind(self._envs[0], self.names)
        self._inverse: FloatArray | None = None

    def _place_of(self, name: str) -> int:
        self._check_signal("states", name)
        return self.names.index(name)

    def _forget(self, mask: npt.NDArray[np.bool_]) -> None:
        if mask.all():
            self._episodes: list[_Episode | None] = [None] * self.count
        for index in np.flatnonzero(mask).tolist():
            self._episodes[index] = None

    def _decide(self, rows: FloatArray) -> FloatArray:
        decided = [self._decide_one(index, row) for index, row in enumerate(rows)]
        return np.array(decided)

    def _decide_one(self, index: int, row: FloatArray) -> FloatArray:
        begin = perf_counter()
        with _single(self._env, index) as env:
            future = env.inside.future
            now = 0.0 if future is None else float(future.clock(env))
            episode = self._episodes[index]
            if episode is None:
                episode = self._episodes[index] = self._begun(env)
            else:
                self._follow(episode, row, now)
        start, data, assumed = self._start_of(index, episode, row, now)
        with ExitStack() as stack:
            for envs in self._envs:
                stack.enter_context(envs.inside.episodes.assuming(data))
            episode.plan = self._search(episode, start, assumed, row)
        episode.rows.append(row)
        episode.action = self._actions(episode.plan[np.newaxis])[0, :1]
        self._require_time(start, perf_counter() - begin)
        return np.asarray(episode.action[0], np.float64)

    def _require_time(self, start: Snapshot, took: float) -> None:
        if start.method == "replay" and self.budget is not None and took > self.budget:
            raise ConfigError(
                f"a decision took {took:.3g} s of at most {self.budget:g} s: the FMU cannot save "
                "its state, so that each candidate plays the episode again. Take fewer candidates, "
                "or a larger budget"
            )

    # The copy that runs beside the environment.

    def _begun(self, env: FMUEnv) -> _Episode:
        """Begin an episode of the copy, in the nominal state."""
        copied, episode = self._envs[0], _Episode()
        values = _nominal(env)
        if env.config.draws_start_time:
            values["start_time"] = env.time - env.step_count * env.config.time_step
        options = {"model_parameters": values} if values else {}
        observations, _ = copied.reset(seed=self.seed, options=options)
        keys = () if env.inside.future is None else env.inside.future.keys
        for name, value in env.variables.items():
            if np.ndim(value) == 0 and name not in keys:
                copied.inside.engine.set_variable(name, np.array([float(value)]))
        episode.seen = np.asarray(observations[0], np.float64)
        episode.snapshot = copied.save_state()
        episode.plan = np.full(self._size, 0.5)
        episode.warm = copy.deepcopy(self.warm)
        if self._inverse is None:
            self._inverse = self._find_inverse(episode.snapshot)
        episode.offsets = np.zeros(len(self._inverse))
        return episode

    def _follow(self, episode: _Episode, row: FloatArray, now: float) -> None:
        """Let the copy do the step that the environment has done, with what was observed."""
        if episode.has_ended:
            return
        copied = self._envs[0]
        data = self._foresight.observed(episode.rows[-1], row, now)
        with copied.inside.episodes.assuming(data):
            copied.restore_state(episode.snapshot)
            observations, _, terminated, truncated, infos = copied.step(episode.action)
            for name, values in costs_in(infos, (1,)).items():
                episode.costs[name] = episode.costs.get(name, 0.0) + float(values[0])
            episode.has_ended = bool(terminated[0] or truncated[0])
            if not episode.has_ended:
                episode.seen = np.asarray(observations[0], np.float64)
                episode.snapshot = copied.save_state()

    def _find_inverse(self, snapshot: Snapshot) -> FloatArray:
        """How offsets of the outputs follow from differences of observations."""
        copied = self._envs[0]
        action = self._actions(np.full((1, self._size), 0.5))
        seen = partial(copied.rollout, snapshot, action[:, :1])
        plain = seen().observations[0, 0].astype(np.float64)
        columns = []
        for name in copied.inside.prototype.out:
            change = seen(offsets={name: 1.0}).observations[0, 0] - plain
            columns.append(np.where(self._foresight.is_present, change, 0.0))
        slopes = np.array(columns).T
        return np.linalg.pinv(np.where(np.abs(slopes) < 1e-4, 0.0, slopes), rcond=1e-6)

    def _start_of(
        self, index: int, episode: _Episode, row: FloatArray, now: float
    ) -> tuple[Snapshot, dict[str, Any], dict[str, Any]]:
        """Where candidates begin, the data that they assume, and more arguments of rollouts."""
        if self.perfect:
            is_vector = hasattr(self._env, "num_envs")
            return self._env.save_state(*([[index]] if is_vector else [])), {}, {}
        if self.states:
            return self._moved(episode, row), {}, {"seed": self.seed}
        assert self._inverse is not None
        wanted = self._inverse @ (row - episode.seen)
        episode.offsets += self.correction * (wanted - episode.offsets)
        names = list(self._envs[0].inside.prototype.out)
        assumed = {
            "offsets": dict(zip(names, episode.offsets.tolist(), strict=True)),
            "seed": self.seed,
        }
        return episode.snapshot, self._foresight.ahead([*episode.rows, row], now), assumed

    def _moved(self, episode: _Episode, row: FloatArray) -> Snapshot:
        """Let the copy go on in the state that was observed."""
        expected = episode.seen[self._places]
        values = expected + self.correction * (row[self._places] - expected)
        values = row[self._places] if not episode.rows else values
        starts = dict(zip(self.states.values(), values.tolist(), strict=True))
        copied = self._envs[0]
        options = {"model_parameters": _nominal(copied.inside.prototype) | starts}
        copied.reset(seed=self.seed, options=options)
        episode.snapshot, episode.has_ended = copied.save_state(), False
        return episode.snapshot

    # The search for a plan.

    def _actions(self, plans: FloatArray) -> Any:
        """The actions of plans of shape (n, moves * m), shape (n, steps, ...)."""
        moves = np.clip(plans, 0.0, 1.0).reshape(len(plans), -1, self._low.size)
        values = self._low + moves[:, self._move_of] * (self._high - self._low)
        if isinstance(self.space, spaces.Discrete):
            return np.rint(values[..., 0]).astype(self.space.dtype)
        return values.reshape(*values.shape[:2], *self.space.shape or ()).astype(self.space.dtype)

    def _plan_of(self, actions: FloatArray) -> FloatArray:
        """The plan whose moves are the means of actions of shape (steps, m)."""
        parts = (actions.reshape(len(actions), -1) - self._low) / (self._high - self._low)
        each = range(self._count_of_moves)
        moves = np.array([parts[self._move_of == move].mean(axis=0) for move in each])
        plan: FloatArray = np.clip(moves, 0.0, 1.0).ravel()
        return plan

    def _search(
        self, episode: _Episode, start: Snapshot, assumed: Mapping[str, Any], row: FloatArray
    ) -> FloatArray:
        """The best plan of all that play."""
        one, many = self._envs
        plans = [self._shifted(episode.plan)]
        if episode.warm is not None:
            plans.append(self._plan_of(self._warm_actions(episode.warm, row, start, assumed)))
        allowed = self._allowed(episode)
        found = [self._value(one, start, plan[np.newaxis], assumed, allowed) for plan in plans]
        best, most = plans[int(np.argmax(found))], float(max(found)[0])
        rng = np.random.default_rng([self.seed, len(episode.rows)])
        cma = CMA(best, _SIGMA, many.num_envs, rng, np.ones(best.size), largest_sigma=_SIGMA)
        for _ in range(self.rounds):
            tried = np.clip(cma.ask(), 0.0, 1.0)
            values = self._value(many, start, tried, assumed, allowed)
            cma.tell(np.argsort(-values, kind="stable"))
            leader = int(values.argmax())
            if values[leader] > most:
                best, most = tried[leader], float(values[leader])
        mean = np.clip(cma.mean, 0.0, 1.0)
        value = self._value(one, start, mean[np.newaxis], assumed, allowed)[0]
        return mean if value > most else best

    def _value(
        self,
        envs: FMUVectorEnv,
        start: Snapshot,
        plans: FloatArray,
        assumed: Mapping[str, Any],
        allowed: Mapping[str, float],
    ) -> FloatArray:
        """The returns of plans; whatever goes beyond the limit of a cost counts far more."""
        found = envs.rollout(start, self._actions(plans), **assumed)
        values: FloatArray = found.rewards.sum(axis=1)
        for name, paid in found.costs.items():
            if name in allowed:
                excess = np.maximum(paid.sum(axis=1) - allowed[name], 0.0)
                values = values - _PENALTY * excess
        return values

    def _allowed(self, episode: _Episode) -> dict[str, float]:
        """What costs may add up to until the horizon, from what the episode has left of them."""
        steps = len(self._move_of)
        left = (
            max(1, self._step_limit - len(episode.rows))
            if self._step_limit < sys.maxsize
            else steps
        )
        return {
            name: max(0.0, limit - episode.costs.get(name, 0.0)) * min(1.0, steps / left)
            for name, limit in self._cost_limits.items()
        }

    def _shifted(self, plan: FloatArray) -> FloatArray:
        """A plan, one step later."""
        actions = self._actions(plan[np.newaxis])[0].astype(np.float64)
        return self._plan_of(np.append(actions[1:], actions[-1:], axis=0))

    def _warm_actions(
        self, warm: Controller, row: FloatArray, start: Snapshot, assumed: Mapping[str, Any]
    ) -> FloatArray:
        """The actions of another controller until the horizon."""
        ahead, actions = copy.deepcopy(warm), list[Any]()
        warm.act(row[np.newaxis])

        def policy(observations: Any) -> Any:
            actions.append(ahead.act(observations))
            return actions[-1]

        self._envs[0].rollout(start, policy, horizon=len(self._move_of), **assumed)
        return np.array(actions, np.float64)[:, 0]


class _Episode:
    """What is known of the episode of one environment.

    Attributes:
        snapshot: Where the copy is.
        seen: What the copy observes, shape (k,).
        has_ended: Whether the episode of the copy has ended; the last snapshot stays.
        offsets: What is added to its outputs.
        plan: The latest plan, flat, from 0 to 1.
        action: The latest action, as the copy takes it.
        rows: All observations.
        costs: What the costs of the copy add up to, by name.
        warm: The other controller, as if it had seen the same.
    """

    snapshot: Snapshot
    seen: FloatArray
    offsets: FloatArray
    plan: FloatArray
    action: Any
    warm: Controller | None

    def __init__(self) -> None:
        self.rows: list[FloatArray] = []
        self.costs: dict[str, float] = {}
        self.has_ended = False


class _Foresight:
    """Tells from observations what data will be.

    Args:
        names: Those of the observation's elements.
        future: Has the data.
        time_step: The length of a step in s.
        steps: Those until the horizon.

    Attributes:
        is_present: Which elements are present values, shape (k,).
    """

    def __init__(
        self,
        names: Sequence[str],
        future: Future,
        time_step: float,
        steps: int,
    ) -> None:
        self._lookups, self._time_step, self._steps = future.lookups, time_step, steps
        self.is_present = np.array(["[" not in name for name in names])
        self._known: dict[str, list[tuple[float, int]]] = {name: [] for name in future.lookups}
        self._means = {n: one.mean(future.held_out) for n, one in future.lookups.items()}
        for place, name in enumerate(names):
            match = _FORECAST.fullmatch(name)
            of, ahead = (match[1], float(match[2])) if match else (name, 0.0)
            if of in self._known:
                self._known[of].append((ahead, place))

    def ahead(self, rows: Sequence[FloatArray], now: float) -> dict[str, Any]:
        """Times and values from now on, by name.

        Args:
            rows: The observations until now.
            now: The time of the data.
        """
        return {name: self._course(name, rows, now) for name in self._lookups}

    def _course(self, name: str, rows: Sequence[FloatArray], now: float) -> tuple[Any, Any]:
        lookup, known = self._lookups[name], sorted(self._known[name])
        if not known:
            return [now], [self._means[name]]
        count = min(self._steps + 2, int(np.ceil(lookup.period / self._time_step)))
        times = np.arange(count) * self._time_step
        aheads = np.array([ahead for ahead, _ in known])
        values = rows[-1][[place for _, place in known]]
        if lookup.is_stepped:
            places = np.searchsorted(aheads, times + 1e-6 * self._time_step, side="right") - 1
            course = values[np.maximum(places, 0)]
        else:
            course = np.interp(times, aheads, values)
        self._repeat_days(course, rows, known, float(aheads[-1]))
        return now + times, course

    def _repeat_days(
        self, course: FloatArray, rows: Sequence[FloatArray], known: Any, last: float
    ) -> None:
        """Replace values beyond a forecast by those of a day before, if these are known."""
        day, (ahead, place) = round(_DAY / self._time_step), known[0]
        for step in range(int(last / self._time_step) + 1, len(course)):
            before = step - day
            if before >= 0:
                course[step] = course[before]
            elif ahead == 0.0 and len(rows) - 1 + before >= 0:
                course[step] = rows[len(rows) - 1 + before][place]

    def observed(self, before: FloatArray, row: FloatArray, now: float) -> dict[str, Any]:
        """Times and values of the step that has just ended, by name."""
        found = {}
        for name in self._lookups:
            places = [place for ahead, place in self._known[name] if ahead == 0.0]
            values = [before[places[0]], row[places[0]]] if places else [self._means[name]] * 2
            found[name] = [now - self._time_step, now], values
        return found


def _require_within(horizon: float, name: str, period: float) -> None:
    if horizon > period:
        raise ConfigError(
            f"the horizon of {horizon:g} s is longer than the data {name!r}, which repeat after "
            f"{period:g} s; take horizon={period:g} or less"
        )


def _whole(what: str, value: float, least: int) -> int:
    number = check_number(what, value, least)
    if number != int(number):
        raise ConfigError(f"{what} must be a whole number, got {shown(value)}")
    return int(number)


def _limits(space: spaces.Space[Any]) -> tuple[FloatArray, FloatArray]:
    """The lowest and the highest numbers of an action."""
    if isinstance(space, spaces.Discrete):
        first = float(space.start)
        return np.array([first]), np.array([first + float(space.n) - 1])
    if not isinstance(space, spaces.Box):
        raise ConfigError(f"MPC needs actions of numbers or one choice, but they are of {space}")
    low, high = (np.asarray(side, np.float64).ravel() for side in (space.low, space.high))
    if not np.isfinite([low, high]).all():
        raise ConfigError("MPC needs actions with limits: give their variables 'min' and 'max'")
    return low, high


@contextmanager
def _single(env: Any, index: int) -> Iterator[FMUEnv]:
    """An environment, or one of many."""
    if not hasattr(env, "num_envs"):
        yield env
        return
    with env.inside.engine.single(index) as one:
        yield one


def _nominal(env: FMUEnv) -> dict[str, float]:
    """The nominal values of parameters that are drawn, by name."""
    parameters = env.config.model_parameters.items()
    return {name: _median(value) for name, value in parameters if is_distribution(value)}


def _pairs(states: Mapping[str, str] | str | None) -> dict[str, str]:
    if not isinstance(states, str):
        return dict(states or {})
    pairs = [part.split(":") for part in states.split(",")]
    if any(len(pair) != 2 for pair in pairs):
        raise ConfigError(f"states must be as in 'theta:theta_0,w:w_0', got {shown(states)}")
    return dict(pairs)


def _median(distribution: Any) -> float:
    rng = np.random.default_rng(0)
    return float(np.median([distribution.sample(rng) for _ in range(_SAMPLES)]))
