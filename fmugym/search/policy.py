"""Policies as arrays: a controller, and a network that corrects what it decides."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.baselines.controller import Controller, FloatArray, attribute_of, limited
from fmugym.errors import ConfigError
from fmugym.search.flattening import choices_of, rows_of

__all__ = ["LIMIT", "Form", "Policy", "Scale", "names_that_differ"]

_NOTHING: Final = np.empty(0)

Memory = tuple[Any, ...]
"""What a policy keeps from one step to the next: arrays of numbers, or of symbols."""

LIMIT: Final = 5.0
"""The largest magnitude of a scaled feature."""

_FADE: Final = 0.05
"""The part of the way that the leaky integral of an observation follows it in a step."""

_CONSTANT: Final = 1e-8
"""A feature whose deviation is smaller than this, beside its mean, counts as constant."""


@dataclass(frozen=True)
class Form:
    """A class of policies.

    Attributes:
        name: What it is called.
        observed: The number of observations; 0 for a network that gives constants.
        acting: The number of outputs.
        hidden: The widths of the hidden layers, which end in a tanh.
        history: Whether the network also sees the last change of each observation, its leaky
            integral, and the last action.
    """

    name: str
    observed: int
    acting: int
    hidden: tuple[int, ...] = ()
    history: bool = False

    @property
    def features(self) -> int:
        """How many numbers the network sees."""
        return 3 * self.observed + self.acting if self.history else self.observed

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """The inputs, the constant one included, and the outputs of each layer."""
        widths = [self.features, *self.hidden, self.acting]
        return [(before + 1, after) for before, after in itertools.pairwise(widths)]

    @property
    def size(self) -> int:
        """The number of weights."""
        return sum(before * after for before, after in self.shapes)

    def extended(self, weights: FloatArray) -> FloatArray:
        """The weights that decide as those of a linear policy without a history, shape (n,).

        This form is linear, too.
        """
        found, count = np.zeros(self.shapes[0]), self.observed + 1
        given = weights.reshape(count, self.acting) * math.sqrt(len(found) / count)
        found[: self.observed], found[-1] = given[:-1], given[-1]
        return found.ravel()

    def constants(self, values: FloatArray) -> FloatArray:
        """The weights of N linear policies that give constants of shape (N, outputs)."""
        found = np.zeros((len(values), self.size))
        found[:, -self.acting :] = values * math.sqrt(self.shapes[0][0])
        return found

    def layers(self, weights: FloatArray) -> Iterator[FloatArray]:
        """The layers of N networks, each of shape (N, inputs + 1, outputs); the bias comes last.

        Args:
            weights: Shape (N, size). Those of a layer count in units of 1/sqrt(inputs), so that one
                step length suits all.
        """
        place = 0
        for before, after in self.shapes:
            part = weights[:, place : place + before * after]
            yield part.reshape(-1, before, after) / math.sqrt(before)
            place += before * after


class Scale(NamedTuple):
    """What features are like.

    Attributes:
        mean: Of each feature, shape (f,).
        divisor: Its standard deviation, shape (f,); constant ones are not made larger.
    """

    mean: FloatArray
    divisor: FloatArray

    @classmethod
    def of(cls, moments: FloatArray, features: int) -> Self:
        """Compute them.

        Args:
            moments: The sums of what ``Policy.moments`` gives in each step.
            features: The number f.
        """
        mean, squares = np.split(moments[1:] / moments[0], [features])
        deviation = np.sqrt(np.maximum(squares - mean**2, 0.0))
        is_constant = deviation <= _CONSTANT * (1.0 + np.abs(mean))
        return cls(mean, np.where(is_constant, np.maximum(np.abs(mean), 1.0), deviation))


class Policy(Controller):
    """A controller whose action a network corrects.

    Of a ``Box`` the action is that of the controller, and half of the range times what the network
    gives. Of a ``Discrete`` or a ``MultiDiscrete`` the largest output of each part chooses, among
    what the method ``action_masks`` of the environment allows, if it has one. Without weights it is
    the controller's own action.

    Args:
        baseline: The controller; None for the middle of the range, or the first of the choices.
        form: What the network sees, and its layers; None for no network.
        weights: Shape (n,) with n from ``Form.size``, or (N, n) with those of each environment.
        scale: Mean and divisor of each feature, shape (f,).
        task: The names of the observations, and the action space in words, that it is for; None
            for any.
    """

    masks: Callable[[], Any] | None

    def __init__(
        self,
        baseline: Controller | None,
        form: Form | None = None,
        weights: FloatArray = _NOTHING,
        scale: tuple[FloatArray, FloatArray] = (_NOTHING, _NOTHING),
        task: tuple[tuple[str, ...], str] | None = None,
    ) -> None:
        self.baseline, self.form, self.task = baseline, form, task
        self.weights, self.scale = weights, scale

    def bind(self, env: Any, names: Iterable[str] | None = None) -> Self:
        """See ``Controller.bind``; observations may be of any numeric space."""
        is_vector = hasattr(env, "single_observation_space")
        self._seen = env.single_observation_space if is_vector else env.observation_space
        names = tuple(self._names_of(env) if names is None else names)
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
        return rows_of(self._seen, observation, self.count)

    def _prepare(self) -> None:
        space: Any = self.space
        self._choices = choices_of(space)
        self.parts = tuple(map(len, self._choices))
        pairs = () if self.parts else zip(space.low.flat, space.high.flat, strict=True)
        self.limits = tuple((float(low), float(high)) for low, high in pairs)
        self.acting = sum(self.parts) or len(self.limits)
        self._require_task()
        if self.form is not None:
            self._layers = list(self.form.layers(np.atleast_2d(self.weights)))
        self._memory = tuple(np.repeat(one[None], self.count, axis=0) for one in self.starts)

    def _require_task(self) -> None:
        """Refuse another task than that of the agent; the text names what differs."""
        if self.task in (None, (self.names, str(self.space))):
            return
        names, space = self.task
        told = names_that_differ(names, self.names)
        if space != str(self.space):
            told.append(f"its actions are {space}, here they are {self.space}")
        raise ConfigError(f"the agent is for another task: {'; '.join(told)}")

    def _forget(self, mask: npt.NDArray[np.bool_]) -> None:
        if self.baseline is not None:
            self.baseline.reset(mask)
        pairs = zip(self.starts, self._memory, strict=True)
        self._memory = tuple(np.where(mask[:, None], start, now) for start, now in pairs)

    def _decide(self, rows: FloatArray) -> FloatArray:
        if self.baseline is None:
            base = np.repeat(np.array(self.middle)[:, None], self.count, axis=1)
        else:
            base = self.baseline._decide(rows).reshape(self.count, -1).T
        action, self._memory = self.step(rows, self._memory, base, self._network)
        return np.stack(action, axis=-1)

    @property
    def moments(self) -> FloatArray:
        """One, the features of the last decision, and their squares: shape (1 + 2 f, N)."""
        shown = self._shown.T
        return np.concatenate([np.ones((1, self.count)), shown, shown**2])

    @property
    def middle(self) -> list[float]:
        """The middle of the range of each number, or the first choice of each part."""
        return [float(one[0]) for one in self._choices] or [(a + b) / 2 for a, b in self.limits]

    @property
    def starts(self) -> Memory:
        """What the network sees of the past, at the beginning of an episode."""
        if self.form is None or not self.form.history:
            return ()
        width = len(self.names)
        return np.full(width, np.nan), np.zeros(width), np.zeros(self.acting)

    def step(
        self, observed: Any, memory: Memory, base: Any, network: Callable[[Any], Any]
    ) -> tuple[list[Any], Memory]:
        """Decide once; all values may be arrays or symbols.

        Args:
            observed: Shape (..., k).
            memory: What the last step has returned, or ``starts``.
            base: What the controller has decided: the m elements of the action.
            network: Gives the m corrections for features of shape (..., f). If actions are
                discrete, it gives the chosen elements.

        Returns:
            The elements of the action, and what to keep.
        """
        features, *kept = self._features(observed, memory)
        given = None if self.form is None else network(features)
        if given is None or self.parts:
            action = list(base if given is None else given)
        else:
            action = list(map(_corrected, base, given, self.limits))
        return action, (*kept, self._told(action)) if kept else ()

    def _features(self, observed: Any, memory: Memory) -> tuple[Any, ...]:
        """What the network sees, and what it shall see of this step in the next one."""
        if not memory:
            return (observed[..., : self.form.observed] if self.form else observed,)
        last, leaky, told = memory
        is_first = np.isnan(last)
        change = np.where(is_first, 0.0, observed - last)
        leaky = np.where(is_first, observed, leaky + _FADE * (observed - leaky))
        return np.concatenate([observed, change, leaky, told], axis=-1), observed, leaky

    def _told(self, action: Sequence[Any]) -> Any:
        """The action as the network sees it in the next step.

        Numbers go from -1 to 1. Of a choice, the chosen element is 1 and the others are 0.
        """
        if self.parts:
            told = [one == n for one, all_ in zip(action, self._choices, strict=True) for n in all_]
        else:
            pairs = zip(action, self.limits, strict=True)
            told = [(2.0 * one - low - high) / ((high - low) or 1.0) for one, (low, high) in pairs]
        return 1.0 * np.stack(told, axis=-1)

    def _network(self, features: FloatArray) -> Any:
        """The outputs for features of shape (N, f), row by row, so that groups do not matter.

        Rows are contiguous, as products of rows with gaps may be rounded in another way.
        """
        self._shown, (mean, divisor) = features, self.scale
        rows = np.ascontiguousarray(features)
        values = limited((rows - mean) / divisor, -LIMIT, LIMIT)[:, None]
        *hidden, last = self._layers
        for layer in hidden:
            values = np.tanh(values @ layer[:, :-1] + layer[:, -1:])
        outputs = (values @ last[:, :-1] + last[:, -1:])[:, 0].T
        if not self.parts:
            return outputs
        if self.masks is not None:
            outputs = np.where(np.array(self.masks()).T, outputs, -np.inf)
        split = np.split(outputs, np.cumsum(self.parts)[:-1])
        return [
            one[0] + part.argmax(axis=0) for one, part in zip(self._choices, split, strict=True)
        ]


def names_that_differ(own: Sequence[str], here: Sequence[str]) -> list[str]:
    """Say how the observations of an agent and of a task differ; nothing if they do not."""
    gone, more = ([n for n in a if n not in b] for a, b in ((own, here), (here, own)))
    told = [f"it observes {', '.join(gone)}, which this task does not give"] if gone else []
    if more:
        told.append(f"this task also gives {', '.join(more)}")
    return told or (["the order of the observations differs"] if list(own) != list(here) else [])


def _corrected(base: Any, change: Any, limits: tuple[float, float]) -> Any:
    """An element of the action: that of the controller, and the change in halves of the range."""
    low, high = limits
    return limited(limited(base, low, high) + (high - low) / 2 * change, low, high)
