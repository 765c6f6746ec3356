"""The documents: their Python runs, and their tables and quotations agree with the package."""

import ast
import dataclasses
import inspect
import pkgutil
import re
import subprocess
import sys
import textwrap
import tomllib
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from ways import in_way

import fmugym
import fmugym.lab
from fmugym.environment.hooks import Hooks
from fmugym.pool.opening import PoolOptions

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
DOCUMENTS = sorted(DOCS.glob("*.md")) + sorted(ROOT.glob("*.md"))
INDEX, CLASS, ERRORS = DOCS / "README.md", DOCS / "class.md", DOCS / "failures.md"
RELIABILITY = DOCS / "reliability.md"
FENCE = re.compile(r"^(?P<indent> *)```(?P<language>[^\n`]*)\n(?P<code>.*?)^ *```$", re.M | re.S)
EXTRAS = {
    "deploy.md": ("torch",),
    "libraries.md": ("stable_baselines3", "torchrl"),
    "systems.md": ("pettingzoo",),
    "datasets.md": ("minari",),
    "plant.md": ("pymodbus",),
    "rllib.md": ("ray.rllib",),
}  # what a document's Python needs
WARNING = {"datasets.md", "libraries.md", "rllib.md"}  # libraries of them warn of themselves
NOT_PYTHON = {"bash", "c", "console", "json", "mermaid", "text", "toml", "yaml"}


def name_of(document):
    return "index" if document == INDEX else document.name


def blocks(document, *languages):
    return [
        fence for fence in FENCE.finditer(document.read_text()) if fence["language"] in languages
    ]


def program(document):
    """The Python blocks in one file, each line where it stands in the document."""
    lines = []
    text = document.read_text()
    for fence in blocks(document, "python"):
        first = text.count("\n", 0, fence.start()) + 1
        lines += [""] * (first - len(lines))
        lines += textwrap.dedent(fence["code"]).splitlines()
    return "\n".join(lines) + "\n"


def test_every_block_names_its_language():
    for document in DOCUMENTS:
        text = document.read_text()
        for fence in FENCE.finditer(text):
            assert fence["language"] in NOT_PYTHON | {"python"}, f"{document}: {fence['code']}"
        assert text.count("```") == 2 * len(FENCE.findall(text)), document


@pytest.mark.parametrize("document", [d for d in DOCUMENTS if blocks(d, "python")], ids=name_of)
def test_python_runs(document, tmp_path):
    for module in EXTRAS.get(document.name, ()):
        pytest.importorskip(module, reason="needs an extra of the package")
    script = tmp_path / f"{document.stem}.py"
    script.write_text(program(document))
    warnings = "ignore" if document.name in WARNING else "error"
    command = [sys.executable, "-W", warnings, script.name]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr


def test_links_within_the_repository_exist():
    for document in DOCUMENTS:
        for target, anchor in re.findall(r"\]\(([^)#:]*)(?:#([^)]*))?\)", document.read_text()):
            path = document.parent / target if target else document
            assert path.exists(), f"{document}: {target}"
            if anchor:
                assert anchor in anchors(path), f"{document}: {target}#{anchor}"


def anchors(document):
    """The anchors that GitHub makes of a document's headings."""
    text = FENCE.sub("", document.read_text())
    headings = re.findall(r"^#+ (.+)$", text, re.M)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


def test_the_changes_of_the_next_version_are_short():
    unreleased = (ROOT / "CHANGELOG.md").read_text().split("\n## ")[1]
    assert len(unreleased.splitlines()) <= 100


def test_the_index_names_every_page():
    listed = set(re.findall(r"\]\(([\w-]+\.md)", INDEX.read_text()))
    assert {path.name for path in DOCS.glob("*.md")} - {INDEX.name} == listed


SIX = ("README.md", "tutorial.md", "task-file.md", "class.md", "training.md", "failures.md")


def test_the_index_begins_with_six_pages():
    rows = re.findall(r"^\| \[[^]]+\]\((\S+)\)", INDEX.read_text(), re.M)
    assert ("README.md", *rows[:5]) == SIX


def test_the_five_pages_beside_the_index_lead_to_all_others():
    reached = {
        name
        for page in SIX[1:]
        for name in re.findall(r"\]\(([\w-]+\.md)", (DOCS / page).read_text())
    }
    for_contributors = {"architecture.md"}
    assert {path.name for path in DOCS.glob("*.md")} - {*SIX} - for_contributors <= reached


def test_the_index_lists_every_extra():
    with (ROOT / "pyproject.toml").open("rb") as file:
        extras = tomllib.load(file)["project"]["optional-dependencies"]
    table = section(INDEX, "Install")
    names = re.findall(r"`([\w-]+)`", " ".join(re.findall(r"^\| (`.+?) \|", table, re.M)))
    assert set(names) == set(extras)


def test_contributors_are_told_of_every_folder_of_the_package():
    tree, _ = blocks(ROOT / "CONTRIBUTING.md", "text")
    told = set(re.findall(r"(\w+)/", tree["code"]))
    assert {path.parent.name for path in (ROOT / "fmugym").glob("*/__init__.py")} <= told


def test_the_drawing_of_the_house_has_every_folder_of_the_package():
    house = blocks(DOCS / "architecture.md", "text")[0]["code"]
    drawn = set(re.findall(r"(\w+)/", house))
    packages = {path.parent.name for path in (ROOT / "fmugym").glob("*/__init__.py")}
    assert drawn - packages == {"native"}
    assert packages <= drawn


@pytest.mark.parametrize("document", ["CONTRIBUTING.md", "docs/architecture.md"])
def test_files_of_which_contributors_are_told_exist(document):
    named = re.findall(
        r"`((?:fmugym|native|tests|docs)/[\w./]+\.\w+)`", (ROOT / document).read_text()
    )
    assert len(named) > 8
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_messages_in_the_table_of_errors_exist():
    known = list(messages())
    section = ERRORS.read_text().split("## Messages")[1]
    rows = re.findall(r"^\| `([^`]+)`", section, re.M)
    assert len(rows) > 15
    for row in rows:
        parts = row.split("...")
        longest = max(parts, key=len)  # the search for a pattern in every text takes seconds
        pattern = ".*".join(map(re.escape, parts))
        assert any(longest in text and re.search(pattern, text) for text in known), row


def messages():
    """The string literals of the package, each on one line, with ``...`` for what is put in."""
    for path in (ROOT / "fmugym").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                parts = [p.value if isinstance(p, ast.Constant) else "..." for p in node.values]
                yield "".join(parts)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield re.sub(r"%[-+.\d]*[sdgr]", "...", node.value).replace("\n", " ")
    for path in (ROOT / "native").rglob("*.c"):
        joined = re.sub(r'"\s*\n\s*"', "", path.read_text())
        yield from re.findall(r'"([^"\\\n]*)"', joined)


def test_the_classes_of_errors_are_those_of_the_package():
    classes = {name for name in fmugym.errors.__all__ if name.endswith("Error")}
    assert set(re.findall(r"\w+Error\b", fmugym.errors.__doc__)) == {
        *classes,
        "TypeError",
        "KeyError",
    }
    assert 'help("fmugym.errors")' in ERRORS.read_text()


def section(document, heading):
    return re.split(rf"^#+ {heading}\n", document.read_text(), flags=re.M)[1].split("\n## ")[0]


def test_table_of_health_is_what_is_counted():
    env = fmugym.envs.CartPoleEnv()
    names = re.findall(r"^\| (`[^|]+`) \|", section(RELIABILITY, "Health"), re.M)
    documented = re.findall(r"`(\w+)`", " ".join(names))
    assert sorted(documented) == sorted(env.health)
    env.close()


def test_docstrings_describe_every_argument_of_vector_environments():
    own = inspect.signature(fmugym.FMUVectorEnv.__init__).parameters
    described = re.findall(r"^ {8}(\w+): ", fmugym.FMUVectorEnv.__doc__, re.M)
    assert set(own) - {"self"} <= set(described)
    attributes = PoolOptions.__doc__.split("Raises:")[0]
    options = re.findall(r"^ {8}(\w+): ", attributes, re.M)
    assert {option.name for option in dataclasses.fields(PoolOptions)} == set(options)


def test_table_of_shapes_is_what_hooks_see():
    """Of the pendulum with two outputs and three environments."""
    seen = {}

    class Watched(fmugym.FMI2CSEnv):
        def __init__(self):
            config = {
                "model_input_names": "tau",
                "model_output_names": ["q", "q_dot"],
                "model_parameters": {"m": fmugym.Uniform(0.05, 0.07)},
                "episode_variables": {"target": 0.5, "past": np.zeros(1)},
                "bounds": {"tau": (-1, 1)},
                "time_step": 0.02,
            }
            super().__init__(fmugym.bundled_fmu("Pendulum"), config)

        def _is_done(self):
            for code in shapes:
                seen[code] = np.shape(eval(f"env.{code}", {"env": self}))
            return abs(self.state[0]) > 10.0

    table = section(CLASS, "What hooks may read").split("Shapes in")[1]
    rows = re.findall(r"^\| (`.+?) \| .+ \| .*?(\(.*\)|last axis) \|$", table, re.M)
    expected = {"(outputs, N)": (2, 3), "(inputs, N)": (1, 3), "(N,)": (3,), "last axis": (1, 3)}
    shapes = {code: expected[text] for cell, text in rows for code in re.findall("`(.+?)`", cell)}
    envs = fmugym.FMUVectorEnv(in_way("arrays", Watched), 3)
    envs.reset(seed=0)
    envs.step(envs.action_space.sample())
    envs.close()
    assert len(shapes) > 8
    assert seen == shapes


def table(heading):
    """The names in the first column of the tables of a section."""
    return set(re.findall(r"^\| `(\w+)", section(CLASS, heading), re.M))


def test_hook_table_has_every_hook():
    hooks = {name for name in vars(Hooks) if re.match(r"_(get|is)_", name)}
    assert hooks | {"_update", "_reward_policy", "_goal_reward"} <= table("All hooks")
    for name in table("All hooks"):
        assert callable(getattr(fmugym.FMUEnv, name)), name


def test_attribute_table_is_that_of_the_class():
    documented = fmugym.FMUEnv.__doc__.split("Attributes:")[1].split("Raises:")[0]
    attributes = set(re.findall(r"^ +(\w+): ", documented, re.M))
    assert attributes <= table("What hooks may read")
    for name in table("What hooks may read") - attributes:
        assert isinstance(getattr(fmugym.FMUEnv, name), property), name


def test_the_reference_of_the_site_has_every_public_name():
    tree = ast.parse((DOCS / "_site" / "reference.py").read_text())
    assigned = {a.target.id: a.value for a in tree.body if isinstance(a, ast.AnnAssign)}
    pages, modules = assigned["PAGES"], ast.literal_eval(assigned["MODULES"])
    told = [n.value for page in pages.values for n in ast.walk(page) if isinstance(n, ast.Constant)]
    own, elsewhere = [n for n in told if "." not in n], [n for n in told if "." in n]
    errors = {name for name in fmugym.__all__ if name.endswith("Error")}
    assert sorted(own) == sorted(set(fmugym.__all__) - errors - {"envs"})
    assert all(pkgutil.resolve_name(f"fmugym.{name}").__doc__ for name in elsewhere)
    assert all(find_spec(module) for module in modules.values())
