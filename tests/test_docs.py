"""What the documents say: their Python runs, and what they quote is what the package has."""

import ast
import dataclasses
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import fmugym
from fmugym.config import EnvConfig
from fmugym.tools.cli import main

ROOT = Path(__file__).parent.parent
DOCUMENTS = sorted((ROOT / "docs").glob("*.md")) + sorted(ROOT.glob("README.md"))
GUIDE = ROOT / "docs" / "integrating-an-fmu.md"
CONFIG = ROOT / "docs" / "config.md"
FENCE = re.compile(r"^(?P<indent> *)```(?P<language>[^\n`]*)\n(?P<code>.*?)^ *```$", re.M | re.S)
EXTRAS = {"stable-baselines3.md": "stable_baselines3"}  # what a document's Python needs
NOT_PYTHON = {"bash", "c", "console", "json", "mermaid", "text", "toml", "yaml"}

each_document = pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)


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


@each_document
def test_every_block_names_its_language(document):
    for fence in FENCE.finditer(document.read_text()):
        assert fence["language"] in NOT_PYTHON | {"python"}, fence["code"]
    assert document.read_text().count("```") == 2 * len(FENCE.findall(document.read_text()))


@pytest.mark.parametrize(
    "document", [d for d in DOCUMENTS if blocks(d, "python")], ids=lambda path: path.name
)
def test_python_runs(document, tmp_path):
    if document.name in EXTRAS:
        pytest.importorskip(EXTRAS[document.name], reason="needs an extra of the package")
    script = tmp_path / f"{document.stem}.py"
    script.write_text(program(document))
    command = [sys.executable, "-W", "error", script.name]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr


@each_document
def test_links_within_the_repository_exist(document):
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", document.read_text()):
        assert (document.parent / target).exists(), target


def test_shown_output_of_info_is_what_it_prints(capsys):
    main(["info", str(fmugym.bundled_fmu("Pendulum"))])
    printed = capsys.readouterr().out.splitlines()
    (shown,) = (b["code"] for b in blocks(GUIDE, "text") if b["code"].startswith("Pendulum (FMI"))
    for line in shown.splitlines():
        assert line == "..." or line in printed or "this machine" in line


def test_messages_in_the_troubleshooting_table_exist():
    known = "\n".join(messages())
    rows = re.findall(r"^\| `([^`]+)`", GUIDE.read_text(), re.M)
    assert len(rows) > 15
    for row in rows:
        pattern = r".*".join(map(re.escape, row.split("...")))
        assert re.search(pattern, known), row


def messages():
    """The string literals of the package, one a line, with ``...`` for what is put in."""
    for path in (ROOT / "fmugym").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                parts = [p.value if isinstance(p, ast.Constant) else "..." for p in node.values]
                yield "".join(parts)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield re.sub(r"%[-+.\d]*[sdgr]", "...", node.value).replace("\n", " ")


def test_config_table_has_every_key_with_its_default():
    section = CONFIG.read_text().split("## ")[1]
    rows = dict(re.findall(r"^\| `(\w+)` \| ([^|]+?) \|", section, re.M))
    fields = {field.name: field for field in dataclasses.fields(EnvConfig)}
    assert list(rows) == list(fields)
    for name, default in rows.items():
        assert shown_default(fields[name]) == default.strip("`"), name


def shown_default(field):
    if field.default_factory is not dataclasses.MISSING:
        return repr(field.default_factory())
    return "required" if field.default is dataclasses.MISSING else repr(field.default)


def table(heading):
    """The names in the first column of the tables of a section."""
    section = CONFIG.read_text().split(f"## {heading}")[1].split("\n## ")[0]
    return set(re.findall(r"^\| `(\w+)", section, re.M)) - {"metadata"}


def test_hook_table_has_every_hook():
    hooks = {name for name in vars(fmugym.FMUEnv) if re.match(r"_(get|is)_", name)}
    assert hooks | {"_update", "_reward_policy", "_goal_reward"} <= table("Hooks")
    for name in table("Hooks"):
        assert callable(getattr(fmugym.FMUEnv, name)), name


def test_attribute_table_is_that_of_the_class():
    documented = fmugym.FMUEnv.__doc__.split("Attributes:")[1].split("Raises:")[0]
    attributes = set(re.findall(r"^ +(\w+): ", documented, re.M))
    assert attributes <= table("What hooks may read")
    for name in table("What hooks may read") - attributes:
        assert isinstance(getattr(fmugym.FMUEnv, name), property), name
