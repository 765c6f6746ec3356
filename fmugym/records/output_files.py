"""Output files of ``fmugym simulate``: tables, pictures, reports."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from fmugym.environment.env import FMUEnv
from fmugym.errors import ConfigError, SimulationError, shown
from fmugym.extras import imported
from fmugym.records.html_report import write_report
from fmugym.records.plots import plot
from fmugym.records.series_recorder import RecordSeries
from fmugym.records.time_series import TimeSeries
from fmugym.task import Task

__all__ = ["About", "EpisodeFiles", "require_format", "require_picture", "title_of"]

_TABLES: Final = (".csv", ".parquet")
_PICTURES: Final = (".png", ".svg", ".pdf")
_REPORT: Final = ".html"


def require_picture(path: Path) -> None:
    """Refuse a file for a picture before any episode is played for it.

    Raises:
        ConfigError: If its name tells no format of pictures, or Matplotlib is missing.
    """
    _require_ending(path, _PICTURES)
    imported("matplotlib", "plot")


def require_format(path: Path, runs: int) -> None:
    """Refuse a file before any episode is played for it.

    Raises:
        ConfigError: If its name tells no known format, a table cannot hold so many runs, or
            Matplotlib is missing for a picture.
    """
    _require_ending(path, (*_TABLES, *_PICTURES, _REPORT))
    if path.suffix.lower() not in _TABLES:
        imported("matplotlib", "plot")
    elif runs > 1:
        raise ConfigError(f"{shown(str(path))} holds one run, got {runs}; a report holds several")


def _require_ending(path: Path, endings: Sequence[str]) -> None:
    if path.suffix.lower() not in endings:
        raise ConfigError(f"the file ends with one of {', '.join(endings)}; got {shown(str(path))}")


def title_of(target: str) -> str:
    """Title of a task in pictures and reports: a file's name without its folder."""
    path = Path(target)
    return path.name if path.is_file() else target


@dataclass(frozen=True)
class About:
    """Description of a task in a report.

    Attributes:
        facts: By name: the FMU, versions.
        description: Description of the task.
        text: The task, as its file has it.
    """

    facts: Mapping[str, str]
    description: str = ""
    text: str = ""

    @classmethod
    def of(cls, env: FMUEnv) -> About:
        """Look at an environment."""
        facts = {
            "FMU": f"{env.fmu.path.name} (FMI {env.fmu.description.fmi_version})",
            "time step": f"{env.config.time_step:g} s",
            "fmugym": version("fmugym-toolbox"),
        }
        task = getattr(env, "task", None)
        if not isinstance(task, Task):
            return cls(facts)
        text = "\n".join(source.text for source in task.sources).strip()
        return cls(facts, str(task.document.get("description", "")), text)


class EpisodeFiles:
    """The episodes of one controller after another, and the files about them.

    Args:
        target: The task, as in the arguments.
        scenario: Its scenario.
        paths: The files.
    """

    def __init__(self, target: str, scenario: str | None, paths: Sequence[Path]) -> None:
        name = title_of(target)
        self._title = name if scenario is None else f"{name}, scenario {scenario}"
        self._paths = paths
        self._recorders: dict[str, RecordSeries] = {}
        self._about = About({})

    def begin(
        self, name: str, env: Any, variables: Sequence[str] | None, every: float | None
    ) -> RecordSeries:
        """Wrap the environment of the next controller."""
        tables = [path for path in self._paths if path.suffix.lower() in _TABLES]
        first = tables[0] if tables else None
        self._recorders[name] = RecordSeries(env, variables, every=every, path=first)
        self._about = About.of(env.unwrapped)
        return self._recorders[name]

    @contextmanager
    def finished(self, seed: int) -> Iterator[None]:
        """Write all files at the end, also after a failure, with the rows until then."""
        try:
            yield
        finally:
            self._finish(seed)

    def _finish(self, seed: int) -> None:
        runs: dict[str, TimeSeries] = {}
        for name, recorder in self._recorders.items():
            recorder.complete()
            with suppress(SimulationError):  # it has nothing of a run that could not begin
                runs[name] = recorder.series
        tables = 0
        for path in self._paths if runs else ():
            if path.suffix.lower() in _TABLES:
                tables += 1
                if tables > 1:
                    next(iter(runs.values())).write(path)
            elif path.suffix.lower() == _REPORT:
                self._write_report(path, runs, seed)
            else:
                _draw(path, runs, self._title)

    def _write_report(self, path: Path, runs: dict[str, TimeSeries], seed: int) -> None:
        about = self._about
        write_report(
            path,
            runs,
            title=self._title,
            description=about.description,
            facts={**about.facts, "first seed": str(seed)},
            text=about.text,
        )


def _draw(path: Path, runs: dict[str, TimeSeries], title: str) -> None:
    """Draw the first episode of each run; a run after the first has its number in the name."""
    for number, (name, series) in enumerate(runs.items()):
        first = next(iter(series.episodes().values()))
        own = path.with_stem(f"{path.stem}-{number}") if number else path
        plot(first, own, title=f"{title}: {name}")
