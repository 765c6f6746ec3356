"""The check of names accepts this package, and finds each kind of mistake."""

import names
import pytest


def test_the_package_has_no_mistake():
    assert list(names.mistakes()) == []


def checked(root, files):
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return list(names.mistakes(root))


@pytest.mark.parametrize(
    "definition",
    [
        "class Form:\n    pass",
        "def Form():\n    pass",
        "Form = 1",
        "Form: int = 1",
        "if 1:\n    Form = 1",
    ],
)
def test_a_name_that_two_modules_define(tmp_path, definition):
    files = {"fmugym/a.py": definition, "fmugym/b/c.py": "Form, other = 1, 2"}
    assert checked(tmp_path, files) == ["Form is defined in fmugym/a.py, fmugym/b/c.py"]


def test_names_that_each_module_may_define(tmp_path):
    text = "from x import Form\n_form = 1\nlogger = logging.getLogger(__name__)\nR = TypeVar('R')\n"
    assert checked(tmp_path, {"fmugym/a.py": text, "fmugym/b.py": text}) == []


@pytest.mark.parametrize(
    ("docstring", "is_refused"),
    [
        ("What a pool needs.", True),
        ("Who acts.", True),
        ("How it ends.", True),
        ("Whether it ends.", True),
        ("Whole numbers.", False),
        ("Pools of FMUs.", False),
    ],
)
def test_the_docstring_of_a_module(tmp_path, docstring, is_refused):
    found = checked(tmp_path, {"fmugym/a.py": f'"""{docstring}"""'})
    expected = ["fmugym/a.py: the docstring does not begin with a noun or a verb"]
    assert found == (expected if is_refused else [])


@pytest.mark.parametrize(
    ("text", "is_refused"),
    [
        ("#include <math.h>", True),
        ("/* Steps */\n", True),
        ("/* Steps of one instance. */\n", False),
        ("/* Steps of\n * one instance.\n *\n * And more. */\n", False),
    ],
)
def test_the_beginning_of_a_c_file(tmp_path, text, is_refused):
    found = checked(tmp_path, {"native/worker/steps.c": text})
    expected = ["native/worker/steps.c: no sentence in a comment at the beginning"]
    assert found == (expected if is_refused else [])
