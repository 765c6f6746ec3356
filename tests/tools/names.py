"""Check the names and the first sentences of the package: ``python tests/tools/names.py``.

A public name means one thing in the whole package, so one module defines it. The docstring of a
module begins with the noun or the verb for the module, and a C file of the extension begins with a
sentence about the file.
"""

import ast
import re
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[2]
RIDDLES = ("What", "Who", "How", "Whether")
"""First words of docstrings in which the noun is missing."""

LOCAL = ("getLogger", "ParamSpec", "TypeVar")
"""Python's idioms: the result of these functions has a name in each module that calls them."""


def mistakes(root=ROOT):
    """Yield a line for each mistake in the modules of ``fmugym/`` and the files of ``native/``."""
    trees = {path: tree_of(path) for path in sorted((root / "fmugym").rglob("*.py"))}
    definitions = defaultdict(list)
    for path, tree in trees.items():
        place = path.relative_to(root).as_posix()
        for name in sorted(set(public_names(tree.body))):
            definitions[name].append(place)
        if (ast.get_docstring(tree) or "").split(" ")[0] in RIDDLES:
            yield f"{place}: the docstring does not begin with a noun or a verb"
    for name, places in sorted(definitions.items()):
        if len(places) > 1:
            yield f"{name} is defined in {', '.join(places)}"
    for path in sorted((root / "native").rglob("*.c")):
        if not re.match(r"/\*\s.+?\.\s", path.read_text(encoding="utf-8"), re.DOTALL):
            yield f"{path.relative_to(root).as_posix()}: no sentence in a comment at the beginning"


def tree_of(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def public_names(statements):
    """Yield the public names that the statements of a module define, imports excepted."""
    for node in statements:
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            found = [node.name]
        elif isinstance(node, ast.Assign | ast.AnnAssign) and not is_local(node.value):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            parts = [part for target in targets for part in ast.walk(target)]
            found = [part.id for part in parts if isinstance(part, ast.Name)]
        elif isinstance(node, ast.If | ast.Try | ast.With):
            branches = [node, *getattr(node, "handlers", [])]
            inner = [getattr(b, part, []) for b in branches for part in ("body", "orelse")]
            found = [name for body in inner for name in public_names(body)]
        else:
            found = []
        yield from (name for name in found if not name.startswith("_"))


def is_local(value):
    """Whether a value is the result of one of the functions in ``LOCAL``."""
    function = getattr(value, "func", None)
    return getattr(function, "attr", getattr(function, "id", None)) in LOCAL


def main():
    found = list(mistakes())
    sys.stdout.writelines(f"{line}\n" for line in found)
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
