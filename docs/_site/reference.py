"""Pages of the reference that are made of docstrings: all public names, room by room."""

import inspect
from pkgutil import resolve_name
from typing import Any, Final

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

import fmugym

PAGES: Final = {
    "Environments": (
        "FMUEnv",
        "FMI1CSEnv",
        "FMI2CSEnv",
        "FMI3CSEnv",
        *("FMI1MEEnv", "FMI2MEEnv", "FMI3MEEnv"),
        "environment.config.EnvConfig",
        "register",
    ),
    "Many environments": ("FMUVectorEnv",),
    "Task files": ("load", "Task", "TaskEnv"),
    "Distributions": ("Uniform", "Normal", "LogUniform", "Choice"),
    "Thinking ahead": ("Snapshot",),
    "Agents": ("training.agents.load_agent",),
    "FMUs": ("FMU", "fmi.ArchiveLimits", "fmi.Status", "bundled_fmu"),
    "Systems": ("FMUSystem", "Component", "Connection"),
    "Rigs": ("pool.Backend", "pool.Paced"),
    "Errors": (),  # and all other exceptions
}
"""Names in ``fmugym``, and others by their modules in it."""

MODULES: Final = {
    "Recordings": "fmugym.records.recording",
    "Linear models": "fmugym.control.linearization",
    "Baselines": "fmugym.control",
    "Stable-Baselines3": "fmugym.training.sb3",
    "PettingZoo": "fmugym.training.pettingzoo",
    "RLlib": "fmugym.training.rllib",
    "Plant logs": "fmugym.records.plant_log",
    "Fits to plant logs": "fmugym.records.log_fit",
    "Minari": "fmugym.records.minari",
    "Export": "fmugym.deployment.export",
    "Checks of an environment": "fmugym.environment.env_checker",
    "Identification": "fmugym.control.identification",
    "Pictures": "fmugym.rendering",
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages, and name them in the navigation."""
    pages = {title: "\n\n".join(map(_block, names)) for title, names in _names().items()}
    pages |= {title: _module(name) for title, name in MODULES.items()}
    entries: list[Any] = []
    for title, text in pages.items():
        uri = f"reference/{title.lower().replace(' ', '-')}.md"
        files.append(File.generated(config, uri, content=f"# {title}\n\n{text}\n"))
        entries.append({title: uri})
    reference = next(entry["Reference"] for entry in config.nav or () if "Reference" in entry)
    reference.append({"Python": entries})
    return files


def _names() -> dict[str, list[str]]:
    """The public names of each page; a name that is on no page is an error."""
    names = {title: list(page) for title, page in PAGES.items()}
    for name in fmugym.__all__:
        value = getattr(fmugym, name)
        if inspect.isclass(value) and issubclass(value, Exception):
            names["Errors"].append(name)
    left = set(fmugym.__all__) - {"envs"} - {name for page in names.values() for name in page}
    if left:
        raise LookupError(f"put these names on a page of docs/_site/reference.py: {sorted(left)}")
    return names


def _block(name: str) -> str:
    value = resolve_name(f"fmugym.{name}")
    return f"::: {value.__module__}.{value.__qualname__}"


def _module(name: str) -> str:
    return f"::: {name}\n    options:\n      show_root_heading: false\n      heading_level: 1"
