"""Keys are declared once: checks, documents and the schema of editors follow from that."""

import importlib.util
import shutil
from pathlib import Path

import pytest

import fmugym
from fmugym.environment.config import EnvConfig

ROOT = Path(__file__).parent.parent


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


def test_one_error_tells_all_mistakes_of_a_config():
    given = {"model_input_names": "u", "time_step": -1, "on_fault": "rais", "substep": 2}
    with pytest.raises(fmugym.ConfigError) as caught:
        EnvConfig.from_dict(given)
    for fact in ("time_step", "-1", "'raise'", "'substeps'"):
        assert fact in str(caught.value)


def test_a_new_task_names_the_schema_beside_it(tmp_path, monkeypatch, ran):
    shutil.copy(fmugym.bundled_fmu("Pendulum"), tmp_path / "model.fmu")
    monkeypatch.chdir(tmp_path)
    ran("new", "model.fmu", "--output", "task.toml")
    first, *_ = Path("task.toml").read_text().splitlines()
    schema = Path(first.removeprefix("#:schema "))
    assert not schema.is_absolute()
    assert schema.read_text() == (ROOT / "fmugym/task/task.schema.json").read_text()
    task = fmugym.Task.read("task.toml")
    Path("other").mkdir()
    task.write("copy.toml")
    task.write("other/copy.toml")
    assert Path("copy.toml").read_text().startswith(first)
    assert "#:schema" not in Path("other/copy.toml").read_text()
