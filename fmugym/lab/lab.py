"""`Lab`: a simulated lab, and the current lab of the process."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Final, cast

import numpy as np

from fmugym.checks import check_dict, check_integer
from fmugym.errors import ConfigError, shown
from fmugym.lab.cell import Cell, checked_parameters
from fmugym.lab.client import Client
from fmugym.lab.current import CURRENT
from fmugym.lab.data import CellType
from fmugym.lab.presets import Options, make_options
from fmugym.lab.service import Service
from fmugym.lab.users import User
from fmugym.pool.backend.clocks import Clock, RealClock

__all__ = ["Lab", "current_lab"]

_CELLS: Final = {CellType.SINGLE: 4, CellType.DOUBLE: 2}
_FIRST_ID: Final = {CellType.SINGLE: 101, CellType.DOUBLE: 201}
_MOST_CELLS: Final = 100  # of a type, so that the numbers of the types do not overlap
_LARGEST_SEED: Final = 2**128 - 1


class Lab(Service):
    """A lab with simulated cells.

    `Client(lab)` uses it. Within ``with lab:`` every new `Client()` uses it too, in all threads.
    The end of the block closes the lab.

    Args:
        preset: ``"hardware"``, ``"ideal"``, or your own options.
        clock: The lab's time; by default a `RealClock`.
        speed: Speed of the default clock: 2 is twice as fast as real time.
        users: The users by their tokens. By default every token but an empty one is valid and has
            the rights of ``User()``.
        cells: The number of cells of each type; by default four single and two double ones.
        seed: Seed of noise, friction and delays; None for a random one.
        parameters: Parameters of the cells' FMUs, by type of cell.
        video_folder: The folder of videos. By default a temporary folder, which is removed when
            the lab is closed.
        **changes: Options that differ from the preset's; see `Options`.

    Attributes:
        options: What is simulated.
        clock: The lab's time.

    Raises:
        ConfigError: If an argument has a wrong type or is out of its range.
    """

    def __init__(
        self,
        preset: str | Options = "hardware",
        *,
        clock: Clock | None = None,
        speed: float = 1.0,
        users: Mapping[str, User] | None = None,
        cells: Mapping[CellType, int] | None = None,
        seed: int | None = None,
        parameters: Mapping[CellType, Mapping[str, float]] | None = None,
        video_folder: str | Path | None = None,
        **changes: Any,
    ) -> None:
        options = make_options(preset, **changes)
        if seed is not None:
            seed = check_integer("seed", seed, 0, _LARGEST_SEED)
        seeds = np.random.SeedSequence(seed)
        rng = _rng(seeds)
        super().__init__(
            options,
            RealClock(speed) if clock is None else clock,
            _make_cells(options, seeds, _numbers(cells), _parameters(parameters)),
            users,
            rng,
            video_folder,
        )

    def __enter__(self) -> Lab:
        CURRENT.enter(self)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if CURRENT.leave(self):
            self.close()

    def __deepcopy__(self, memo: dict[int, Any]) -> Lab:
        """Return the lab itself, so that copies of an environment's arguments use this lab."""
        return self

    def client(self) -> Client:
        """Return a new client of this lab."""
        return Client(self)


def current_lab() -> Lab:
    """Return the lab of the innermost ``with lab:``, or else the default lab of the process."""
    return cast(Lab, CURRENT.get())


def _default_lab(last: Service | None) -> Service:
    return Lab() if last is None or last.is_closed else last


CURRENT.create_default_by(_default_lab)


def _make_cells(
    options: Options,
    seeds: np.random.SeedSequence,
    numbers: Mapping[CellType, int],
    parameters: Mapping[CellType, Mapping[str, float]],
) -> list[Cell]:
    return [
        Cell(_FIRST_ID[kind] + i, kind, options, _rng(seeds), parameters.get(kind, {}))
        for kind in CellType
        for i in range(numbers.get(kind, 0))
    ]


def _numbers(cells: Any) -> Mapping[CellType, int]:
    numbers = _by_type("cells", _CELLS if cells is None else cells)
    return {
        kind: check_integer(f"cells: the number of {kind.name} cells", count, 0, _MOST_CELLS)
        for kind, count in numbers.items()
    }


def _parameters(parameters: Any) -> dict[CellType, dict[str, float]]:
    by_type = _by_type("parameters", {} if parameters is None else parameters)
    return {kind: checked_parameters(kind, values) for kind, values in by_type.items()}


def _by_type(what: str, value: Any) -> dict[CellType, Any]:
    entries = check_dict(what, value)
    for kind in entries:
        if not isinstance(kind, CellType):
            raise ConfigError(f"{what}: expected a CellType as a key, not {shown(kind)}")
    return entries


def _rng(seeds: np.random.SeedSequence) -> np.random.Generator:
    return np.random.default_rng(seeds.spawn(1)[0])
