"""The benchmarks run and print their tables; what they measure is not asserted."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import fmugym

RUN = Path(__file__).parents[2] / "benchmarks" / "run.py"


def run(*arguments):
    command = [sys.executable, "-X", "utf8", RUN, "--quick", *arguments]
    output = {"capture_output": True, "text": True, "encoding": "utf-8"}
    return subprocess.run(command, timeout=120, **output)


@pytest.fixture(name="ended", scope="module")
def fixture_ended(tmp_path_factory):
    """Two sections in one run, with the figures written to a file."""
    path = tmp_path_factory.mktemp("benchmarks") / "figures.json"
    return run("--only", "single", "--only", "memory", "--json", path), path


def tables_in(text):
    """The cells of each line of a table that is not the rule, by their first one."""
    lines = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("|")]
    return {cells[0].strip(): [cell.strip() for cell in cells[1:]] for cells in lines}


def test_the_program_ends_well(ended):
    result, _ = ended
    assert (result.returncode, result.stderr) == (0, "")


@pytest.mark.parametrize(
    "row",
    [
        "fmugym CartPole-v0, gym.make",
        "fmugym CartPole-v0, bare class",
        "Gymnasium CartPole-v1, gym.make",
        "Gymnasium CartPole-v1, bare class",
        "FMPy's wrappers in a loop",
    ],
)
def test_every_configuration_has_a_row_with_all_figures(ended, row):
    cells = tables_in(ended[0].stdout)[row]
    assert len(cells) >= 4
    assert all(cells)


def test_tables_are_at_most_100_columns_wide(ended):
    assert max(map(len, ended[0].stdout.splitlines())) <= 100


def test_model_exchange_is_compared_with_fmpy():
    result = run("--only", "exchange")
    assert (result.returncode, result.stderr) == (0, "")
    rows = tables_in(result.stdout)
    assert rows["model exchange, FMPy's CVode in a loop"][1] == "1.00x"
    assert all(rows["model exchange, Rosenbrock"])


def test_systems_are_compared_with_their_fmus_and_with_fmpy():
    result = run("--only", "systems")
    assert (result.returncode, result.stderr) == (0, "")
    rows = tables_in(result.stdout)
    assert rows["the three FMUs, each in a pool of its own"][1] == "1.00x"
    assert rows["FMPy's container in a Python loop (Jacobi)"][4] == "1.00x"
    assert all(rows['a system, `"jacobi"`'])


def test_the_base_is_compared_with_itself(ended):
    assert tables_in(ended[0].stdout)["Gymnasium CartPole-v1, gym.make"][3] == "1.00x"


def test_figures_are_written_to_the_file(ended):
    sections = json.loads(ended[1].read_text(encoding="utf-8"))["sections"]
    assert list(sections) == ["single", "memory"]
    figures = sections["single"][0]["figures"]
    assert all(one["steps_per_s"] > 0 and one["of_gymnasium"] > 0 for one in figures)


def test_an_unknown_section_is_refused_with_the_names_of_those_there_are():
    result = run("--only", "singel")
    assert result.returncode == 2
    assert "heavy" in result.stderr


def test_heavy_steps_are_measured_on_an_fmu_made_for_it(temp_root):
    result = run("--only", "heavy")
    assert (result.returncode, result.stderr) == (0, "")
    assert {"10.0 us", "100 us", "1.00 ms"} <= tables_in(result.stdout).keys()
    assert list(temp_root.iterdir()) == []


def test_isolation_is_measured_with_its_faults_and_starts():
    result = run("--only", "isolation")
    assert (result.returncode, result.stderr) == (0, "")
    rows = tables_in(result.stdout)
    assert len(rows["1 cart-pole"]) == 4
    for what in ("hangs", "64 workers", "with the trial", "when it is known"):
        assert any(what in row for row in rows)


@pytest.fixture(name="tasks", scope="module")
def fixture_tasks():
    """The module of the tasks; modules of the benchmarks import each other by their names."""
    sys.path.insert(0, str(RUN.parent))
    try:
        yield importlib.import_module("tasks")
    finally:
        sys.path.remove(str(RUN.parent))


def leaves(observations):
    return (
        [v for _, v in sorted(observations.items())]
        if isinstance(observations, dict)
        else [observations]
    )


@pytest.mark.parametrize("index", range(7))
def test_a_task_by_hand_is_the_same_task(tasks, index):
    task = tasks.TASKS[index]
    envs = fmugym.FMUVectorEnv(task.make, 5, max_episode_steps=60)
    prototype = task.make()
    hand = task.by_hand(prototype, 5, 60)
    envs.action_space.seed(0)
    observations, infos = envs.reset(seed=0)
    drawn = {name: values for name, values in infos["drawn"].items() if name[0] != "_"}
    for one, other in zip(leaves(observations), leaves(hand.reset(drawn)), strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-5, atol=1e-6)
    alive = np.ones(5, bool)  # until the first episode ends: then both draw anew
    for _ in range(60):
        actions = envs.action_space.sample()
        one, other = envs.step(actions), hand.step(actions)
        for a, b in zip(leaves(one[0]), leaves(other[0]), strict=True):
            np.testing.assert_allclose(b[alive], a[alive], rtol=1e-4, atol=1e-4)
        for a, b in zip(one[1:4], other[1:4], strict=True):
            np.testing.assert_allclose(b[alive], a[alive], rtol=1e-4, atol=1e-4)
        alive &= ~(one[2] | one[3])
    assert not alive.any()
    for each in (envs, prototype, hand):
        each.close()


DOCUMENTS = {
    "readme": "docs/speed.md",
    "vector": "docs/vector.md",
    "hooks": "docs/vector.md",  # where rows of both tables have the same names
    "training": "docs/training.md",
    "planning": "docs/training.md",
}


@pytest.mark.parametrize("name", DOCUMENTS)
def test_tables_of_the_documentation_have_the_rows_that_stand_there(name):
    result = run("--table", name)
    assert (result.returncode, result.stderr) == (0, "")
    text = (RUN.parent.parent / DOCUMENTS[name]).read_text(encoding="utf-8")
    written, measured = tables_in(text), tables_in(result.stdout)
    rows = {"readme": 17, "vector": 5, "hooks": 2, "training": 2, "planning": 5}[
        name
    ]  # headers, too
    same = [key for key in measured if key in written and not key.startswith(":-")]
    assert len(same) == rows
    assert name != "training" or written["task"] == measured["task"]
