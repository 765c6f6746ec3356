"""The command line on data: what info says of files, and zones of logs."""

import json

import pytest

TASK = """
fmu = { bundled = "Pendulum" }
time_step = "1h"
clock = "03-01"
reward = "-p"
[data]
p = { file = "prices.csv", column = "p", interpolation = "previous", timezone = "Europe/Berlin" }
q = { file = "prices.csv", column = 3, gaps = "3h", timezone = "Europe/Berlin" }
[agent]
actions = ["tau"]
observations = ["p", "q", "q_dot"]
[variables]
tau = { min = -1, max = 1 }
"""


@pytest.fixture
def task(tmp_path):
    hours = [*range(3), *range(3, 24)]
    rows = [f"2024-10-27 {hour:02d}:00;{hour},5;{hour if hour != 9 else ''}" for hour in hours]
    rows.insert(3, "2024-10-27 02:00;2,75;2")
    (tmp_path / "prices.csv").write_text("\n".join(["time;p;q", *rows, ""]), encoding="utf-8")
    (tmp_path / "task.toml").write_text(TASK, encoding="utf-8")
    return tmp_path / "task.toml"


def test_info_says_once_how_a_file_was_read(ran, task):
    lines = ran("info", task).partition("\nData\n")[2].splitlines()
    assert [line for line in lines if "prices.csv:" in line] == lines[1:2]
    for fact in ("semicolons", "25 rows", "2024-10-27 23:00", "3600 s", "+01:00, +02:00", "Berlin"):
        assert fact in lines[1]
    assert lines[0].strip() == "standard time: +01:00 (the smallest offset in prices.csv)"
    assert "decimal commas" in lines[2]
    assert "1 values missing" in lines[3]
    assert "7200 s" in lines[3]


def test_info_as_json(ran, task):
    data = json.loads(ran("info", task, "--json"))["data"]
    assert data["standard_time"].startswith("+01:00")
    first, second = data["series"]
    assert (first["rows"], first["decimal_commas"], first["missing"]) == (25, True, 0)
    assert (second["column"], second["missing"], second["longest_gap"]) == ("q", 1, 7200)


def test_info_says_what_is_wrong_and_of_an_fmu_nothing(ran, task):
    task.write_text(TASK.replace("prices", "prises", 1), encoding="utf-8")
    out = ran("info", task)
    assert "unknown file 'prises.csv'; did you mean 'prices.csv'?" in out
    task.write_text(TASK.partition("[data]")[0] + TASK[TASK.index("[agent]") :], encoding="utf-8")
    assert "\nData" not in ran("info", task)


def test_a_log_of_local_time_needs_its_zone(refused, tmp_path):
    pytest.importorskip("minari", reason="needs Minari: the extra minari")
    task = tmp_path / "task.toml"
    task.write_text('timezone = "+01:00"' + TASK.partition("[data]")[0].replace("-p", "-q**2"))
    more = TASK[TASK.index("[agent]") :].replace('"p", "q", "q_dot"', '"q", "q_dot"')
    task.write_text(task.read_text() + more, encoding="utf-8")
    rows = [f"2024-10-27 0{hour}:00,0,0,0" for hour in (1, 2, 2, 3)]
    (tmp_path / "log.csv").write_text("\n".join(["time,q,q_dot,tau", *rows]), encoding="utf-8")
    command = "simulate", task, "--output", "minari:test/log-v0", "--log", tmp_path / "log.csv"
    err = refused(*command)
    assert "row 4 (2024-10-27 02:00)" in err
    assert "timezone" in err
    assert "'Europe/Berlin'" in refused(*command, "--timezone", "Europe/Berln")
    assert "--timezone is for datasets" in refused("simulate", task, "--timezone", "UTC")
