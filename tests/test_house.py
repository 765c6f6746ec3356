"""The rooms of the package: imports run one way, and no two modules import each other."""

import ast
from pathlib import Path

import pytest

import fmugym

PACKAGE = Path(fmugym.__file__).parent

STOREYS = [
    {"signals", "_native"},
    {"errors", "caching", "lazy"},
    {"checks", "retired", "extras", "figures", "scaling", "wine"},
    {"archive", "distributions", "rendering"},
    {"systems"},
    {"fmi"},
    {"pool"},
    {"trial"},
    {"config"},
    {"task"},
    {"env"},
    {"vector", "lab", "identification", "linearization"},
    {"baselines"},
    {"search"},
    {"registration", "recording", "testing", "sb3", "torchrl", "declared", "series"},
    {"export", "logs", "minari"},
    {"envs", "pettingzoo", "rllib", "tools"},
    {"__init__", "__main__", "clock"},
]
"""From the ground floor up: a room imports rooms of lower storeys and itself only."""


def module_of(path):
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def imports_of(module):
    """The modules of the package that a module imports anywhere, functions and types included."""
    path = MODULES[module]
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} has a relative import"
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in MODULES else node.module for name in names}
    found = {name for name in found if name.split(".")[0] == "fmugym"}
    return {name for name in found if not module.startswith(f"{name}.")}


def room_of(module):
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "__init__"


@pytest.mark.parametrize("module", MODULES)
def test_a_room_imports_lower_storeys_only(module):
    storey = {room: level for level, rooms in enumerate(STOREYS) for room in rooms}
    own = room_of(module)
    above = [
        name
        for name in imports_of(module)
        if room_of(name) != own and storey[room_of(name)] >= storey[own]
    ]
    assert above == []


def test_no_module_imports_itself_by_a_detour():
    graph = {module: imports_of(module) & MODULES.keys() for module in MODULES}
    while leaves := {module for module, targets in graph.items() if not targets}:
        graph = {m: targets - leaves for m, targets in graph.items() if m not in leaves}
    assert graph == {}
