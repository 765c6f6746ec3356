"""A house with a heat pump, declared in a task file."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from fmugym.task import Task, TaskEnv

__all__ = ["HOUSE_TASK", "HouseEnv"]

HOUSE_TASK = Path(__file__).with_name("house.toml")
"""The task file: copy it to change the house, the comfort or the prices."""


class HouseEnv(TaskEnv):
    """Heat a house cheaply while the price of electricity changes by the hour.

    The plant is the bundled FMU of a house with an air-source heat pump and underfloor heating
    (``resources/House/README.md``). The action is the part load of the heat pump, from 0 to 1;
    below 0.2 it is off. An agent observes temperatures, set point, weather, price, the hour of the
    day, and forecasts of twelve hours. The reward of a step of 15 min is minus the cost of the
    electricity in EUR, and minus 0.50 EUR for each hour and kelvin below the set point or above
    24 degC. An episode is a week of the heating season of a synthetic year.

    Args:
        scenario: "autumn", "frost" or "spring": two weeks that training leaves out. By default an
            episode begins on a day that is drawn from the others.
        fmi_version: FMI version of the FMU, "2.0" or "3.0".
        log_level: As for ``TaskEnv``.
        render_mode: As for ``TaskEnv``.
        options: More arguments of ``TaskEnv``.

    Raises:
        ConfigError: If the scenario is unknown, or there is no such FMU.
    """

    def __init__(
        self,
        scenario: str | None = None,
        fmi_version: str = "2.0",
        log_level: int = logging.WARNING,
        *,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        fmu = {"bundled": "House", "fmi_version": fmi_version}
        task = Task.of({"extends": str(HOUSE_TASK), "fmu": fmu})
        task = task if scenario is None else task.in_scenario(scenario)
        super().__init__(task, log_level, render_mode=render_mode, **options)
