"""The layers of the package: imports run one way, and no two modules import each other."""

import ast
import graphlib
import re
from collections import Counter
from functools import cache
from pathlib import Path

import gymnasium

import fmugym
from fmugym import FMUEnv, FMUVectorEnv, TaskEnv
from fmugym.environment.hooks import Hooks

PACKAGE = Path(fmugym.__file__).parent

ROOT = PACKAGE.parent
RULE = "-" * 20
"""In the picture: optional packages are above it, the core is below."""


def picture():
    """The layers as CONTRIBUTING draws them: the lowest one first, and the core."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    (block,) = (b for b in re.findall(r"```text\n(.*?)```", text, re.DOTALL) if RULE in b)
    lines = [re.split(r"\s{2,}", line)[0] for line in block.splitlines()]
    below = lines[[line.startswith(RULE) for line in lines].index(True) + 1 :]
    drawn = [layers_on(line) for line in reversed(lines) if not line.startswith(RULE)]
    return [packages for line in drawn for packages in line], {
        package for line in below for packages in layers_on(line) for package in packages
    }


def layers_on(line):
    return [set(layer.split(", ")) for layer in line.split(" <- ")]


LAYERS, CORE = picture()
EXCEPTIONS = {"fmugym.control.mpc": "fmugym.training.search.excitation"}
"""Where the core opens an optional package, in a function: the surrogate of ``MPC`` comes from an
FMU that a controller excites."""


def module_of(path):
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path): path for path in sorted(PACKAGE.rglob("*.py"))}


@cache
def tree_of(module):
    return ast.parse(MODULES[module].read_text(encoding="utf-8"))


def imports_of(module):
    """The modules of the package that a module imports anywhere, functions and types included."""
    found = {name for node in ast.walk(tree_of(module)) for name in imported_by(node)}
    return {name for name in found if not module.startswith(f"{name}.")}


def imported_by(node):
    """The modules of the package that a statement imports."""
    if isinstance(node, ast.Import):
        found = {alias.name for alias in node.names}
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0, "a relative import"
        names = {f"{node.module}.{alias.name}" for alias in node.names}
        found = {name if name in MODULES else node.module for name in names}
    else:
        found = set()
    return {name for name in found if name.split(".")[0] == "fmugym"}


def package_of(module):
    return (module.split(".")[1:] or ["__init__"])[0]


def test_the_picture_has_each_package_once():
    drawn = [package for packages in LAYERS for package in packages]
    assert sorted(drawn) == sorted({*map(package_of, MODULES), "_native"})


def test_a_package_imports_lower_storeys_only():
    layer = {package: level for level, packages in enumerate(LAYERS) for package in packages}
    upwards = {
        module: name
        for module in MODULES
        for name, own in ((name, package_of(module)) for name in imports_of(module))
        if package_of(name) != own and layer[package_of(name)] >= layer[own]
    }
    assert upwards == EXCEPTIONS


def test_environments_need_nothing_above_them():
    """``import fmugym.environment`` reaches expressions, pools, FMUs and pictures, and no task."""
    reached, left = set(), {m for m in MODULES if package_of(m) == "environment"}
    while left:
        reached |= left
        left = {name for module in left for name in imports_of(module) & MODULES.keys()} - reached
    folders = {package_of(name) for name in reached if MODULES[name].parent != PACKAGE}
    assert folders == {"environment", "expressions", "pool", "fmi", "rendering"}


def test_the_package_shows_at_a_glance_what_it_does():
    packages = [*PACKAGE.glob("*/__init__.py")]
    assert 0 < len(packages) <= 13
    assert 0 < len([*PACKAGE.glob("*.py")]) <= 8


def test_the_core_opens_optional_packages_in_functions_only():
    found = []
    for module in (module for module in MODULES if package_of(module) in CORE):
        tree = tree_of(module)
        named = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
        at_import = {name for node in tree.body for name in imported_by(node)}
        optional = [n for n in named & MODULES.keys() | at_import if package_of(n) not in CORE]
        found += [f"{module}: {name}" for name in optional]
    assert found == []


def test_the_name_of_a_file_tells_it_from_all_others():
    sources = [*PACKAGE.rglob("*.[ch]"), *(ROOT / "native").rglob("*.[ch]")]
    often = Counter(path.name for path in [*MODULES.values(), *sources])
    assert {name for name, count in often.items() if count > 1} == {"__init__.py"}


def test_a_c_file_includes_files_of_its_folder_and_of_those_below():
    native = ROOT / "native"
    picture = (native / "README.md").read_text(encoding="utf-8").split("```")[1]
    folders = re.findall(r"^(\w+) ", picture, re.MULTILINE)
    assert set(folders) == {path.parent.name for path in native.rglob("*.[ch]")}
    upwards = []
    for place, folder in enumerate(folders):
        for path in (native / folder).glob("*.[ch]"):
            included = re.findall(r'#include "(.+)"', path.read_text(encoding="utf-8"))
            above = [name for name in included if name.split("/")[0] not in folders[place:]]
            upwards += [f"{path.name}: {name}" for name in above]
    assert upwards == []


def test_c_files_include_each_other_in_no_circle():
    """A source and its header count as one; fmu.c joins all others."""
    for folder in ("resources/src", "native"):
        needs = {}
        for path in (ROOT / folder).rglob("*.[ch]"):
            found = re.findall(r'#include "(?:\w+/)?(\w+)\.h"', path.read_text(encoding="utf-8"))
            needs.setdefault(path.stem, set()).update(set(found) - {path.stem, "fmu"})
        needs.pop("fmu", None)
        assert len(needs) > 5
        graphlib.TopologicalSorter(needs).prepare()  # raises CycleError


def test_no_module_imports_itself_by_a_detour():
    graph = {m: (imports_of(m) & MODULES.keys()) - {EXCEPTIONS.get(m)} for m in MODULES}
    while leaves := {module for module, targets in graph.items() if not targets}:
        graph = {m: targets - leaves for m, targets in graph.items() if m not in leaves}
    assert graph == {}


FOLDERS = ("fmugym", "examples", "benchmarks", "tests")
ENVIRONMENT = {"environment"}
"""The rooms of the environment."""

ENVIRONMENTS = {cls for env in (TaskEnv, FMUEnv, FMUVectorEnv) for cls in env.__mro__}


def names_given_in(cls):
    """The names of the methods of a class, and of the attributes that it declares and assigns."""
    (body,) = (
        n
        for n in tree_of(cls.__module__).body
        if isinstance(n, ast.ClassDef) and n.name == cls.__name__
    )
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
    """Rooms of the environment share them; others need its public properties."""
    private, found = private_names(), []
    own = {MODULES[module] for module in MODULES if package_of(module) in ENVIRONMENT}
    for path in {path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")} - own:
        for name, line in names_read_in(ast.parse(path.read_text(encoding="utf-8"))):
            if path not in private.get(name, {path}):
                found.append(f"{path.relative_to(ROOT)}:{line}: {name}")
    assert {"_step_in_python", "_open_pool", "_background"} <= private.keys()
    assert not found, "\n".join(found)
