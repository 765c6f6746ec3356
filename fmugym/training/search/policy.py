"""Policies that a search finds: controllers, corrected by a network.

The network reads observations of any numeric space as rows of numbers; the spaces of actions tell
how many numbers choose an action.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.checks import (
    LARGEST_COUNT,
    check_flag,
    check_integer,
    check_mapping,
    check_text,
    require_regular,
)
from fmugym.control.candidate_evaluation import CandidateEvaluator, CandidateScores
from fmugym.control.controller import Controller, attribute_of, either, limited
from fmugym.control.controller_parsing import controller_of, has_range, search_of
from fmugym.control.tuning import numbers_at
from fmugym.errors import ConfigError, reading_file, shown
from fmugym.expressions.graph import Value
from fmugym.files import write_whole
from fmugym.pool.pool import FloatArray

__all__ = [
    "LIMIT",
    "POLICY_FILE",
    "ResidualAgent",
    "ResidualPolicy",
    "choices_of",
    "flattened_observations",
    "require_numbers",
    "require_task",
    "scale_of",
]


def flattened_observations(space: spaces.Space[Any], observations: Any, count: int) -> FloatArray:
    """Flatten N observations as ``gymnasium.spaces.flatten`` does each: shape (N, k).

    Args:
        space: The space of one observation.
        observations: A batch of N, or one observation if N is 1.
        count: N.
    """
    columns = []
    for part, values in _parts(space, observations):
        rows = np.asarray(values, np.float64).reshape(count, -1)
        if isinstance(part, spaces.Discrete | spaces.MultiDiscrete):
            pairs = zip(rows.T, choices_of(part), strict=True)
            columns += [1.0 * (row[:, None] == np.array(choice)) for row, choice in pairs]
        else:
            columns.append(rows)
    return np.concatenate(columns, axis=1)


def _parts(space: Any, values: Any = None) -> Iterator[tuple[Any, Any]]:
    """The spaces within Dicts and Tuples, each with its part of a batch."""
    if not isinstance(space, spaces.Dict | spaces.Tuple):
        yield space, values
        return
    for key, part in space.items() if isinstance(space, spaces.Dict) else enumerate(space):
        yield from _parts(part, None if values is None else values[key])


def choices_of(space: Any) -> list[range]:
    """The elements to choose from, for each part of an action; empty if actions are numbers."""
    if isinstance(space, spaces.Box):
        return []
    if isinstance(space, spaces.MultiBinary):
        return [range(2)] * int(np.prod(space.shape))
    counts = space.n if isinstance(space, spaces.Discrete) else space.nvec
    return [range(int(start), int(start + n)) for start, n in np.broadcast(space.start, counts)]


def require_numbers(observed: spaces.Space[Any], acting: spaces.Space[Any]) -> None:
    """Refuse spaces for which no policy can be searched.

    Raises:
        ConfigError: For images, texts and the like, and for actions without limits; the text has
            the cure.
    """
    kinds = spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary
    for part, _ in _parts(observed):
        if not isinstance(part, kinds) or len(part.shape or ()) > 1:
            raise ConfigError(
                f"a search needs numbers to observe, and {part} has none: give numbers by a hook, "
                "or train with --algorithm PPO"
            )
    if not isinstance(acting, kinds):
        raise ConfigError(f"a search needs a Box or Discrete of actions, got {acting}: flatten it")
    if isinstance(acting, spaces.Box) and not acting.is_bounded():
        raise ConfigError(
            f"a search needs actions with limits, got {acting}: give 'bounds' in the config, or "
            "'min' and 'max' in the task file"
        )


POLICY_FILE: Final = "policy.json"
"""The file of an agent in its folder."""

LIMIT: Final = 5.0
"""The largest magnitude of a scaled feature."""

_FADE: Final = 0.05
"""The part of the way that the leaky integral of an observation follows it in a step."""

_CONSTANT: Final = 1e-8
"""A feature whose deviation is smaller than this, beside its mean, counts as constant."""

PolicyState = tuple[FloatArray, ...]
"""Memory of a policy: the last observation, its leaky integral, and the last action."""


def scale_of(moments: FloatArray) -> FloatArray:
    """Mean and scale of features.

    Args:
        moments: The sums of what ``ResidualPolicy.moments`` gives in each step.

    Returns:
        The mean of each feature, and its standard deviation, shape (2, f); constant ones are not
        made larger.
    """
    mean, squares = np.split(moments[1:] / moments[0], 2)
    deviation = np.sqrt(np.maximum(squares - mean**2, 0.0))
    is_constant = deviation <= _CONSTANT * (1.0 + np.abs(mean))
    return np.stack([mean, np.where(is_constant, np.maximum(np.abs(mean), 1.0), deviation)])


def _text(what: str, value: Any) -> str | None:
    if value is None:
        return None
    text = check_text(what, value)
    if has_range(text):
        search_of(text)
    else:
        controller_of(text)
    return text


def _numbers(what: str, value: Any) -> FloatArray:
    with suppress(ValueError, OverflowError):  # lists of different lengths, numbers too large
        array = np.array(value)
        if not array.size or array.dtype.kind in "iuf":
            return array.astype(np.float64)
    raise ConfigError(f"{what} must be numbers, got {shown(value)}")


def _names(what: str, value: Any) -> tuple[str, ...]:
    if not isinstance(value, list):
        raise ConfigError(f"{what} must be a list of names, got {shown(value)}")
    return tuple(check_text(f"each of the {what}", one) for one in value)


_width: Final = partial(check_integer, minimum=0, maximum=LARGEST_COUNT)

_CHECKS: Final[dict[str, Callable[[str, Any], Any]]] = {
    "name": check_text,
    "text": _text,
    "observed": _width,
    "acting": _width,
    "hidden": _width,
    "history": check_flag,
    "weights": _numbers,
    "scale": _numbers,
    "names": _names,
    "actions": check_text,
}
"""Checks of the entries in the file of an agent."""


@dataclass(frozen=True)
class ResidualAgent:
    """A controller, and a network that corrects it.

    Until they are found, the text has ranges in the places of numbers, or the weights are missing.

    Attributes:
        name: Name of the agent.
        text: The controller, as ``controller_of`` or ``search_of`` reads it; None for the middle of
            the range.
        observed: The number of observations that the network sees; 0 for one that gives constants.
        acting: The number of its outputs; 0 for no network.
        hidden: The width of its hidden layer, which ends in a tanh; 0 for none.
        history: Whether it also sees the last change of each observation, its leaky integral, and
            the last action.
        weights: Weights of the network, shape (n,), or (N, n) with those of each environment.
        scale: Mean and divisor of each feature, shape (2, f).
        names: Names of its observations; empty if that is not known yet.
        actions: The action space, in words.
    """

    name: str
    text: str | None = None
    observed: int = 0
    acting: int = 0
    hidden: int = 0
    history: bool = False
    weights: Any = ()
    scale: Any = ((0.0,), (1.0,))
    names: Sequence[str] = ()
    actions: str = ""

    def __call__(self, rows: FloatArray) -> ResidualPolicy:
        """The policy with the found numbers, shape (n,) or (N, n), for N environments.

        Binding it raises ``ConfigError`` if the agent is for another task.
        """
        if has_range(self.text):
            tunable = search_of(self.text)
            return ResidualPolicy(tunable.make(**numbers_at(tunable.ranges, rows)))
        baseline = None if self.text is None else controller_of(self.text)
        return ResidualPolicy(baseline, replace(self, weights=rows))

    def with_numbers(self, found: FloatArray) -> ResidualAgent:
        """The agent with the found numbers, shape (n,)."""
        if has_range(self.text):
            tunable = search_of(self.text)
            return ResidualAgent(
                f"tuned {self.name}", tunable.text(numbers_at(tunable.ranges, found))
            )
        return replace(self, weights=found)

    def policy(self) -> ResidualPolicy:
        """The controller, to be bound to an environment, as by a call."""
        return self(self.weights)

    def play(self, evaluator: CandidateEvaluator, seeds: Sequence[int]) -> CandidateScores:
        """Let the agent play alone."""
        return evaluator.play(self, np.atleast_2d(self.weights), seeds)

    def save(self, folder: Path) -> None:
        """Write the agent to a folder; a file that is there is replaced."""
        write_whole(folder / POLICY_FILE, self.content())

    def content(self) -> bytes:
        """The content of its file."""
        return json.dumps(asdict(self), default=np.ndarray.tolist).encode()

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read the agent in a folder.

        Raises:
            ConfigError: If the file is missing or damaged.
        """
        failure = f"the agent in {shown(str(folder))} cannot be read"
        try:
            with reading_file(failure):
                require_regular(folder / POLICY_FILE)
                text = (folder / POLICY_FILE).read_text(encoding="utf-8")
                return cls._checked(check_mapping(POLICY_FILE, json.loads(text)))
        except ConfigError as error:
            raise ConfigError(f"{failure}: {str(error).removeprefix(f'{failure}: ')}") from error

    @classmethod
    def _checked(cls, facts: dict[str, Any]) -> Self:
        checked = {name: check(name, facts[name]) for name, check in _CHECKS.items()}
        agent = cls(**facts | checked)
        shapes = (agent.size,), (2, agent.features or 1)
        is_finite = np.isfinite(np.append(agent.weights, agent.scale)).all()
        if not is_finite or (agent.weights.shape, agent.scale.shape) != shapes:
            raise ConfigError(f"expected finite numbers of the shapes {shapes}")
        if not (agent.scale[1] > 0).all():
            raise ConfigError(
                f"the divisors in scale must be positive, got {shown(agent.scale[1])}"
            )
        return agent

    @property
    def is_found(self) -> bool:
        """Whether nothing is missing."""
        return not has_range(self.text) and len(self.weights) == self.size

    # Its network.

    @property
    def features(self) -> int:
        """Number of inputs of the network."""
        return 3 * self.observed + self.acting if self.history else self.observed

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """The inputs, the constant one included, and the outputs of each layer."""
        widths = [self.features, *filter(None, [self.hidden]), self.acting]
        return [(before + 1, after) for before, after in itertools.pairwise(widths)]

    @property
    def size(self) -> int:
        """The number of weights."""
        return sum(before * after for before, after in self.shapes)

    def extended(self, weights: FloatArray) -> FloatArray:
        """Weights of the same decisions as N linear policies of the first features.

        This one is linear, too.

        Args:
            weights: Shape (N, n), where n is the number of outputs if they give constants.
        """
        given = weights.reshape(len(weights), -1, self.acting)
        count, inputs = given.shape[1], self.shapes[0][0]
        found = np.insert(given, [count - 1] * (inputs - count), 0.0, axis=1)
        return found.reshape(len(given), -1) * math.sqrt(inputs / count)

    def layers(self, weights: FloatArray) -> list[FloatArray]:
        """The layers of N networks, each of shape (N, inputs + 1, outputs); the bias comes last.

        Args:
            weights: Shape (N, size). Those of a layer count in units of 1/sqrt(inputs), so that one
                step length suits all.
        """
        ends = np.cumsum([before * after for before, after in self.shapes])
        pairs = zip(np.split(weights, ends[:-1], axis=1), self.shapes, strict=True)
        return [part.reshape(-1, *shape) / math.sqrt(shape[0]) for part, shape in pairs]


def _change(now: Any, last: Any) -> Any:
    """The change of an observation since the last step; 0 in the first one, whose last is NaN."""
    return either(last != last, 0.0, now - last)


def _faded(now: Any, last: Any, leaky: Any) -> Any:
    """The leaky integral of an observation, which begins with the first one."""
    return either(last != last, now, leaky + _FADE * (now - leaky))


_NO_NETWORK: Final = ResidualAgent("")


class ResidualPolicy(Controller):
    """A controller whose action a network corrects.

    In a ``Box``, the action is that of the controller plus the network's output times half of the
    range. In a ``Discrete`` or ``MultiDiscrete`` space, the largest output of each part chooses;
    the method ``action_masks`` of the environment, if there is one, limits the choice. Without
    weights, the action is the controller's own.

    Args:
        baseline: The controller; None for the middle of the range.
        agent: Tells the network, and what the policy is for.
    """

    masks: Callable[[], Any] | None

    def __init__(self, baseline: Controller | None, agent: ResidualAgent = _NO_NETWORK) -> None:
        self.baseline, self.agent = baseline, agent

    def bind(self, env: Any, names: Iterable[str] | None = None) -> Self:
        """See ``Controller.bind``; observations may be of any numeric space."""
        is_vector = hasattr(env, "single_observation_space")
        self._seen = env.single_observation_space if is_vector else env.observation_space
        names = names and tuple(names)
        if self.baseline is not None:
            self.baseline.bind(env, names)
        base, self.masks = env.unwrapped, None
        if hasattr(attribute_of(env, "unwrapped"), "action_masks"):
            self.masks = lambda: base.call("action_masks") if is_vector else [base.action_masks()]
        return super().bind(env, names)

    def _names_of(self, env: Any) -> tuple[str, ...]:
        names = attribute_of(env, "observation_names")
        return names or tuple(map(str, range(spaces.flatdim(self._seen))))

    def _rows(self, observation: Any) -> FloatArray:
        return flattened_observations(self._seen, observation, self.count)

    def _prepare(self) -> None:
        space: Any = self.space
        self.choices = choices_of(space)
        ends = () if self.choices else (space.low.ravel().tolist(), space.high.ravel().tolist())
        self.limits = tuple(zip(*ends, strict=True))
        self.acting = sum(map(len, self.choices)) or len(self.limits)
        agent = self.agent
        if agent.names:
            require_task("the agent", (agent.names, agent.actions), (self.names, str(space)))
        if agent.acting:
            self._require_size()
            self._layers = agent.layers(np.atleast_2d(agent.weights))
        self._memory = self.starts

    def _require_size(self) -> None:
        """Refuse a network that does not fit the task, such as one of a damaged file."""
        agent, seen = self.agent, len(self.names)
        fits = agent.observed == seen if agent.history else agent.observed <= seen
        if not fits or agent.acting != self.acting:
            raise ConfigError(
                f"the agent is for another task: its network has {agent.observed} observations and "
                f"{agent.acting} outputs, the task has {seen} and {self.acting}"
            )

    def _forget(self, mask: npt.NDArray[np.bool_]) -> None:
        if self.baseline is not None:
            self.baseline.reset(mask)
        pairs = zip(self.starts, self._memory, strict=True)
        self._memory = tuple(np.where(mask[:, None], start, now) for start, now in pairs)

    def _decide(self, rows: FloatArray) -> FloatArray:
        base = self.middle
        if self.baseline is not None:
            base = self.baseline._decide(rows).reshape(self.count, -1).T
        return np.stack(self._step(rows, base), axis=-1)

    def _step(self, observed: FloatArray, base: FloatArray) -> list[Any]:
        """Compute the action, as the formulas of ``corrected`` do, and update the memory."""
        if not self.agent.acting:
            return [*base]
        features = observed[:, : self.agent.observed]
        if self._memory:
            last, leaky, told = self._memory
            change, leaky = _change(observed, last), _faded(observed, last, leaky)
            features = np.concatenate([observed, change, leaky, told], axis=-1)
        action = self._with_changes([*base], self._network(features))
        if self._memory:
            self._memory = observed, leaky, np.stack(self._told(action), axis=-1)
        return action

    @property
    def moments(self) -> FloatArray:
        """One, the features of the last decision, and their squares: shape (1 + 2 f, N)."""
        shown = self._shown.T
        return np.concatenate([np.ones((1, self.count)), shown, shown**2])

    @property
    def middle(self) -> FloatArray:
        """The middle of each range, shape (m, N); m is 0 if there are choices."""
        middle = [(low + high) / 2 for low, high in self.limits]
        return np.repeat(np.array(middle)[:, None], self.count, axis=1)

    @property
    def starts(self) -> PolicyState:
        """Memory of the network at the beginning of an episode."""
        if not self.agent.history:
            return ()
        width = len(self.names)
        return np.full(width, np.nan), np.zeros(width), np.zeros(self.acting)

    def corrected(
        self,
        observation: Sequence[Value],
        memory: Sequence[Sequence[Value]],
        base: Sequence[Value],
        network: Callable[[Sequence[Value]], Sequence[Value]],
    ) -> tuple[Sequence[Value], Sequence[Sequence[Value]]]:
        """Formulas of the corrected action and of the new memory.

        Args:
            observation: Its elements.
            memory: Past values that the network sees, in the order of ``starts``.
            base: Decision of the controller, the m elements of the action.
            network: Gives the m corrections, or the chosen elements, for some features.

        Returns:
            The elements of the action, and what it sees of this step later.
        """
        if not self.agent.acting:
            return base, ()
        if not memory:
            return self._with_changes(base, network(observation[: self.agent.observed])), ()
        last, leaky, told = memory
        change = list(map(_change, observation, last))
        leaky = list(map(_faded, observation, last, leaky))
        action = self._with_changes(base, network([*observation, *change, *leaky, *told]))
        return action, (observation, leaky, self._told(action))

    def added(self, changes: Sequence[Any]) -> list[Any] | None:
        """Correction of the action, of which the controller takes notice.

        A controller that a search corrects takes no notice: None.
        """
        return None

    def _with_changes(self, base: Sequence[Any], changes: Sequence[Any]) -> list[Any]:
        """Elements of the action, from the controller and the network."""
        if self.choices:
            return list(changes)
        return [
            limited(limited(one, low, high) + (high - low) / 2 * change, low, high)
            for one, change, (low, high) in zip(base, changes, self.limits, strict=True)
        ]

    def _told(self, action: Sequence[Any]) -> list[Any]:
        """The action as the network sees it in the next step.

        Numbers go from -1 to 1. Of a choice, the chosen element is 1 and the others are 0.
        """
        if self.choices:
            chosen = zip(action, self.choices, strict=True)
            return [1.0 * (one == n) for one, choices in chosen for n in choices]
        limited = zip(action, self.limits, strict=True)
        return [(2.0 * one - low - high) / ((high - low) or 1.0) for one, (low, high) in limited]

    def _network(self, features: FloatArray) -> Any:
        """The outputs for features of shape (N, f), row by row, so that groups do not matter.

        Rows are contiguous, as products of rows with gaps may be rounded in another way.
        """
        self._shown, (mean, divisor) = features, self.agent.scale
        rows = np.ascontiguousarray(features)
        values = limited((rows - mean) / divisor, -LIMIT, LIMIT)[:, None]
        for place, layer in enumerate(self._layers):
            values = (np.tanh(values) if place else values) @ layer[:, :-1] + layer[:, -1:]
        outputs = values[:, 0].T
        if not self.choices:
            return outputs
        if self.masks is not None:
            outputs = np.where(np.array(self.masks()).T, outputs, -np.inf)
        parts = np.split(outputs, np.cumsum([*map(len, self.choices)])[:-1])
        return [
            all_[0] + part.argmax(axis=0) for all_, part in zip(self.choices, parts, strict=True)
        ]


def require_task(
    agent: str, own: tuple[Sequence[str], str], here: tuple[Sequence[str], str]
) -> None:
    """Refuse a task other than the agent's.

    Args:
        agent: Name of the agent in messages.
        own: The names of what it observes, and what its actions are.
        here: Observations and actions of the task.

    Raises:
        ConfigError: With what differs.
    """
    (names, actions), (given, taken) = own, here
    gone, more = sorted({*names} - {*given}), sorted({*given} - {*names})
    told = {
        f"it observes {', '.join(gone)}, which this task does not give": gone,
        f"this task also gives {', '.join(more)}": more,
        "the order of the observations differs": not (gone or more) and [*names] != [*given],
        f"its actions are {actions}, here they are {taken}": actions != taken,
    }
    differences = [text for text, differs in told.items() if differs]
    if differences:
        raise ConfigError(f"{agent} is for another task: {'; '.join(differences)}")
