"""Results of ``validate``: checks, costs and recommended settings."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any

from fmugym.errors import plain

__all__ = ["Advice", "CheckResult", "ValidationReport", "lines_of"]


@dataclass(frozen=True)
class CheckResult:
    """The result of a check.

    Attributes:
        verdict: ``"ok"``, ``"warning"`` or ``"error"``.
        check: Name of the check.
        text: Description of the result.
        cure: Advice; empty for none.
    """

    verdict: str
    check: str
    text: str
    cure: str = ""


@dataclass(frozen=True)
class Advice:
    """A line for a task file.

    Attributes:
        table: The table it stands in; ``""`` for the top of the file.
        key, value: Recommended setting.
        why: Measurement behind the advice.
    """

    table: str
    key: str
    value: Any
    why: str

    @property
    def line(self) -> str:
        """The line, in TOML."""
        return f"{self.key} = {json.dumps(self.value)}"


@dataclass(frozen=True)
class ValidationReport:
    """The results of all checks.

    Attributes:
        findings: The results in the order of the checks.
        costs: Seconds of real time by name: ``step``, ``reset`` and ``restore`` of one environment.
            None for a restore that the FMU does not allow.
        hooks: Calls of hooks in a vector environment: ``expressions``, ``arrays`` or
            ``one by one``.
        execution: Sentences on how the FMU runs, and why.
        reset_method: How episodes begin.
        recommended: Settings that suit the task, by name.
        advices: Lines for the task file, of these settings.
    """

    findings: tuple[CheckResult, ...]
    costs: Mapping[str, float | None]
    hooks: str
    execution: tuple[str, ...]
    reset_method: str
    recommended: Mapping[str, Any]
    advices: tuple[Advice, ...] = ()

    @property
    def verdict(self) -> str:
        """The worst verdict."""
        found = {finding.verdict for finding in self.findings}
        return next(one for one in ("error", "warning", "ok") if one in found or one == "ok")

    def as_dict(self) -> dict[str, Any]:
        """The report in types that JSON has."""
        facts = {"verdict": self.verdict, **asdict(self)}
        lines = zip(facts.pop("advices"), self.advices, strict=True)
        return facts | {"lines": [one | {"line": advice.line} for one, advice in lines]}

    def as_text(self) -> str:
        """The report in lines of printable ASCII."""
        lines = []
        for one in self.findings:
            lines.append(f"{one.verdict:8} {one.check}: {plain(one.text)}")
            if one.cure:
                lines.append(f"{'':8} cure: {plain(one.cure)}")
        step, reset, restore = (_duration(self.costs[n]) for n in ("step", "reset", "restore"))
        lines.append(f"a step takes {step}, a reset {reset}, to restore a state {restore}")
        lines += map(plain, self.execution)
        lines.append(f"hooks in a vector environment: {self.hooks}")
        if "envs" in self.recommended:
            lines.append(f"recommended for a training: --envs {self.recommended['envs']}")
        if self.advices:
            lines += ["recommended for the task file:", *lines_of(self.advices)]
        return "\n".join(lines)


def lines_of(advices: Iterable[Advice]) -> list[str]:
    """The lines of a task file, with the reasons as comments: printable ASCII."""
    ordered = sorted(advices, key=lambda one: one.table)
    width = max((len(one.line) for one in ordered), default=0)
    lines = []
    for table, group in groupby(ordered, key=lambda one: one.table):
        lines += [f"[{table}]"] if table else []
        lines += [f"{one.line.ljust(width)}  # {plain(one.why)}" for one in group]
    return lines


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return "is not possible"
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-6:.3g} us"
