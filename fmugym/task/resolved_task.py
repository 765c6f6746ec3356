"""Resolution of a task: its declarations and a model description make a config and hooks."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import cached_property, partial, reduce
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from fmugym.environment.distributions import is_distribution
from fmugym.environment.episode import Quantities
from fmugym.environment.forecasts import Future
from fmugym.errors import shown
from fmugym.expressions.functions import minimum
from fmugym.expressions.graph import Computed, Formulas, Update, Value, where
from fmugym.expressions.language import Expression
from fmugym.expressions.numpy_evaluation import function_of, update_by
from fmugym.fmi.description import ModelDescription
from fmugym.task.declarations import Declarations
from fmugym.task.observations import (
    NoiseKey,
    Seen,
    has_errors,
    histories,
    normalized,
    observed_values,
    remembered,
    scaled,
)
from fmugym.task.scenarios import held_out_times
from fmugym.task.section_entries import Kpi, Term, kpi_name
from fmugym.task.sensors import NOISE
from fmugym.task.task_config import beginning_of, bounds_of, samplings_of, time_step_of, times_of
from fmugym.task.task_entries import Entry, steps_in
from fmugym.task.task_file import Task
from fmugym.task.task_names import Moment, Naming, switch_names
from fmugym.task.task_quantities import explanation, named_values
from fmugym.task.task_variables import TaskVariable, check_written, has_fmu_values
from fmugym.task.warm_up_controllers import DeclaredWarmUp

__all__ = ["ResolvedTask"]

_WORST: Final = "worst reward"
"""The episode variable with the lowest reward until now, or 0."""

_LONG_AGO: Final = 1e9
"""Steps since an action was switched, at the beginning of an episode."""

_Hook = Callable[..., Any]


class ResolvedTask:
    """Config, spaces and hooks of an environment, made of a declared task.

    Args:
        task: The task.
        root: The table of all its keys, with the mistakes that are known already.
        description: The model description of its FMU.
        needs_reward: Whether the task must say a reward; a class may have one of its own.

    Attributes:
        config: The config for ``FMUEnv``.
        formulas: Formulas of the task.
        hooks: Functions of the environment by the names of the hooks that they are, for spaces and
            for what is said of rewards.
        observation_names: The names of the elements of the observation.
        action_names: Names of the action's elements.
        action_masks: A function of the environment that tells which levels of the actions are not
            blocked, shape (levels,); None if an action has no levels.
        warm_up: Controllers of warm-ups; None if there is none, or inputs do not move in it.
        cost_limits: Limits of the costs of an episode, by name.
        unphysical_keys: The keys for which observations or actions are not in the task's units.
        expressions: All expressions of the task.

    Raises:
        ConfigError: If the task has mistakes, does not fit the FMU, or contradicts itself. The text
            tells all of that, and says where.
    """

    def __init__(
        self, task: Task, root: Entry, description: ModelDescription, needs_reward: bool = True
    ) -> None:
        self._task, self._root, time_step, warm_steps = task, root, math.nan, 0
        self._declared = declared = Declarations(root, description, task.is_physical)
        self._root = root = declared.root
        with root.child("reward").noting():
            if needs_reward and not declared.rewards:
                text = 'the task has no reward; say one, for example: reward = "1"'
                raise root.lack(text, "reward")
        with root.child("time_step").noting():
            time_step = time_step_of(root, description)
        with declared.warm_up.entry.noting():
            warm_steps = self._steps_of_warm_up(time_step)
        with root.noting():
            self._naming = Naming(declared, time_step, warm_steps)
            self._kept = histories(self._naming)
            self._seen, self._sensors = observed_values(self._naming, self._kept)
            for entry, make in self._makers():
                with entry.noting():
                    make()
        root.mistakes.require_none()
        with root.noting():
            self._make()
        root.mistakes.require_none()

    def _make(self) -> None:
        """Make the values of the attributes."""
        declared = self._declared
        self.config = self._make_config()
        self.formulas = self._make_formulas()
        self.hooks = self._hooks_of_spaces() | self._hooks_of_rewards()
        self.observation_names = tuple(seen.name + seen.place for seen in self._seen)
        self.action_names = tuple(variable.alias for variable in declared.actions)
        self.warm_up = self._make_warm_up() if self._naming.warm_steps else None
        self.action_masks = self._action_masks()
        self.unphysical_keys, self.expressions = declared.unphysical_keys, declared.expressions
        limits = {name: term.limit for name, term in declared.costs.items()}
        self.cost_limits = {name: limit for name, limit in limits.items() if limit is not None}

    @cached_property
    def future(self) -> Future:
        """Data and random numbers of later times, for hooks."""
        data = self._root.child("data").value or {}
        lookups = {name: one for name, one in self._naming.lookups.items() if name in data}
        keys = (NOISE,) if NOISE in self.config["episode_variables"] else ()
        clock = function_of(self._naming.clock)
        held_out = held_out_times((self._task.outside or self._task).root)
        return Future(lookups, keys, clock, tuple(held_out))

    def controllers(self) -> list[Any]:
        """Make the controllers that the task declares and that do not plan ahead."""
        from fmugym.control.controller_parsing import simple_controllers

        return [*simple_controllers(self._root.child("controllers").value or {})]

    def quantities(self) -> Quantities:
        """Everything in the task that has a name and a value, and a function that reads it."""
        found = named_values(self._naming)
        read = function_of(tuple(value for _, value in found.values()))
        return Quantities([quantity for quantity, _ in found.values()], read)

    def _makers(self) -> Iterator[tuple[Entry, Callable[[], Any]]]:
        """Functions that evaluate everything once, so that one error tells all mistakes."""
        declared = self._declared
        for entry, expression, moment in self._plain_expressions():
            yield entry, partial(self._naming.value, entry, expression, moment)
        for name in declared.inputs:
            yield declared.places_of_inputs[name], partial(self._input_value, name)
        for name, one in declared.derived.items():
            yield one.entry, partial(self._naming.value_of, name, Moment.JUDGED)
        for term in (*declared.rewards.values(), *declared.costs.values()):
            yield term.entry, partial(self._terms, {"": term})
        for name in declared.flags:
            yield self._root.child(name), partial(self._condition, name)
        for kpi in declared.kpis.values():
            yield kpi.entry, partial(self._kpi_value, kpi)
        yield self._root, partial(times_of, self._naming)
        yield self._root.child("clock"), partial(beginning_of, self._naming)
        for seen in self._seen:
            yield seen.entry, partial(self._in_form, seen)

    def _plain_expressions(self) -> Iterator[tuple[Entry, Expression, Moment]]:
        """Expressions without a form of their own, their places, and the moments of evaluation."""
        for memory in self._declared.memory.values():
            if memory.update is not None:
                yield memory.entry, memory.update, Moment.AFTER
        for name in self._declared.warm_up.measured():
            entry = self._declared.warm_up.entry.child("controller")
            yield entry, Expression.parse(name), Moment.SEEN

    # The warm-up.

    def _steps_of_warm_up(self, time_step: float) -> int:
        """The steps of a warm-up with moving inputs; 0 if there is none."""
        table = self._declared.warm_up
        moves = table.controllers or table.caches or self._declared.inputs
        return steps_in(table.entry, table.period, time_step) if moves and table.period else 0

    def _make_warm_up(self) -> DeclaredWarmUp:
        written: dict[str, Sequence[Value]] = {
            one.variable: (one.now, one.fill) for one in (*self._kept, *self._sensors)
        }
        written |= {name: [value] for name, value in self._switched().items()}
        return DeclaredWarmUp(
            self._naming,
            self._input_values(self._declared.warm_up.acting),
            update_by([*self._updates_of_histories(), self._switched()]),
            written,
            self.config,
        )

    # The config.

    def _make_config(self) -> dict[str, Any]:
        declared, variables = self._declared, self._declared.variables
        return {
            **(self._root.child("config").value or {}),
            "foreign": self._root.child("foreign").value or {},
            **times_of(self._naming),
            "model_input_names": variables.names_in_fmu(declared.written),
            "model_output_names": variables.names_in_fmu(self._naming.outputs),
            "monitor_names": variables.names_in_fmu(self._naming.monitors),
            "model_parameters": {
                variable.fmu_variable.name: value
                for variable, value in declared.parameters.values()
            },
            "episode_variables": self._variables(),
            "bounds": bounds_of(self._naming),
            "units": variables.units,
            "samplings": samplings_of(self._naming),
        }

    def _variables(self) -> dict[str, Any]:
        """All episode variables with their start values."""
        memory = {name: one.start for name, one in self._declared.memory.items()}
        kept = {one.variable: np.zeros(one.length) for one in (*self._kept, *self._sensors)}
        switches: dict[str, float] = {}
        for variable in self._switched_actions:
            starts = self._is_on_at_start(variable), _LONG_AGO
            switches |= zip(switch_names(variable), starts, strict=True)
        zeros = dict.fromkeys([*self._worst, *self._updated_kpis], 0.0)
        beginning = beginning_of(self._naming)  # behind the start time, with which it is drawn
        drawn = beginning | memory if self._declared.files else memory | beginning
        variables = drawn | kept | switches | zeros
        return variables | self._noise(variables)

    def _noise(self, variables: Mapping[str, Any]) -> dict[str, NoiseKey]:
        """The key of noise, which is drawn last."""
        devices = [variable.device for variable in self._declared.variables.declared()]
        is_noisy = any(one.is_random for one in devices) or has_errors(self._declared)
        if not is_noisy and not self._declared.steps:
            return {}
        parameters = [value for _, value in self._declared.parameters.values()]
        start = times_of(self._naming).get("start_time")
        draws = any(map(is_distribution, [*parameters, start, *variables.values()]))
        return {NOISE: NoiseKey(draws=not draws)}

    @property
    def _switched_actions(self) -> list[TaskVariable]:
        """The actions with a least time on or off."""
        return [variable for variable in self._declared.actions if variable.is_switched]

    def _is_on_at_start(self, variable: TaskVariable) -> float:
        own = variable.fmu_variable.start_number
        _, start = self._declared.parameters.get(variable.alias, (variable, own))
        if is_distribution(start):
            raise variable.entry.error(f"the start value of {variable.alias!r} must not be drawn")
        return float(start != 0)

    @cached_property
    def _has_worst(self) -> bool:
        """Whether failed steps cost as much as the worst one, and that is not known ahead."""
        own, rewards = self._root.child("config").child("fault_reward"), self._declared.rewards
        if own.value is not None or not rewards:
            return False
        values = self._terms(rewards)
        return any(values[n].constant is None or rewards[n].weight != 1.0 for n in rewards)

    # Spaces, and conversions of their values.

    def _hooks_of_spaces(self) -> dict[str, _Hook]:
        hooks: dict[str, _Hook] = {}
        actions, seen, formulas = self._action_space(), self._observation_space(), self.formulas
        if formulas.inputs is not None:
            hooks["_get_action_space"] = lambda env: actions
        if formulas.observation is not None:
            hooks["_get_observation_space"] = lambda env: seen
        return hooks

    def _action_space(self) -> spaces.Space[Any] | None:
        """Action space; None for the space of the inputs."""
        variables = self._declared.actions
        are_inputs = all(
            variable.in_fmu is not None and has_fmu_values(variable) for variable in variables
        )
        if are_inputs and not self._declared.inputs and not self._declared.rescales:
            return None
        if self._declared.is_physical or not self._declared.are_choices:
            return _box([self._declared.range_of(variable) for variable in variables])
        counts = [len(variable.levels) for variable in variables]
        return spaces.Discrete(counts[0]) if len(counts) == 1 else spaces.MultiDiscrete(counts)

    def _input_values(self, acting: Collection[str] | None = None) -> list[Value]:
        """The FMU's inputs, in their units.

        Args:
            acting: The aliases of the actions that are chosen, the others keep their values; None
                for all.
        """
        declared, values = self._declared, list[Value]()
        for variable in declared.actions:
            if variable.in_fmu is None:
                continue
            value = variable.conversion.inverse(self._naming.input(variable))
            is_kept = acting is not None and variable.alias not in acting
            values.append(self._naming.read("inputs", len(values)) if is_kept else value)
        for name, (variable, _) in declared.inputs.items():
            values.append(variable.conversion.inverse(self._input_value(name)))
        if not values:
            raise declared.agent_entry("actions").error(
                "the actions write no input of the FMU: use them in expressions under [inputs]"
            )
        return values

    def _input_value(self, name: str) -> Value:
        """The value of an input that an expression or data write, in the unit of the task."""
        variable, expression = self._declared.inputs[name]
        entry = self._declared.places_of_inputs[name]
        value = self._naming.value(entry, expression, Moment.BEFORE).number
        check_written(entry, variable, value, self._declared.memory)
        return value

    def _action_masks(self) -> _Hook | None:
        naming, values = self._naming, list[Value]()
        for variable in self._declared.actions if self._declared.are_choices else ():
            for level in map(naming.constant, variable.levels):
                is_switched = variable.is_switched
                values.append(
                    naming.blocked(variable, level) ^ True if is_switched else naming.constant(True)
                )
        if not values:
            return None
        masks = function_of(values)
        return lambda env: np.array(masks(env), dtype=np.bool_)

    def _observation_space(self) -> spaces.Space[Any] | None:
        """Observation space; None for the space of the outputs."""
        names, variables = [seen.name for seen in self._seen], self._declared.variables
        if (
            self._declared.normalization is None
            and names == self._naming.outputs
            and all(has_fmu_values(variables[name]) for name in names)
        ):
            return None
        return _box([seen.limits for seen in self._normalized])

    @cached_property
    def _normalized(self) -> list[Seen]:
        """Normalized observed values, in the form of the observations."""
        return [self._in_form(seen) for seen in self._seen]

    def _in_form(self, seen: Seen) -> Seen:
        match self._declared.normalization:
            case "limits":
                return scaled(seen)
            case "nominal":
                return normalized(seen, self._declared.nominal_of(seen.name))
        return seen

    # After a step.

    def _make_formulas(self) -> Formulas:
        declared = self._declared
        has_info = declared.costs or declared.has_reward_terms or declared.kpis
        updates: list[Update] = [
            self._updated_memory(),
            *self._updates_of_histories(),
            self._switched(),
            self._worst,
            self._updated_kpis,
        ]
        return Formulas(
            self._naming.graph,
            None if self._action_space() is None else self._input_values(),
            [update for update in updates if update],
            self._condition("terminated") if "terminated" in declared.flags else None,
            self._condition("truncated") if "truncated" in declared.flags else None,
            _sum(self._terms(declared.rewards)) if declared.rewards else None,
            None if self._observation_space() is None else [one.value for one in self._normalized],
            self._info() if has_info else {},
        )

    def _hooks_of_rewards(self) -> dict[str, _Hook]:
        rewards = self._declared.rewards
        if not rewards:
            return {}
        explain = explanation(rewards, self._terms(rewards), self._naming)
        return {"_explain": explain, "_fault_reward": self._fault_reward()}

    def _updates_of_histories(self) -> list[Update]:
        """Updates of histories and sensors; sensors come after the values that they measure."""
        return [remembered(self._naming, kept) for kept in (self._kept, self._sensors)]

    def _switched(self) -> dict[str, Value]:
        """Memory of actions with a least time on or off, by variable."""
        values: dict[str, Value] = {}
        for variable in self._switched_actions:
            values |= zip(switch_names(variable), self._naming.switched(variable), strict=True)
        return values

    @cached_property
    def _worst(self) -> dict[str, Value]:
        if not self._has_worst:
            return {}
        reward = _sum(self._terms(self._declared.rewards, Moment.UPDATED))
        return {_WORST: minimum(self._naming.read("variables", _WORST), reward)}

    @cached_property
    def _updated_kpis(self) -> dict[str, Value]:
        step_count, kpis = self._naming.step_count, self._declared.kpis.items()
        return {
            kpi_name(name): kpi.updated(self._kpi_value(kpi), step_count)
            for name, kpi in kpis
            if kpi.how is not None
        }

    def _kpi_value(self, kpi: Kpi) -> Value:
        """Value that a step adds to a figure."""
        moment = Moment.JUDGED if kpi.how is None else Moment.UPDATED
        names = self._term_values(moment) | (self._known_kpis() if kpi.how is None else {})
        return self._naming.value(kpi.entry, kpi.expression, moment, names).number

    def _known_kpis(self) -> dict[str, Value]:
        """The figures that are no expressions of others, by name."""
        kpis, step_count = self._declared.kpis, self._naming.step_count
        return {n: kpi.present(step_count) for n, kpi in kpis.items() if kpi.how is not None}

    def _kpi_values(self) -> dict[str, Value]:
        """The figures of the episode until now."""
        known = self._known_kpis()
        return {
            name: known[name] if name in known else self._kpi_value(kpi)
            for name, kpi in self._declared.kpis.items()
        }

    def _term_values(self, moment: Moment) -> dict[str, Value]:
        """Rewards and costs by their names, for the figures that use them."""
        declared = self._declared
        if not declared.kpis:
            return {}
        values: dict[str, Value] = {}
        for name, term in {**declared.rewards, **declared.costs}.items():
            with term.entry.noting():
                values |= self._terms({name: term}, moment) if name else {}
        return values

    def _updated_memory(self) -> dict[str, Value]:
        """New values of the memory; all are computed before one is written."""
        return {
            name: self._naming.value(memory.entry, memory.update, Moment.AFTER).number
            for name, memory in self._declared.memory.items()
            if memory.update is not None
        }

    def _fault_reward(self) -> _Hook:
        """A failed step gives the reward that the file says, or no more than any step before."""
        own = self._root.child("config").child("fault_reward")
        if own.value is not None:
            return lambda env: env.config.fault_reward
        if self._has_worst:
            return lambda env: env.variables[_WORST]
        reward = function_of(_sum(self._terms(self._declared.rewards)))
        return lambda env: min(0.0, reward(env))

    def _condition(self, name: str) -> Value:
        entry = self._root.child(name)
        moment = Moment.AFTER if name == "terminated" else Moment.JUDGED
        value = self._naming.value(entry, self._declared.flags[name], moment)
        if not value.is_flag:
            raise entry.error(
                f"expected a condition such as 'x > 1', got {shown(entry.value.text)}"
            )
        return value

    def _terms(self, terms: Mapping[str, Term], moment: Moment = Moment.JUDGED) -> dict[str, Value]:
        """Rewards or costs by name, weights included."""
        values = {}
        for name, term in terms.items():
            value = self._naming.value(term.entry, term.expression, moment).number
            values[name] = value if term.weight == 1.0 else term.weight * value
        return values

    def _info(self) -> dict[str, Computed]:
        """The info: terms of the reward, costs, and figures of the episode."""
        rewards, costs = self._terms(self._declared.rewards), self._terms(self._declared.costs)
        parts: dict[str, Computed] = {}
        if self._declared.has_reward_terms:
            parts["reward_terms"] = self._in_steps(rewards)
        if costs:
            parts |= self._in_steps({"cost": _sum(costs)})
            parts["costs"] = self._in_steps(costs)
        if self._declared.kpis:
            parts["kpis"] = self._in_steps(self._kpi_values())
        return parts

    def _in_steps(self, values: Mapping[str, Value]) -> dict[str, Value]:
        """Zeros before the first step, which has no rewards and costs yet."""
        has_stepped = self._naming.step_count > 0
        return {name: where(has_stepped, value, 0.0) for name, value in values.items()}


def _box(limits: list[tuple[float, float]]) -> spaces.Box:
    low, high = np.array(limits, dtype=np.float32).T
    return spaces.Box(low, high, dtype=np.float32)


def _sum(values: Mapping[str, Value]) -> Value:
    return reduce(operator.add, values.values())
