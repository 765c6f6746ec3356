"""Measure all figures of speed and memory in the README and docs/, side by side in one run.

    python benchmarks/run.py
    python benchmarks/run.py --quick --only single
    python benchmarks/run.py --json benchmarks.json
    python benchmarks/run.py --table readme --table vector --table hooks --table training

In each section, the configurations take turns, in many rounds. The figures are medians over the
rounds, and ratios are computed within a round, so that other work on the machine disturbs all
configurations alike. Leave the machine alone nevertheless. A package that is not installed gets a
row that says so. Some rows need a C compiler (``cc``, or the package ``ziglang``).
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import arrays
import exchange
import heavy
import isolation
import memory
import overlap
import planning
import single
import systems
import tasks
import training
import vector
from documents import DOCUMENTS
from measure import Effort, processors
from tables import Table

SECTIONS: dict[str, Callable[[Effort], list[Table]]] = {
    "single": single.tables,
    "vector": vector.tables,
    "arrays": arrays.tables,
    "tasks": tasks.tables,
    "heavy": heavy.tables,
    "exchange": exchange.tables,
    "systems": systems.tables,
    "isolation": isolation.tables,
    "overlap": overlap.tables,
    "training": training.tables,
    "planning": planning.tables,
    "memory": memory.tables,
}
FULL = Effort(rounds=11, seconds=0.08, quick=False)
QUICK = Effort(rounds=1, seconds=0.01, quick=True)


def main() -> None:
    """Measure, and print the tables."""
    arguments = _parser().parse_args()
    logging.basicConfig(level=logging.WARNING)
    begin, results = time.perf_counter(), {}
    print(f"{_machine()}\n", flush=True)
    for name, measure in _chosen(arguments.only or [], arguments.table or []).items():
        results[name] = measure(QUICK if arguments.quick else FULL)
        for table in results[name]:
            print(f"{table}\n", flush=True)
    print(f"{time.perf_counter() - begin:.0f} s; {_load()}")
    if arguments.json:
        _write(arguments.json, results)


def _chosen(
    sections: list[str], documents: list[str]
) -> dict[str, Callable[[Effort], list[Table]]]:
    """What to measure: all sections if nothing is chosen."""
    chosen = sections if sections or documents else list(SECTIONS)
    tables = {f"table {name}": DOCUMENTS[name] for name in documents}
    return {name: SECTIONS[name] for name in chosen} | tables


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="only check that everything works")
    parser.add_argument("--only", action="append", choices=SECTIONS, help="may be repeated")
    parser.add_argument(
        "--table",
        action="append",
        choices=DOCUMENTS,
        help="the tables of the README or of a page of docs/; may be repeated",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures here")
    return parser


def _machine() -> str:
    names = ("fmugym-toolbox", "gymnasium", "numpy", "FMPy", "envpool")
    packages = [f"{name} {found}" for name in names if (found := _version(name))]
    system = f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    return f"{system}, {processors()} processors, {_load()}\n{', '.join(packages)}"


def _load() -> str:
    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
    return f"load average {load}"


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _write(path: Path, results: dict[str, list[Table]]) -> None:
    sections = {
        name: [{"title": table.title, "figures": table.data} for table in tables if table.data]
        for name, tables in results.items()
    }
    content = {"machine": _machine(), "sections": sections}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
