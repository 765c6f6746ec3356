"""Write the tables of keys into the documents, and the JSON Schema of task files for editors.

``python docs/_site/keys.py`` writes them anew from the declarations. A table stands in a document
between ``<!-- keys: NAME -->`` and ``<!-- end of keys -->``.
"""

import json
import re
from pathlib import Path
from typing import Any

from fmugym.environment.config import CONFIG, FOREIGN
from fmugym.fmi.safe_zip import ArchiveLimits
from fmugym.fmi.systems.components import Component
from fmugym.keys import (
    REQUIRED,
    AnyKind,
    Either,
    Entries,
    Key,
    Kind,
    Listed,
    Table,
    table_of_fields,
)
from fmugym.task import task_keys as task_format

DOCS = Path(__file__).resolve().parents[1]
SCHEMA = DOCS.parent / "fmugym" / "task" / "task.schema.json"
"""The schema, which comes with the package."""

VARIABLE = task_format.VARIABLE.keys
TABLES = {
    "agent": task_format.AGENT.keys,
    "archive limits": table_of_fields(ArchiveLimits).keys,
    "component": table_of_fields(Component).keys,
    "config": CONFIG.keys,
    "data": task_format.DATA.keys,
    "device": task_format.DEVICE,
    "forecast": task_format.FORECAST.keys,
    "foreign": FOREIGN.keys,
    "forecast error": task_format.FORECAST.keys["error"].kind.keys,
    "kpi": task_format.KPI.keys,
    "memory": task_format.MEMORY.keys,
    "live": {n: key for n, key in task_format.LIVE.keys.items() if n in ("count", "step")},
    "plant": task_format.PLANT.keys,
    "reward": task_format.REWARD.keys,
    "scenario": task_format.SCENARIO.keys,
    "season": task_format.SEASON.keys,
    "signal": task_format.SIGNAL.keys,
    "setpoint": task_format.SETPOINT.keys,
    "system": task_format.SYSTEM_OF_TASK.keys,
    "tag": task_format.TAG.keys,
    "task": task_format.TASK.keys,
    "variable": {n: key for n, key in VARIABLE.items() if n not in task_format.DEVICE},
    "warm-up": task_format.WARM_UP.keys,
}
"""What the documents show, by name."""

BLOCK = re.compile(r"(<!-- keys: ([\w -]+) -->\n).*?(<!-- end of keys -->)", re.DOTALL)


def documents() -> dict[Path, str]:
    """The documents and the schema as they should be, by path."""
    pages = {page: page.read_text(encoding="utf-8") for page in sorted(DOCS.glob("*.md"))}
    filled = {page: BLOCK.sub(_filled, text) for page, text in pages.items()}
    return filled | {SCHEMA: json.dumps(schema(), indent=1) + "\n"}


def shown_in(text: str) -> list[str]:
    """The names of the tables in a document."""
    return [match[2] for match in BLOCK.finditer(text)]


def _filled(match: re.Match[str]) -> str:
    rows = [_row(name, key) for name, key in TABLES[match[2]].items()]
    head = "| key | value | default | meaning |\n|---|---|---|---|\n"
    return f"{match[1]}{head}{''.join(rows)}{match[3]}"


def _row(name: str, key: Key) -> str:
    return f"| `{name}` | {label(key.kind)} | {_default(key)} | {key.text} |\n"


def _default(key: Key) -> str:
    if key.shown:
        return key.shown
    if key.default is REQUIRED:
        return "required"
    if key.default is None or key.default in ((), {}, ""):
        return "none"
    if isinstance(key.kind, Either | Table | Entries):
        return str(key.default)
    return f"`{json.dumps(key.default)}`"


def label(kind: AnyKind) -> str:
    """What a value may be, in words."""
    match kind:
        case Kind():
            return _label_of(kind.schema)
        case Listed(or_one=True):
            return f"{label(kind.kind)}, or a list"
        case Listed():
            return f"list: {label(kind.kind)}"
        case Either():
            return f"{label(kind.other)}, table"
        case Table() if kind.short:
            return f"{label(kind.keys[kind.short].kind)}, table"
    return "table"


def _label_of(schema: dict[str, Any]) -> str:
    if "title" in schema:
        return str(schema["title"])
    if "const" in schema:
        return f"`{json.dumps(schema['const'])}`"
    if "enum" in schema:
        return ", ".join(f"`{json.dumps(one)}`" for one in schema["enum"])
    names = {"string": "text", "boolean": "`true`, `false`"}
    least, most = schema.get("minimum"), schema.get("maximum")
    kind = schema.get("type", "")
    if isinstance(kind, list):  # or an expression of constants
        kind = kind[0]
    if "exclusiveMinimum" in schema or (least == 1 and most is None):
        return f"positive {kind}"
    limits = (
        "" if least is None else f" from {least} on" if most is None else f" from {least} to {most}"
    )
    return names.get(kind, kind or "anything") + limits


def schema() -> dict[str, Any]:
    """The JSON Schema of a task file."""
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "Task file of fmugym",
        **schema_of(task_format.TASK),
    }


def schema_of(kind: AnyKind) -> dict[str, Any]:
    """What a value may be, as JSON Schema."""
    match kind:
        case Kind():
            return dict(kind.schema)
        case Listed():
            listed = {"type": "array", "items": schema_of(kind.kind)}
            listed |= {} if kind.most is None else {"maxItems": kind.most}
            return {"anyOf": [schema_of(kind.kind), listed]} if kind.or_one else listed
        case Entries():
            most = {} if kind.most is None else {"maxProperties": kind.most}
            return {"type": "object", "additionalProperties": schema_of(kind.kind), **most}
        case Either():
            return {"anyOf": [schema_of(kind.other), schema_of(kind.table)]}
    table: dict[str, Any] = {
        "type": "object",
        "additionalProperties": False,
        "properties": {name: _property(key) for name, key in kind.keys.items()},
    }
    required = [name for name, key in kind.keys.items() if key.default is REQUIRED]
    if required and kind is not task_format.AGENT:  # another file may give the rest of it
        table["required"] = required
    if not kind.short:
        return table
    return {"anyOf": [schema_of(kind.keys[kind.short].kind), table]}


def _property(key: Key) -> dict[str, Any]:
    described = schema_of(key.kind)
    described["description"] = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", key.text)
    is_plain = isinstance(key.default, bool | int | float | str) and key.default != ""
    return described | ({"default": key.default} if is_plain else {})


if __name__ == "__main__":
    for path, text in documents().items():
        path.write_text(text, encoding="utf-8")
