"""Cache of model descriptions: large ones take seconds to parse at each construction.

A file holds JSON behind a checksum, which takes less time to write than to compress. What is
damaged, or was written by another version of this package, is as good as missing, and so is a
folder that cannot be read or written.
"""

from __future__ import annotations

import functools
import hashlib
import json
import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Final

import fmpy

from fmugym.archive.description import Capabilities, ModelDescription, ModelExchange, Unit
from fmugym.archive.variable import OWN, UNKNOWN, Interval, Variable
from fmugym.caching import cache_folder, read_file, replace_file

__all__ = ["keep", "kept"]

logger = logging.getLogger(__name__)

_FOLDER: Final = "descriptions"
_LARGEST: Final = 2**28
"""Bytes that a file may have."""

_SIMPLE: Final = tuple(
    field.name
    for field in fields(ModelDescription)
    if field.name
    not in {"capabilities", "variables", "namesakes", "units", "model_exchange", "structure"}
)


def kept(key: str) -> ModelDescription | None:
    """Read the value of a key from the cache; None if there is no sound one."""
    try:
        content = read_file(cache_folder(_FOLDER) / _name(key), _LARGEST)
        digest, text = content[:32], content[32:]
        if hashlib.sha256(text).digest() != digest:
            return None
        return _description_of(json.loads(text))
    except Exception:  # whatever a file may hold
        return None


def keep(key: str, description: ModelDescription) -> None:
    """Keep a model description under a key, as it was read."""
    try:
        text = json.dumps(_plain(description)).encode()
        path = cache_folder(_FOLDER) / _name(key)
        replace_file(path, hashlib.sha256(text).digest() + text)
    except (OSError, RecursionError) as error:
        logger.debug("the model description is not kept: %s", error)


def _name(key: str) -> str:
    return hashlib.sha256(f"{key} {_version()}".encode()).hexdigest()[:32]


@functools.cache
def _version() -> str:
    """Identify the code that reads model descriptions.

    Raises:
        OSError: If its files cannot be read.
    """
    sources = sorted(Path(__file__).parent.glob("*.py"))
    if not sources:
        raise FileNotFoundError(f"{__file__} is in no folder")
    digest = hashlib.sha256(fmpy.__version__.encode())
    for source in sources:
        digest.update(source.read_bytes())
    return digest.hexdigest()


def _plain(description: ModelDescription) -> dict[str, Any]:
    """Lists, dicts, texts and numbers from which ``_description_of`` makes it again."""
    exchange = description.model_exchange
    return {
        "simple": [getattr(description, name) for name in _SIMPLE],
        "capabilities": asdict(description.capabilities),
        "units": {name: asdict(unit) for name, unit in description.units.items()},
        "model_exchange": None if exchange is None else asdict(exchange),
        "variables": _table(description.variables.values()),
        "namesakes": [_table(several) for several in description.namesakes.values()],
    }


def _table(variables: Iterable[Variable]) -> dict[str, Any]:
    """Own values of each variable, and the number of the values that its siblings share."""
    rows = list(variables)
    each = [variable.shared for variable in rows]
    shared = {id(one): one for one in each}
    numbers = {identity: number for number, identity in enumerate(shared)}
    return {
        "own": [[getattr(variable, name) for variable in rows] for name in OWN],
        "numbers": [numbers[id(one)] for one in each],
        "shared": list(shared.values()),
    }


def _description_of(plain: dict[str, Any]) -> ModelDescription:
    exchange = plain["model_exchange"]
    variables = _variables_of(plain["variables"])
    namesakes = [tuple(_variables_of(table)) for table in plain["namesakes"]]
    simple = dict(zip(_SIMPLE, map(_frozen, plain["simple"]), strict=True))
    return ModelDescription(
        **simple,
        capabilities=Capabilities(**plain["capabilities"]),
        variables={variable.name: variable for variable in variables},
        namesakes={several[0].name: several for several in namesakes},
        units={name: _unit_of(unit) for name, unit in plain["units"].items()},
        model_exchange=None
        if exchange is None
        else ModelExchange(**{name: _frozen(value) for name, value in exchange.items()}),
    )


def _variables_of(table: dict[str, Any]) -> list[Variable]:
    templates = [_template_of(shared) for shared in table["shared"]]
    rows = zip(table["numbers"], *table["own"], strict=True)
    return [templates[number].sibling(*own) for number, *own in rows]


def _template_of(shared: dict[str, Any]) -> Variable:
    attributes = {name: _frozen(value) for name, value in shared.items()}
    times = {name: _time_of(attributes[name]) for name in ("interval", "shift")}
    return Variable(name="", value_reference=0, **(attributes | times))


def _time_of(time: Sequence[Any]) -> Interval:
    """Read a time of a clock; ``UNKNOWN`` for one that only the FMU knows."""
    made = Interval(*time)
    return UNKNOWN if math.isnan(made.seconds) else made


def _unit_of(unit: dict[str, Any]) -> Unit:
    displays = {name: tuple(pair) for name, pair in unit["display_units"].items()}
    dimension = unit["dimension"]
    return Unit(
        None if dimension is None else tuple(dimension), unit["factor"], unit["offset"], displays
    )


def _frozen(value: Any) -> Any:
    """Tuples, which JSON has made lists."""
    return tuple(map(_frozen, value)) if isinstance(value, list) else value
