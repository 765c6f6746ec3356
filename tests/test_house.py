"""The rooms of the package: imports run one way, and no two modules import each other."""

import ast
from pathlib import Path

import gymnasium
import pytest

import fmugym
from fmugym import FMUEnv, FMUVectorEnv, TaskEnv
from fmugym.task.hooks import Hooks

PACKAGE = Path(fmugym.__file__).parent

STOREYS = [
    {"signals", "_native"},
    {"errors", "caching", "lazy"},
    {"checks", "retired", "extras", "figures", "scaling", "wine"},
    {"keys"},
    {"archive", "distributions", "rendering"},
    {"systems"},
    {"fmi"},
    {"pool"},
    {"trial"},
    {"config"},
    {"task"},
    {"env"},
    {"vector", "lab", "identification"},
    {"linearization"},
    {"baselines"},
    {"search"},
    {"registration", "recording", "testing", "sb3", "torchrl", "declared", "series"},
    {"export", "logs", "minari", "episodes", "repair"},
    {"training"},
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


ROOT = PACKAGE.parent
FOLDERS = ("fmugym", "examples", "benchmarks", "tests")
ENVIRONMENTS = {cls for env in (TaskEnv, FMUEnv, FMUVectorEnv) for cls in env.__mro__}


def names_given_in(cls):
    """The names of the methods of a class, and of the attributes that it declares and assigns."""
    tree = ast.parse(MODULES[cls.__module__].read_text(encoding="utf-8"))
    (body,) = (n for n in tree.body if isinstance(n, ast.ClassDef) and n.name == cls.__name__)
    for node in ast.walk(body):
        if isinstance(node, ast.FunctionDef):
            yield node.name
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr
    for node in body.body:
        targets = getattr(node, "targets", [getattr(node, "target", None)])
        yield from (target.id for target in targets if isinstance(target, ast.Name))


def private_names():
    """The private names of environments, and the modules that give them.

    Hooks are called by others, and the names of Gymnasium are known to its own tools.
    """
    modules, known = {}, vars(Hooks).keys() | vars(gymnasium.Env).keys()
    for cls in ENVIRONMENTS:
        for name in names_given_in(cls) if cls.__module__ in MODULES else ():
            if name.startswith("_") and not name.endswith("__") and name not in known:
                modules.setdefault(name, set()).add(MODULES[cls.__module__])
    return modules


def names_read_in(tree):
    """The names of attributes of others that a module reads or writes, with their places."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) not in {"self", "cls"}:
            yield node.attr, node.lineno
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in {"getattr", "setattr"}:
            name = node.args[1] if len(node.args) > 1 else None
            if isinstance(name, ast.Constant) and ast.unparse(node.args[0]) != "self":
                yield name.value, node.lineno


def test_nobody_else_uses_private_attributes_of_environments():
    """What others need is in ``inside``, or is a function that takes the environment."""
    private, found = private_names(), []
    for path in (path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")):
        for name, line in names_read_in(ast.parse(path.read_text(encoding="utf-8"))):
            if path not in private.get(name, {path}):
                found.append(f"{path.relative_to(ROOT)}:{line}: {name}")
    assert {"_step_in_python", "_open_pool", "_background"} <= private.keys()
    assert not found, "\n".join(found)
