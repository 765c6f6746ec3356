"""Model predictive control: the first action of the best plan on copies of the FMU."""

from __future__ import annotations

import copy
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.checks import (
    LARGEST_COUNT,
    check_count,
    check_flag,
    check_integer,
    check_number,
    check_seed,
    duration,
)
from fmugym.control.controller import Controller, attribute_of
from fmugym.control.observer import COPIES, CORRECTION, Observer, parameters_of_copies
from fmugym.environment.env import FMUEnv
from fmugym.environment.forecasts import Future, future_of
from fmugym.environment.saved_episode import scope_of
from fmugym.environment.snapshots import Snapshot
from fmugym.environment.vector import FMUVectorEnv
from fmugym.environment.vector.rollouts import tables_of
from fmugym.environment.vector.tasks import VectorTask
from fmugym.errors import ConfigError, shown
from fmugym.pool.pool import FloatArray

__all__ = ["MPC"]

_DAY: Final = 86400.0
_PULSES: Final = 2
"""By so many pulses a candidate differs."""

_DECADES: Final = 1.5
"""Over so many powers of ten the heights of pulses are spread."""

_PENALTY: Final = 1e9
"""Weight of a unit of a cost beyond its limit, relative to a unit of the reward."""

_FAILURE: Final = 1e100
"""Penalty of each step that a plan lacks because a copy has failed."""

_SURROGATE: Final = "surrogate"
"""The name of a model that is fitted to the FMU."""

_FORECAST: Final = re.compile(r"(.+)\[\+(.+) s\]")


class MPC(Controller):
    """Model predictive control with copies of the FMU as the model.

    In each step, candidates for the actions until the horizon play on copies of the environment,
    and the first action of the best one is taken. The reward is that of the task, and plans that
    keep the limits of costs come first; those come last in which a fault cuts the episode short.
    The search begins with the best of the plan of the step before and what simple controllers would
    do. Candidates are the best plan until then and two pulses, whose heights and lengths are random
    numbers of all magnitudes. Most pulses begin early, since the next action cannot be mended
    later.

    The controller sees what an agent sees. Nine copies get the same actions as the environment.
    They differ in the parameters that the task draws, and the one whose observations fit best is
    the model. Copies read data as they were observed, and ahead as they were forecast last. Beyond
    a forecast, the value of a day before is repeated; data that are not observed have their mean in
    the training period. Differences between what is observed and what a copy gives, filtered,
    become offsets of the outputs; those of a value that a plant fails to tell stay. The controller
    is told the episode variables, such as the clock, but no noise.

    Args:
        horizon: How far plans go: seconds, or a text such as ``"24h"``.
        candidates: How many candidates play in a decision.
        rounds: How often the search goes on from the best one in a decision.
        warm: A controller whose actions are a candidate, too, bound to nothing else. By default
            those that the task file declares and that fit the actions; ranges in them have their
            middle.
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
        seed: Seed of the candidates. The same arguments give the same actions.
        model: A function that makes the environment to plan with, which has the observations and
            actions of the controlled one. By default that is copied; the environments of
            ``fmugym.deployment.plant`` know one. Or ``"surrogate"``: plans are tried on a surrogate
            of the FMU, for FMUs that are too slow for plans in real time; see
            ``fmugym.control.surrogate``.
        steps: How many steps of the FMU a surrogate is fitted to, when the controller is bound.
    """

    def __init__(
        self,
        horizon: Any,
        candidates: int = 256,
        rounds: int = 4,
        warm: Controller | None = None,
        correction: float = CORRECTION,
        budget: float | None = 1.0,
        states: Mapping[str, str] | str | None = None,
        perfect: bool = False,
        seed: int = 0,
        model: Callable[[], Any] | str | None = None,
        steps: int = 2000,
    ) -> None:
        self.horizon = check_number("horizon", duration("horizon", horizon), positive=True)
        self.rounds = check_integer("rounds", rounds, 1, LARGEST_COUNT)
        self.candidates = check_integer("candidates", candidates, self.rounds, LARGEST_COUNT)
        self.warm = warm
        self.correction = check_number("correction", correction, 0.0, 1.0)
        self.budget = None if budget is None else check_number("budget", budget, positive=True)
        self.perfect = check_flag("perfect", perfect)
        self.states = _pairs(states)
        self.seed = check_seed(seed) or 0
        if model not in (None, _SURROGATE) and not callable(model):
            raise ConfigError(f"model must be a function or {_SURROGATE!r}, got {shown(model)}")
        if model == _SURROGATE and self.perfect:
            raise ConfigError("a perfect MPC knows the FMU itself: leave out 'model' or 'perfect'")
        self.model = model
        self.steps = check_count("steps", steps)
        self._surrogate: Any = None
        self._copies: Any = None
        """The copies; the first nine run beside an environment, and all try plans."""

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
        if self._copies is not None:
            self._copies.close()
            self._copies = None

    def _prepare(self) -> None:
        self.close()
        self._low, self._high = self._sides()
        steps = round(self.horizon / self.time_step)
        if steps < 1:
            raise ConfigError(
                f"the horizon of {self.horizon:g} s is shorter than the step of "
                f"{self.time_step:g} s"
            )
        self._plan_shape = steps, self._low.size
        make = self._model_of()
        self._many = max(COPIES, self.candidates // self.rounds)
        backend = self._fitted(make) if self.model == _SURROGATE else "auto"
        self._copies = FMUVectorEnv(
            partial(_that_goes_on, make), self._many, autoreset_mode="Disabled", backend=backend
        )
        self._prototype = self._copies.prototype
        future = future_of(self._prototype) or Future({}, (), float)
        for name in self.states:
            self._check_name("states", name)
        self._places = list(map(self._place_of, self.states))
        self._require_fit(future)
        self._foresight = _Foresight(self.names, future, self.time_step, steps)
        self._warm = self._bound_warm()
        self._slopes: Any = None

    def _sides(self) -> list[FloatArray]:
        """The lowest and the highest numbers of an action."""
        space: Any = self.space
        limits = (space.low, space.high) if isinstance(space, spaces.Box) else self._limits()
        sides = [np.ravel(one).astype(np.float64) for one in limits]
        if not np.isfinite(sides).all():
            raise ConfigError("MPC needs actions with limits: give their variables 'min' and 'max'")
        return sides

    def _fitted(self, make: Callable[[], Any]) -> Any:
        """A surrogate of the FMU. One that was fitted to the same FMU and config is kept."""
        from fmugym.training.search.excitation import (
            fitted_surrogate,  # which needs controllers itself
        )

        env: FMUEnv = attribute_of(self._env, "unwrapped")
        scope = scope_of(env)
        if self._surrogate is None or self._surrogate[0] != scope:
            found, _ = fitted_surrogate(make, self.steps, self.seed)
            env.logger.info(
                "%s plans on a surrogate of %d steps: %s; errors of simulations are %.2g %% of the "
                "variation of outputs",
                type(self).__name__,
                self.steps,
                found.terms.form,
                100 * found.error,
            )
            self._surrogate = scope, found
        return self._surrogate[1]

    def _model_of(self) -> Callable[[], Any]:
        """Maker of the copies of the model."""
        if callable(self.model):
            return self.model
        env: FMUEnv = attribute_of(self._env, "unwrapped")
        if env.planning_model is not None:
            return env.planning_model
        if env.pool.save_method is None:
            raise ConfigError(
                "MPC needs an FMU that it can copy, but a backend stands in for this one: give "
                "'model', a function that makes the environment to plan with"
            )
        return partial(copy.copy, env)

    def _require_fit(self, future: Future) -> None:
        """Refuse a model of another task, a horizon beyond the data, and states beside data."""
        copied = self._copies
        names = attribute_of(copied, "observation_names") or self.names
        space = copied.single_action_space
        if (names, space) != (self.names, self.space):
            raise ConfigError(
                f"the model observes {', '.join(names)} and takes actions of {space}, expected "
                f"{', '.join(self.names)} and {self.space}"
            )
        for name, lookup in future.lookups.items():
            if self.horizon > lookup.period:
                raise ConfigError(
                    f"the horizon of {self.horizon:g} s is longer than the data {name!r}, which "
                    f"repeat after {lookup.period:g} s; take horizon={lookup.period:g} or less"
                )
        if self.states and future.lookups:
            raise ConfigError(
                "MPC takes 'states' for tasks without data only, but there is "
                f"{min(future.lookups)!r}"
            )

    def _bound_warm(self) -> list[Controller]:
        """The simple controllers, bound to the copies."""
        if self.warm is not None:
            return [self.warm.bind(self._copies, self.names)]
        resolved = self._prototype.resolved
        declared = list if resolved is None else resolved.controllers
        return [one for one in declared() if self._fits(one)]

    def _fits(self, controller: Controller) -> bool:
        """Bind a declared controller; tell whether it fits, unlike one for a single action."""
        try:
            controller.bind(self._copies, self.names)
        except ConfigError as error:
            self._prototype.logger.info("no plan begins with a controller of the task: %s", error)
            return False
        return True

    def _forget(self, mask: npt.NDArray[np.bool_]) -> None:
        if mask.all():
            self._episodes: list[_Episode | None] = [None] * self.count
        for index in np.flatnonzero(mask).tolist():
            self._episodes[index] = None

    def _decide(self, rows: FloatArray) -> FloatArray:
        return np.array([self._decide_one(index, row) for index, row in enumerate(rows)])

    def _decide_one(self, index: int, row: FloatArray) -> FloatArray:
        begin = perf_counter()
        single = self._env.episodes.single(index) if self._is_vector else nullcontext(self._env)
        with single as env:
            future = future_of(env)
            now = 0.0 if future is None else float(future.clock(env))
            known = self._episodes[index]
            episode = self._episodes[index] = known or self._begun(env)
            episode.is_measured = self._measured(env)
            if known is not None:
                self._follow(episode, env.action, row, now)
        self._foresight.note(episode.told, row, episode.steps)
        start, data, assumed = self._start_of(index, episode, row, now)
        with self._assuming(data):
            best = self._search(episode, start, assumed, row)
        episode.row, episode.steps, episode.plan = row, episode.steps + 1, best.numbers
        for name, paid in best.costs.items():
            episode.costs[name] = episode.costs.get(name, 0.0) + paid
        self._require_time(start, perf_counter() - begin)
        return np.asarray(self._actions(episode.plan[np.newaxis])[0, 0], np.float64)

    def _assuming(self, data: Mapping[str, Any]) -> AbstractContextManager[None]:
        """Let the copies read other data of the task inside of a ``with`` block."""
        task: VectorTask = self._copies.task
        return task.assuming(tables_of(self._prototype, data), None)

    def _require_time(self, start: Snapshot, took: float) -> None:
        if start.method == "replay" and self.budget is not None and took > self.budget:
            raise ConfigError(
                f"a decision took {took:.3g} s of at most {self.budget:g} s: the FMU cannot save "
                "its state, so that each candidate plays the episode again. Take fewer candidates, "
                "or a larger budget"
            )

    # The copies that run beside the environment.

    def _begun(self, env: FMUEnv) -> _Episode:
        """Begin an episode of the copies; the first one has the nominal parameters."""
        copied, episode = self._copies, _Episode()
        values = parameters_of_copies(self._prototype, self.seed)
        if self._prototype.config.draws_start_time:
            values["start_time"] = np.full(COPIES, env.time - env.step_count * self.time_step)
        for place in range(COPIES if values else 1):
            mask = np.arange(self._many) == place if place else np.ones(self._many, np.bool_)
            options: dict[str, Any] = {"reset_mask": mask}
            given = {name: float(each[place]) for name, each in values.items()}
            options |= {"model_parameters": given} if given else {}
            observations, _ = copied.reset(seed=self.seed, options=options)
        future = future_of(env)
        keys = () if future is None else future.keys
        known = self._prototype.variables.keys() - keys
        copied.episodes.show(
            {n: float(v) for n, v in env.variables.items() if np.ndim(v) == 0 and n in known}, {}
        )
        episode.seen = np.asarray(observations, np.float64)
        episode.snapshot = copied.save_state()
        episode.plan = np.full(self._plan_shape, 0.5)
        episode.rng = np.random.default_rng(self.seed)
        episode.warm = copy.deepcopy(self._warm)
        if self._slopes is None:
            self._slopes = self._find_slopes(episode.snapshot[0])
        measured, outputs = self._slopes.shape
        episode.observer = Observer(self._many, measured, outputs, self.correction)
        return episode

    def _measured(self, env: FMUEnv) -> npt.NDArray[np.bool_]:
        """Mask of the observed elements that were measured now, and do not hold or lie ahead."""
        is_held = np.isin([*self._prototype.out], [*env.held_outputs()])
        return np.asarray(self._foresight.is_present & ~self._slopes[:, is_held].any(axis=1))

    def _follow(self, episode: _Episode, action: Any, row: FloatArray, now: float) -> None:
        """Step the copies as the environment was stepped, and correct them by the observation."""
        if episode.have_ended:
            return
        copied = self._copies
        data = self._foresight.observed(episode.row, row, now)
        with self._assuming(data):
            copied.restore_state(episode.snapshot)
            actions = np.repeat(np.asarray(action)[np.newaxis], self._many, axis=0)
            observations, _, terminated, truncated, _ = copied.step(actions)
            goes_on = np.flatnonzero(~(terminated | truncated))
            episode.have_ended = not len(goes_on)
            if episode.have_ended:
                return
            sources = np.where(terminated | truncated, goes_on[0], np.arange(self._many))
            saved = copied.save_state(goes_on)  # those that have failed cannot be saved
            episode.snapshot = saved[np.searchsorted(goes_on, sources)]
            if len(goes_on) < self._many:
                copied.restore_state(episode.snapshot)
        episode.seen = np.asarray(observations, np.float64)[sources]
        off = (row - episode.seen) * episode.is_measured
        episode.observer.follow(off, sources)

    def _find_slopes(self, snapshot: Snapshot) -> FloatArray:
        """Slopes of present observed values by the outputs, shape (k, o)."""
        copied = self._copies
        action = self._actions(np.full((1, *self._plan_shape), 0.5))
        seen = partial(copied.rollout, snapshot, action[:, :1])
        plain = seen().observations[0, 0].astype(np.float64)
        columns = []
        for name in copied.prototype.out:
            change = seen(offsets={name: 1.0}).observations[0, 0] - plain
            columns.append(np.where(self._foresight.is_present, change, 0.0))
        slopes = np.array(columns).T
        return np.where(np.abs(slopes) < 1e-4, 0.0, slopes)

    def _start_of(
        self, index: int, episode: _Episode, row: FloatArray, now: float
    ) -> tuple[Snapshot, dict[str, Any], dict[str, Any]]:
        """States from which candidates begin, the data that they assume, and arguments."""
        if self.perfect:
            return self._env.save_state(*([[index]] if self._is_vector else [])), {}, {}
        if self.states:
            return self._moved(episode, row), {}, {"seed": self.seed}
        slopes = self._slopes * episode.is_measured[:, np.newaxis]
        wanted = (row - episode.seen) @ np.linalg.pinv(slopes, rcond=1e-6).T
        episode.observer.correct(wanted, slopes.any(axis=0))
        best = episode.observer.best
        offsets = episode.observer.offsets[best].tolist()
        names = list(self._prototype.out)
        assumed = {"offsets": dict(zip(names, offsets, strict=True)), "seed": self.seed}
        data = self._foresight.ahead(episode.told, episode.steps, now)
        return episode.snapshot[best], data, assumed

    def _moved(self, episode: _Episode, row: FloatArray) -> Snapshot:
        """Let the copies go on in the state that was observed."""
        expected = episode.seen[:, self._places].mean(axis=0)  # their sensors are noisy, too
        part = self.correction * episode.is_measured[self._places]
        values = expected + part * (row[self._places] - expected)
        values = row[self._places] if not episode.steps else values
        starts = dict(zip(self.states.values(), values.tolist(), strict=True))
        nominal = {
            n: float(v[0]) for n, v in parameters_of_copies(self._prototype, self.seed).items()
        }
        copied = self._copies
        seed = self.seed + episode.steps
        copied.reset(seed=seed, options={"model_parameters": nominal | starts})
        episode.snapshot, episode.have_ended = copied.save_state(), False
        return episode.snapshot[0]

    # The search for a plan.

    def _actions(self, plans: FloatArray) -> Any:
        """The actions of plans of shape (n, steps, m), shape (n, steps, ...)."""
        values = self._low + plans * (self._high - self._low)
        actions = self._as_actions(values.reshape(-1, self._low.size))
        return actions.reshape(*plans.shape[:2], *actions.shape[1:])

    def _search(
        self, episode: _Episode, start: Snapshot, assumed: Mapping[str, Any], row: FloatArray
    ) -> _Plan:
        """The best plan of all that play."""
        play = partial(self._best_of, start, assumed, self._allowed(episode))
        plans = self._first_plans(episode, start, assumed, row)
        changes = self._changes(episode.rng, self._many - len(plans))
        best = play(np.concatenate([plans, np.clip(plans[0] + changes, 0.0, 1.0)]))
        for _ in range(self.rounds - 1):
            changed = best.numbers + self._changes(episode.rng, self._many)
            found = play(np.clip(changed, 0.0, 1.0))
            best = found if found.value > best.value else best
        return best

    def _changes(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Pulses of single numbers of the action, shape (n, steps, m)."""
        steps, width = self._plan_shape
        changes = np.zeros((count, steps, width))
        for _ in range(_PULSES):
            lengths = np.exp(rng.uniform(0.0, np.log(max(2.0, steps / 2)), count)).astype(int)
            begins = (steps + lengths - 1) * rng.uniform(size=count) ** 2
            since = np.arange(steps)[:, np.newaxis] - np.floor(begins) + lengths - 1
            heights = rng.uniform(-1.0, 1.0, count) * 10.0 ** -rng.uniform(0.0, _DECADES, count)
            pulses = heights * ((since >= 0) & (since < lengths))
            changes[np.arange(count), :, rng.integers(width, size=count)] += pulses.T
        return changes

    def _best_of(
        self,
        start: Snapshot,
        assumed: Mapping[str, Any],
        limits: Mapping[str, float],
        plans: FloatArray,
    ) -> _Plan:
        """The best of some plans; whatever goes beyond the limit of a cost counts far more.

        Plans in which a copy fails come last. What they have not paid for until their horizon would
        make them look good.
        """
        found = self._copies.rollout(start, self._actions(plans), **assumed)
        values: FloatArray = found.rewards.sum(axis=1)
        for name, limit in limits.items():
            if name in found.costs:
                excess = np.maximum(found.costs[name].sum(axis=1) - limit, 0.0)
                values = values - _PENALTY * excess
        is_cut = found.has_failed & found.truncated.any(axis=1)
        lacks = self._plan_shape[0] + 1 - found.lengths
        values = np.where(is_cut, -_FAILURE * lacks, values)
        place = int(values.argmax())
        costs = {name: float(paid[place, 0]) for name, paid in found.costs.items()}
        return _Plan(float(values[place]), plans[place], costs)

    def _allowed(self, episode: _Episode) -> dict[str, float]:
        """Limits of costs until the horizon, from the rest that the episode has left."""
        steps, limit = self._plan_shape[0], self._prototype.step_limit
        left = steps if limit == sys.maxsize else max(1, limit - episode.steps)
        return {
            name: max(0.0, most - episode.costs.get(name, 0.0)) * min(1.0, steps / left)
            for name, most in getattr(self._prototype, "cost_limits", {}).items()
        }

    def _first_plans(
        self, episode: _Episode, start: Snapshot, assumed: Mapping[str, Any], row: FloatArray
    ) -> FloatArray:
        """Plan of the step before, and plans of the simple controllers."""
        shifted = np.append(episode.plan[1:], episode.plan[-1:], axis=0)
        if not episode.warm:
            return shifted[np.newaxis]
        ahead, actions = copy.deepcopy(episode.warm), list[Any]()
        for controller in episode.warm:
            controller.act(np.tile(row, (self._many, 1)))

        def policy(observations: Any) -> Any:
            chosen = np.array([one.act(observations) for one in ahead])
            turn = np.arange(self._many) % len(ahead)
            actions.append(chosen[turn, np.arange(self._many)])
            return actions[-1]

        steps = self._plan_shape[0]
        self._copies.rollout(start, policy, horizon=steps, **assumed)
        actions += [actions[-1]] * (steps - len(actions))  # nobody asks when all have ended
        chosen = np.array(actions, np.float64).reshape(steps, self._many, -1)
        plans = (chosen - self._low) / (self._high - self._low)
        return np.concatenate([shifted[np.newaxis], plans.swapaxes(0, 1)[: len(ahead)]])


class _Plan(NamedTuple):
    """A plan that has played.

    Attributes:
        value: The return.
        numbers: The actions until the horizon, from 0 to 1, shape (steps, m).
        costs: Costs of the first step by name.
    """

    value: float
    numbers: FloatArray
    costs: Mapping[str, float]


class _Episode:
    """Knowledge about the episode of one environment.

    Attributes:
        snapshot: State of the copies.
        seen: Observations, shape (n, k).
        observer: Knows which copy fits best, and what is added to the outputs of each.
        have_ended: Whether their episodes have ended; the last snapshot stays.
        plan: The latest plan, from 0 to 1, shape (steps, m).
        row: The latest observation.
        is_measured: Which elements of it were measured then, shape (k,).
        steps: How many there were before.
        told: The latest forecast of data for each step, by name.
        rng: Draws candidates.
        costs: What the costs of past steps add up to, by name, as the plans have foreseen them.
        warm: The simple controllers, as if they had seen the same.
    """

    snapshot: Snapshot
    seen: FloatArray
    observer: Observer
    plan: FloatArray
    row: FloatArray
    is_measured: npt.NDArray[np.bool_]
    warm: list[Controller]
    rng: np.random.Generator

    def __init__(self) -> None:
        self.told: dict[str, dict[int, float]] = {}
        self.costs: dict[str, float] = {}
        self.have_ended = False
        self.steps = 0


class _Foresight:
    """Forecasts of data, made of observations.

    Args:
        names: Names of the observation's elements.
        future: Has the data.
        time_step: The length of a step in s.
        steps: Steps until the horizon.

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
        self._known: dict[str, list[tuple[int, int]]] = {name: [] for name in future.lookups}
        self._means = {n: one.mean(future.held_out) for n, one in future.lookups.items()}
        for place, name in enumerate(names):
            match = _FORECAST.fullmatch(name)
            of, ahead = (match[1], float(match[2])) if match else (name, 0.0)
            if of in self._known:
                self._known[of].append((round(ahead / time_step), place))
                self._known[of].sort()

    def note(self, told: dict[str, dict[int, float]], row: FloatArray, step: int) -> None:
        """Keep observed and forecast data.

        Args:
            told: The latest value of each step by name.
            row: The observation.
            step: Its number.
        """
        for name, known in self._known.items():
            values = told.setdefault(name, {})
            values |= {step + ahead: float(row[place]) for ahead, place in known}

    def ahead(
        self, told: Mapping[str, Mapping[int, float]], step: int, now: float
    ) -> dict[str, Any]:
        """Times and values from now on, by name.

        Args:
            told: The latest value of each step by name.
            step: The number of the present one.
            now: The time of the data.
        """
        return {name: self._course(name, told[name], step, now) for name in self._lookups}

    def _course(
        self, name: str, told: Mapping[int, float], step: int, now: float
    ) -> tuple[Any, Any]:
        lookup, known = self._lookups[name], self._known[name]
        if not known:
            return [now], [self._means[name]]
        count = min(self._steps + 2, int(np.ceil(lookup.period / self._time_step)))
        aheads, places = np.array([ahead for ahead, _ in known]), np.arange(count)
        values = np.array([told[step + ahead] for ahead in aheads.tolist()])
        if lookup.is_stepped:
            course = values[np.maximum(np.searchsorted(aheads, places, side="right") - 1, 0)]
        else:
            course = np.interp(places, aheads, values)
        day = round(_DAY / self._time_step)
        for place in range(count):
            if step + place in told:
                course[place] = told[step + place]
            elif place > aheads[-1]:
                before = course[place - day] if place >= day else course[place]
                course[place] = told.get(step + place - day, before)
        return now + places * self._time_step, course

    def observed(self, before: FloatArray, row: FloatArray, now: float) -> dict[str, Any]:
        """Times and values of the step that has just ended, by name."""
        found = {}
        for name in self._lookups:
            places = [place for ahead, place in self._known[name] if ahead == 0]
            values = np.array([before, row])[:, places[0]] if places else [self._means[name]] * 2
            found[name] = [now - self._time_step, now], values
        return found


def _that_goes_on(make: Callable[[], Any]) -> Any:
    """An environment in which faults end episodes, but no decision."""
    env = make()
    if env.config.on_fault == "raise":
        env.config = replace(env.config, on_fault="truncate")
    return env


def _pairs(states: Mapping[str, str] | str | None) -> dict[str, str]:
    if not isinstance(states, str):
        return dict(states or {})
    pairs = [part.split(":") for part in states.split(",")]
    if any(len(pair) != 2 for pair in pairs):
        raise ConfigError(f"states must be as in 'theta:theta_0,w:w_0', got {shown(states)}")
    return dict(pairs)
