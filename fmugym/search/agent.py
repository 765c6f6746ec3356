"""Agents that a search has found, as files of numbers."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from fmugym.baselines import controller_of
from fmugym.baselines.arena import Arena, Outcome
from fmugym.baselines.controller import FloatArray
from fmugym.errors import ConfigError, reason, shown
from fmugym.search.policy import Form, Policy
from fmugym.signals import ordinary

__all__ = ["AGENT", "Agent"]

AGENT: Final = "agent.npz"
"""The file of an agent in its folder."""


@dataclass(frozen=True)
class Agent:
    """A controller and a network that corrects it.

    Attributes:
        name: What it is called.
        text: The controller, as ``controller_of`` reads it; None for the middle of the range.
        form: What the network sees, and its layers; None for no network.
        weights: Those of the network, shape (n,).
        scale: Mean and divisor of each feature, shape (f,).
        names: What it observes; empty if that is not known yet.
        actions: The action space, in words.
    """

    name: str
    text: str | None
    form: Form | None = None
    weights: FloatArray = field(default_factory=lambda: np.empty(0))
    scale: Any = (np.empty(0), np.empty(0))
    names: tuple[str, ...] = ()
    actions: str = ""

    @classmethod
    def constant(cls, name: str, value: float, ranges: Sequence[tuple[float, float]]) -> Self:
        """The agent that always gives all numbers of the action one value."""
        low, high = np.transpose(ranges)
        weights = (2.0 * value - low - high) / (high - low)
        return cls(name, None, Form("constant action", 0, len(ranges)), weights)

    def policy(self) -> Policy:
        """The controller, to be bound to an environment.

        Binding it raises ``ConfigError`` if the agent is for another task.
        """
        baseline = None if self.text is None else controller_of(self.text)
        task = (self.names, self.actions) if self.names else None
        return Policy(baseline, self.form, self.weights, self.scale, task)

    def play(self, arena: Arena, seeds: Sequence[int]) -> Outcome:
        """Let the agent play alone."""
        return arena.play(lambda rows: self.policy(), np.empty((1, 0)), seeds)

    def save(self, folder: Path) -> None:
        """Write the agent to a folder; a file that is there is replaced."""
        facts = json.dumps(asdict(self) | {"weights": None, "scale": None})
        mean, divisor = self.scale
        with (folder / AGENT).open("wb") as file:
            np.savez(file, facts=facts, weights=self.weights, mean=mean, divisor=divisor)

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read the agent in a folder; its file holds numbers and texts only.

        Raises:
            ConfigError: If the file is missing or damaged.
        """
        try:
            with (folder / AGENT).open("rb") as file, np.load(file, allow_pickle=False) as found:
                facts = json.loads(str(found["facts"]))
                numbers = [np.asarray(found[n], np.float64) for n in ("weights", "mean", "divisor")]
            form = facts["form"]
            form = form and Form(**form | {"hidden": tuple(form["hidden"])})
            counts = [form.size, form.features, form.features] if form else [0, 0, 0]
            if [len(one) for one in numbers] != counts or not np.isfinite(np.hstack(numbers)).all():
                raise ValueError(f"expected {counts} finite numbers")
            known = facts["name"], facts["text"], form, numbers[0], tuple(numbers[1:])
            return cls(*known, tuple(facts["names"]), facts["actions"])
        except ordinary(Exception) as error:  # a damaged file may raise anything
            raise ConfigError(
                f"the agent in {shown(str(folder))} cannot be read: {reason(error)}"
            ) from None
