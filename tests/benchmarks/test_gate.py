"""The speed gate runs every row, and fails beyond limits; what it measures is not asserted."""

import importlib
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
TREE = str(BENCHMARKS.parent)
QUICK = ("--python", sys.executable, "--rounds", "1", "--seconds", "0")


@pytest.fixture(name="gate")
def fixture_gate(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("gate")


def table_in(text):
    lines = [line.strip("| ").split("|") for line in text.splitlines() if line.startswith("|")]
    return {cells[0].strip(): [cell.strip() for cell in cells[1:]] for cells in lines[2:]}


@pytest.fixture(name="stubbed")
def fixture_stubbed(gate, monkeypatch, tmp_path):
    """The gate with players whose processor times are given; the other tree is a folder."""
    (tmp_path / "fmugym").mkdir()
    monkeypatch.setattr(gate, "PASSES", 2)
    played = []

    class Player:
        times = {"this": [1.0], "other": [1.0]}  # noqa: RUF012
        missing = ()

        def __init__(self, tree, python):
            self.side = "this" if str(tree) == TREE else "other"
            self.turns = 0

        def open(self, name):
            if (self.side, name) in self.missing:
                raise gate.CannotRunError("no such thing")
            self.name = name

        def turn(self, repeats):
            self.turns += 1
            played.append((self.side, self.name))
            times = self.times[self.side]
            return repeats * times[min(self.turns, len(times)) - 1]

        def close(self):
            pass

        def end(self):
            pass

    monkeypatch.setattr(gate, "Player", Player)

    def run(*arguments):
        only = () if "--only" in arguments else ("--only", "pool/*")
        return gate.main([str(tmp_path), "--rounds", "2", *only, *arguments])

    return run, Player, played


class TestExit:
    def test_is_zero_without_limits(self, stubbed):
        run, player, _ = stubbed
        player.times = {"this": [2.0], "other": [1.0]}
        assert run() == 0

    @pytest.mark.parametrize(("limit", "status"), [("2.0", 0), ("1.99", 1)])
    def test_follows_the_limit(self, stubbed, limit, status):
        run, player, _ = stubbed
        player.times = {"this": [2.0], "other": [1.0]}
        assert run("--limit", limit) == status

    def test_is_zero_where_the_other_tree_is_slower(self, stubbed):
        run, player, _ = stubbed
        player.times = {"this": [1.0], "other": [2.0]}
        assert run("--limit", "0.5") == 0

    def test_names_the_rows_beyond_the_limit(self, stubbed, capsys):
        run, player, _ = stubbed
        player.times = {"this": [1.25], "other": [1.0]}
        assert run("--limit", "1.25", "--limit", "*/64=1.1") == 1
        *_, verdict = capsys.readouterr().out.strip().splitlines()
        assert "pool/64" in verdict
        assert "1.250" in verdict

    def test_the_last_limit_that_matches_holds(self, stubbed):
        run, player, _ = stubbed
        player.times = {"this": [1.25], "other": [1.0]}
        assert run("--limit", "*/64=1.1", "--limit", "1.25") == 0

    def test_a_row_that_cannot_run_counts_unless_allowed(self, stubbed, capsys):
        run, player, _ = stubbed
        player.missing = {("other", "pool/8")}
        assert run() == 1
        assert "pool/8 cannot run" in capsys.readouterr().out
        assert run("--allow-missing", "pool/8") == 0
        assert run("--allow-missing", "pool/64") == 1

    def test_a_row_that_cannot_run_here_counts(self, stubbed):
        run, player, _ = stubbed
        player.missing = {("this", "pool/8")}
        assert run() == 1


class TestTurns:
    def test_the_least_time_of_all_passes_counts(self, stubbed):
        run, player, _ = stubbed
        player.times = {"this": [9.0] * 15 + [1.0], "other": [1.0]}
        assert run("--limit", "1.0", "--only", "pool/8") == 0

    def test_are_taken_alternately(self, stubbed):
        run, _, played = stubbed
        run()
        others = [index for index, (side, _) in enumerate(played) if side == "other"]
        assert all(
            {side for side, _ in played[index - 1 : index + 2]} == {"this", "other"}
            for index in others
        )
        assert others

    def test_this_tree_against_itself_comes_first(self, stubbed, capsys):
        run, player, played = stubbed
        player.times = {"this": [1.0], "other": [1.5]}
        run()
        assert "other" not in {side for side, _ in played[: len(played) // 3]}
        trust, _, table = capsys.readouterr().out.partition("\n\n")
        assert "itself, 4 rows" in trust
        assert "all within 0.0 %" in trust
        assert [cells[2:4] for cells in table_in(table).values()] == [["0.67", "1.00"]] * 4


@pytest.mark.parametrize(
    "arguments",
    [
        ("--only", "poool/*"),
        ("--limit", "poool/*=1.1"),
        ("--limit", "fast"),
        ("--allow-missing", "poool/8"),
        ("--rounds", "0"),
    ],
)
def test_what_matches_nothing_is_refused(stubbed, capsys, arguments):
    run, _, played = stubbed
    with pytest.raises(SystemExit) as ended:
        run(*arguments)
    assert ended.value.code == 2
    assert arguments[0].strip("-") in (message := capsys.readouterr().err) or "pool/8" in message
    assert played == []


def test_a_folder_without_the_package_is_refused(gate, tmp_path):
    with pytest.raises(SystemExit) as ended:
        gate.main([str(tmp_path)])
    assert ended.value.code == 2


def test_every_row_runs_in_this_tree(gate):
    for name, make in gate.ROWS.items():
        with ExitStack() as stack:
            workload = make(stack)
            for _ in range(2):
                workload.start()
                workload.block()
        assert name.count("/")


def test_rows_are_those_that_decide(gate):
    sizes = ("1", "8", "64", "1024")
    for task in ("cart-pole", "house", "tracking"):
        for way in ("expressions", "arrays"):
            assert {f"{task}/{way}/{size}" for size in sizes} <= gate.ROWS.keys()
    for kind in ("pool", "workers", "warm-up", "masked-resets", "rollouts", "one-hook"):
        assert {f"{kind}/{size}" for size in sizes} <= gate.ROWS.keys()


def test_trees_are_compared_by_their_processes(gate, capsys, monkeypatch):
    monkeypatch.setattr(gate, "PASSES", 1)
    only = ("--only", "single/cart-pole", "--only", "pool/8", "--limit", "1e9")
    assert gate.main([TREE, *QUICK, *only, "--limit", "pool/8=0"]) == 1
    text = capsys.readouterr().out
    assert all(all(cells) for cells in table_in(text).values())
    assert list(table_in(text)) == ["pool/8", "single/cart-pole"]
    assert [line.split()[0] for line in text.splitlines() if "at most" in line] == ["pool/8"]


def test_another_package_of_the_same_name_is_no_tree(gate, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(gate, "PASSES", 1)
    (tmp_path / "fmugym").mkdir()
    (tmp_path / "fmugym" / "__init__.py").touch()
    assert gate.main([str(tmp_path), *QUICK, "--only", "pool/8"]) == 1
    assert "FMI2CSEnv" in capsys.readouterr().out


def test_a_process_that_ends_is_replaced(gate, tmp_path):
    (tmp_path / "fmugym").mkdir()
    (tmp_path / "fmugym" / "__init__.py").write_text("import os\nos._exit(3)\n")
    player = gate.Player(tmp_path, Path(sys.executable))
    for _ in range(2):
        with pytest.raises(gate.CannotRunError, match="status 3"):
            player.open("pool/8")
    player.end()


def test_the_time_of_workers_counts(gate):
    player = gate.Player(Path(TREE), Path(sys.executable))
    player.open("workers/64")
    children = (Path("/proc") / str(player._process.pid) / "task").glob("*/children")
    workers = {int(child) for path in children for child in path.read_text().split()}
    own = importlib.import_module("gate_player").descendants(player._process.pid)
    assert workers <= set(own)
    assert workers
    player.close()
    player.end()
