"""Keys are declared once: checks, documents and the schema of editors follow from that."""

import importlib.util
import re
import shutil
from pathlib import Path

import pytest

import fmugym
from fmugym.config import EnvConfig
from fmugym.errors import TaskError
from fmugym.tools.cli import main

ROOT = Path(__file__).parent.parent

WRONG = """\
fmu = { bundled = "Pendulum" }
time_stepp = "20ms"
reward = "-abs(q"

[variables]
tau = { min = 0.01, max = -0.01, sample = "median" }

[agent]
actions = ["tau"]
observations = ["q"]
rescale = "yes"

[setpoints]
goal = { steps = { low = 0, high = 1 } }

[config]
on_fault = "rais"

[foreign]
probe_timeout = -1
"""


@pytest.fixture(scope="module")
def pages():
    """The module that writes the tables of the documents."""
    spec = importlib.util.spec_from_file_location("site_keys", ROOT / "docs" / "_site" / "keys.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_documents_and_schema_are_those_of_the_declarations(pages):
    changed = [str(p) for p, text in pages.documents().items() if p.read_text("utf-8") != text]
    assert not changed, f"run: python docs/_site/keys.py, which changes {changed}"


def test_a_document_shows_each_table(pages):
    texts = [page.read_text("utf-8") for page in (ROOT / "docs").glob("*.md")]
    shown = [name for text in texts for name in pages.shown_in(text)]
    assert sorted(shown) == sorted(pages.TABLES)


def test_one_error_tells_all_mistakes_of_a_file(tmp_path):
    file = tmp_path / "wrong.toml"
    file.write_text(WRONG)
    with pytest.raises(TaskError) as caught:
        fmugym.load(file)
    lines = str(caught.value).splitlines()
    facts = [
        (2, "time_stepp", "'time_step'"),
        (3, "reward", "column"),
        (6, "variables.tau.sample", "'median'.*'mean'"),
        (6, "variables.tau", "0.01 and -0.01"),
        (11, "agent.rescale", "'yes'"),
        (14, "setpoints.goal.steps", "'every' is missing"),
        (17, "config.on_fault", "'rais'.*'raise'"),
        (20, "foreign.probe_timeout", "-1"),
    ]
    for line, keys, fact in facts:
        told = [one for one in lines if one.startswith(f"wrong.toml, line {line}, {keys}: ")]
        assert re.search(fact, "".join(told)), (line, keys, lines)
    assert len(lines) == len(facts)


def test_one_error_tells_all_that_does_not_fit_the_fmu(tmp_path):
    file = tmp_path / "wrong.toml"
    file.write_text(
        """
        fmu = { bundled = "Pendulum" }
        [variables]
        speed = { name = "q_dott" }
        angle = { name = "q", unit = "kg" }
        [agent]
        actions = ["tau"]
        observations = ["q"]
        """
    )
    with pytest.raises(TaskError) as caught:
        fmugym.load(file)
    first, second = str(caught.value).splitlines()
    assert first.startswith("wrong.toml, line 4, variables.speed.name: ")
    assert "'q_dot'" in first
    assert second.startswith("wrong.toml, line 5, variables.angle.unit: ")
    assert "'kg'" in second


def test_one_error_tells_all_mistakes_of_expressions(tmp_path):
    file = tmp_path / "wrong.toml"
    file.write_text(
        """
        fmu = { bundled = "Pendulum" }
        terminated = "abs(q_dott) > 2"
        reward = "-near"
        [variables]
        tau = { min = -1, max = 1 }
        [agent]
        actions = ["tau"]
        observations = ["q"]
        [expressions]
        near = "abs(qq)"
        [costs]
        heat = "tauu**2"
        """
    )
    with pytest.raises(TaskError) as caught:
        fmugym.load(file)
    told = sorted(str(caught.value).splitlines())
    places = [re.match(r"wrong.toml, (line \d+, [\w.]+): ", line)[1] for line in told]
    assert places == [
        "line 11, expressions.near",
        "line 13, costs.heat",
        "line 3, terminated",
    ]
    for line, name in zip(told, ("'q'", "'tau'", "'q_dot'"), strict=True):
        assert name in line


def test_one_error_tells_all_mistakes_of_a_config():
    given = {"model_input_names": "u", "time_step": -1, "on_fault": "rais", "substep": 2}
    with pytest.raises(fmugym.ConfigError) as caught:
        EnvConfig.from_dict(given)
    for fact in ("time_step", "-1", "'raise'", "'substeps'"):
        assert fact in str(caught.value)


def test_a_new_task_names_the_schema_beside_it(tmp_path, monkeypatch):
    shutil.copy(fmugym.bundled_fmu("Pendulum"), tmp_path / "model.fmu")
    monkeypatch.chdir(tmp_path)
    assert main(["new", "model.fmu", "--output", "task.toml"]) == 0
    first, *_ = Path("task.toml").read_text().splitlines()
    schema = Path(first.removeprefix("#:schema "))
    assert not schema.is_absolute()
    assert schema.read_text() == (ROOT / "fmugym/declared/task.schema.json").read_text()
    task = fmugym.Task.read("task.toml")
    Path("other").mkdir()
    task.write("copy.toml")
    task.write("other/copy.toml")
    assert Path("copy.toml").read_text().startswith(first)
    assert "#:schema" not in Path("other/copy.toml").read_text()
