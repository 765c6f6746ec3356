"""The conversions of an environment: of actions to inputs, and of outputs to observations."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from fmugym.task import spaces as fmu_spaces
from fmugym.task.actions import elements_of, no_action
from fmugym.task.input_writer import InputWriter
from fmugym.task.interface import Interface
from fmugym.task.own_hooks import OwnHooks
from fmugym.task.results import finiteness_of

__all__ = ["Conversions"]


@dataclass
class Conversions:
    """The conversions of an environment: of actions to inputs, and of outputs to observations.

    Attributes:
        elements: The integers that are actions; None for other spaces.
        action_values: The values of the input for these, if they are others.
        no_action: The action of an episode that begins.
        input_writer: Checks inputs and writes them.
        observe: Makes the default observation from the outputs.
        pool_observes: Whether the pool makes the observation.
        is_finite: Whether all numbers of an observation are finite.
        has_info: Whether a step has an info.
    """

    elements: Collection[int] | None
    action_values: Sequence[int] | None
    no_action: Any
    input_writer: InputWriter
    observe: Callable[[Any], Any]
    pool_observes: bool
    is_finite: Callable[[Any], bool]
    has_info: bool

    @classmethod
    def of(
        cls,
        interface: Interface,
        action_space: spaces.Space[Any],
        observation_space: spaces.Space[Any],
        own: OwnHooks,
        *,
        tells: bool,
    ) -> Conversions:
        """Prepare the conversions of an environment.

        Args:
            interface: The variables of the config.
            action_space: That of the environment.
            observation_space: That of the environment.
            own: The hooks of its class.
            tells: Whether the pool adds to infos.

        Raises:
            ConfigError: If the elements of the action are not those of an Enumeration.
        """
        default = not own.get_observation
        make = fmu_spaces.default_observation if default else fmu_spaces.outputs_observation
        if own.get_action_space and not own.get_inputs:
            fmu_spaces.check_choices(interface.inputs, action_space)
        is_float32 = (
            isinstance(observation_space, spaces.Box) and observation_space.dtype == np.float32
        )
        return cls(
            # A class with its own step may take other actions.
            elements=None if own.step else elements_of(action_space),
            action_values=None
            if own.get_action_space
            else fmu_spaces.discrete_values(interface.chosen_inputs),
            no_action=no_action(action_space),
            input_writer=InputWriter(interface.inputs),
            observe=make(interface, observation_space),
            pool_observes=default and is_float32,
            is_finite=finiteness_of(observation_space),
            has_info=own.get_info or tells,
        )
