"""Cells of tables: numbers, decimal commas, columns of one name, and gaps."""

import numpy as np
import pytest
from test_declared_weather import at, days_of, epw

from fmugym import ConfigError, TaskError
from fmugym.errors import shown
from fmugym.task import Task
from fmugym.task.series import read_data


def series(folder, text=None, name="x.csv", **data):
    """The series of a column of a file with this text."""
    if text is not None:
        (folder / name).write_text(text, encoding="utf-8")
    given = {"file": str(folder / name), "column": "p"} | data
    return read_data(Task.from_dict({"data": {"p": given}}).root.child("data").child("p"))


def rows(cells, separator=",", step=1.0):
    lines = (f"{step * number:g}{separator}{cell}" for number, cell in enumerate(cells))
    return "\n".join([f"time{separator}p", *lines, ""])


class TestNumbers:
    @pytest.mark.parametrize(
        ("cell", "value"),
        [
            ("1e5 ", 1e5),
            ("+1", 1.0),
            (" -2.5E-3", -2.5e-3),
            (".5", 0.5),
            ("7.", 7.0),
            ("1e-320", 1e-320),
        ],
    )
    def test_decimal_numbers(self, tmp_path, cell, value):
        assert series(tmp_path, rows(["0", cell])).values[1] == value

    @pytest.mark.parametrize(
        "cell",
        [
            *(
                "1_000",
                "\u0661\u0662",
                "\uff11\uff12",
                "\u22125",
                "0x1F",
                "inf",
                "-Infinity",
                "1e400",
                "1 000",
                "1'000",
                "1d5",
            ),
            *("NA", "n/a", "-", "1,5", "true", "\u00a05", "\u00b2"),
        ],
    )
    @pytest.mark.parametrize("others", [["1", "2"], ["", "2"]])
    def test_anything_else_is_refused(self, tmp_path, cell, others):
        place = r"data\.p\.column: x\.csv, row 4, column 'p'"
        with pytest.raises(TaskError, match=place) as caught:
            series(tmp_path, rows([*others, f'"{cell}"', "3"]))
        assert shown(cell) in str(caught.value)

    @pytest.mark.parametrize("cell", ["", "  ", "nan", "NaN"])
    def test_an_empty_cell_is_a_gap(self, tmp_path, cell):
        found = series(tmp_path, rows(["1", cell, "3", "5"]))
        np.testing.assert_array_equal(found.times, [0, 2, 3, 4])
        assert at(found, 1 / 3600) == 2
        held = series(tmp_path, rows(["1", cell, "3", "5"]), interpolation="previous")
        assert at(held, 1.5 / 3600) == 1

    def test_of_a_single_column_a_blank_line_is_a_cell(self, tmp_path):
        found = series(tmp_path, "p\n1\n\n3\n5\n\n", step=1)
        np.testing.assert_array_equal(found.times, [0, 2, 3, 4])

    def test_blank_lines_count_as_rows(self, tmp_path):
        with pytest.raises(TaskError, match="row 5, column 'p'"):
            series(tmp_path, "time,p\n0,1\n\n1,2\n2,x\n")

    @pytest.mark.parametrize("cell", ["1_0", "\u0661", "0x2", "", "inf"])
    def test_times_are_read_alike(self, tmp_path, cell):
        with pytest.raises(
            TaskError, match=r"data\.p\.time: x\.csv, row 4, column 'time': expected"
        ):
            series(tmp_path, f"time,p\n0,1\n1,2\n{cell},3\n")

    @pytest.mark.parametrize("cell", ["1_0", "\u0661", "0x2"])
    def test_weather_and_tables_of_modelica_are_read_alike(self, tmp_path, cell):
        (tmp_path / "x.mos").write_text(f"#1\ndouble a(2,2)\n0 1\n1 {cell}\n", encoding="utf-8")
        with pytest.raises(TaskError, match="row 2, column '2'"):
            series(tmp_path, name="x.mos", column=2)
        if cell.isascii():
            values = ["1"] * 24
            values[3] = cell
            epw(tmp_path / "x.epw", days_of(2023, count=1), {7: values})
            with pytest.raises(TaskError, match=r"x\.epw, row 12, column 'Dry Bulb Temperature'"):
                series(tmp_path, name="x.epw", column="Dry Bulb Temperature")

    def test_texts_of_parquet_are_read_alike(self, tmp_path):
        pyarrow = pytest.importorskip("pyarrow", reason="needs the extra parquet")
        parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra parquet")
        for cells, fact in ((["1", "1_0"], "'1_0'"), ([1.0, float("inf")], "inf")):
            table = pyarrow.table({"time": [0, 1], "p": cells})
            parquet.write_table(table, tmp_path / "x.parquet")
            with pytest.raises(TaskError, match=rf"x\.parquet, row 3, column 'p'.*{fact}"):
                series(tmp_path, name="x.parquet")
        table = pyarrow.table({"time": [0, 1, 2], "p": pyarrow.array(["1", None, "3"])})
        parquet.write_table(table, tmp_path / "x.parquet")
        np.testing.assert_array_equal(series(tmp_path, name="x.parquet").times, [0, 2, 3])


class TestDecimalCommas:
    @pytest.mark.parametrize("separator", [";", "\t"])
    def test_they_need_another_separator(self, tmp_path, separator):
        found = series(tmp_path, rows(["1,5", "-2,25e1", "3"], separator))
        np.testing.assert_array_equal(found.values[:3], [1.5, -22.5, 3])

    def test_times_may_have_them(self, tmp_path):
        found = series(tmp_path, "time;p\n0,0;1\n0,5;2\n1,0;3\n")
        np.testing.assert_array_equal(found.times, [0, 0.5, 1, 1.5])

    def test_one_column_may_have_points_and_another_one_commas(self, tmp_path):
        text = "time;p;q\n0;1,5;1.5\n1;2,5;2.5\n"
        assert (
            series(tmp_path, text).values[0] == series(tmp_path, text, column="q").values[0] == 1.5
        )

    @pytest.mark.parametrize("cells", [["1,5", "2.5"], ["1.000,5", "2"], ["1", "1,000.5"]])
    def test_a_column_with_both_is_refused(self, tmp_path, cells):
        with pytest.raises(TaskError, match=r"x\.csv, row \d, column 'p'.*point.*comma.*row \d"):
            series(tmp_path, rows(cells, ";"))

    @pytest.mark.parametrize("cell", ["1,234,567", "1,2,3"])
    def test_thousands_are_no_decimals(self, tmp_path, cell):
        with pytest.raises(TaskError, match="row 3, column 'p'"):
            series(tmp_path, rows(["1", cell], ";"))

    def test_between_commas_they_are_refused_with_a_hint(self, tmp_path):
        with pytest.raises(TaskError, match=r"row 2, column 'p'.*'1,5'.*';'"):
            series(tmp_path, rows(['"1,5"', "2"]))

    def test_a_separator_within_quotes_is_none(self, tmp_path):
        found = series(tmp_path, 'time,"p;q"\n0,1\n1,2\n', column="p;q")
        np.testing.assert_array_equal(found.values[:2], [1, 2])


class TestColumns:
    TEXT = "time,p,q,p\n0,1,5,3\n1,2,6,4\n"

    def test_a_name_that_is_not_unique_is_refused(self, tmp_path):
        with pytest.raises(TaskError, match=r"data\.p\.column: 2 columns are called 'p'.*2, 4"):
            series(tmp_path, self.TEXT)
        assert series(tmp_path, self.TEXT, column="q").values[0] == 5

    def test_its_number_tells_which_one(self, tmp_path):
        found = [series(tmp_path, self.TEXT, column=number).values[0] for number in (2, 4)]
        assert found == [1, 3]

    @pytest.mark.parametrize("names", ["time,time", "Time,time"])
    def test_times_too(self, tmp_path, names):
        with pytest.raises(TaskError, match=r"data\.p.*time"):
            series(tmp_path, f"{names},p\n0,5,1\n1,6,2\n")

    def test_of_parquet(self, tmp_path):
        pyarrow = pytest.importorskip("pyarrow", reason="needs the extra parquet")
        parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra parquet")
        columns = [pyarrow.array(one) for one in ([0, 1], [1.0, 2.0], [3.0, 4.0])]
        table = pyarrow.Table.from_arrays(columns, names=["time", "p", "p"])
        parquet.write_table(table, tmp_path / "x.parquet")
        with pytest.raises(TaskError, match="2 columns are called 'p'"):
            series(tmp_path, name="x.parquet")
        assert series(tmp_path, name="x.parquet", column=3).values[0] == 3


def hourly(left_out=(), empty=(), count=24 * 60):
    lines = (
        f"2023-{1 + day // 28:02d}-{1 + day % 28:02d} {hour:02d}:00,"
        f"{'' if 24 * day + hour in empty else 24 * day + hour}"
        for day in range(count // 24)
        for hour in range(24)
        if 24 * day + hour not in left_out
    )
    return "\n".join(["time,p", *lines, ""])


class TestGaps:
    """28 days of January, then 28 of February: 1,344 hours, three days of which are no gap."""

    DAYS = 24 * 28

    @pytest.mark.parametrize("kind", ["left_out", "empty"])
    def test_one_is_refused_with_rows_and_dates(self, tmp_path, kind):
        gap = {kind: range(100, 300)}
        with pytest.raises(TaskError, match=r"data\.p\.column") as caught:
            series(tmp_path, hourly(count=self.DAYS, **gap))
        facts = ["row 101 (2023-01-05 03:00)", "(2023-01-13 12:00)", "8.375 days", "2 hours", "'p'"]
        facts += ['gaps = "interpolate"', "row 302" if kind == "empty" else "row 102"]
        assert [fact for fact in facts if fact not in str(caught.value)] == []

    @pytest.mark.parametrize("gaps", ["interpolate", "201h"])
    @pytest.mark.parametrize("kind", ["left_out", "empty"])
    def test_a_key_allows_it(self, tmp_path, kind, gaps):
        found = series(tmp_path, hourly(count=self.DAYS, **{kind: range(100, 300)}), gaps=gaps)
        np.testing.assert_allclose(at(found, [99, 200.5, 300]), [99, 200.5, 300])
        assert found.period == 28 * 86400

    @pytest.mark.parametrize("gaps", ["200h", 199 * 3600])
    def test_a_shorter_time_does_not(self, tmp_path, gaps):
        with pytest.raises(TaskError, match=r"8\.375 days"):
            series(tmp_path, hourly(count=self.DAYS, empty=range(100, 300)), gaps=gaps)

    @pytest.mark.parametrize("gaps", ["interpolat", "-1h", 0, True])
    def test_the_key_is_checked(self, tmp_path, gaps):
        with pytest.raises(TaskError, match=r"data\.p\.gaps.*'6h', or 'interpolate'"):
            series(tmp_path, hourly(), gaps=gaps)

    @pytest.mark.parametrize("kind", ["left_out", "empty"])
    def test_twice_the_distance_is_allowed(self, tmp_path, kind):
        found = series(tmp_path, hourly(count=self.DAYS, **{kind: [100, 200]}))
        assert at(found, 100) == 100
        with pytest.raises(TaskError, match="3 hours"):
            series(tmp_path, hourly(count=self.DAYS, **{kind: [100, 101]}))

    def test_values_that_hold_have_no_gaps(self, tmp_path):
        text = hourly(count=self.DAYS, left_out=range(100, 300))
        held = series(tmp_path, text, interpolation="previous")
        assert at(held, 299) == 99
        with pytest.raises(TaskError, match=r"8\.375 days"):
            series(tmp_path, text, interpolation="previous", gaps="1d")

    def test_rows_at_uneven_times_have_no_gaps(self, tmp_path):
        times = np.cumsum(np.random.default_rng(0).uniform(1, 100, 200))
        text = "\n".join(["time,p", *(f"{t},{t}" for t in times), f"{times[-1] + 1e5},0"])
        assert len(series(tmp_path, text).times) == 202

    def test_a_column_with_a_value_in_every_fourth_row(self, tmp_path):
        empty = [hour for hour in range(self.DAYS) if hour % 4]
        found = series(tmp_path, hourly(count=self.DAYS, empty=empty))
        assert at(found, 6) == 6

    def test_a_gap_among_scattered_empty_cells(self, tmp_path):
        """The rows are regular, although less than nine of ten values are."""
        empty = {*range(0, self.DAYS, 6), *range(100, 110)}
        with pytest.raises(
            TaskError, match=r"120 of 672 values of 'p' of .* are missing.*11 hours"
        ):
            series(tmp_path, hourly(count=self.DAYS, empty=empty))

    def test_at_the_end_of_the_period(self, tmp_path):
        empty = {0, 1, *range(self.DAYS - 3, self.DAYS)}
        with pytest.raises(TaskError, match=r"row 670 .* row 4 .*6 hours"):
            series(tmp_path, hourly(count=self.DAYS, empty=empty))

    def test_the_end_of_a_given_period_is_none(self, tmp_path):
        found = series(tmp_path, "time,p\n" + "\n".join(f"{t},{t}" for t in range(18)), period=24)
        assert at(found, 20.5 / 3600) == 17 * 0.5

    def test_of_float_times(self, tmp_path):
        text = rows(range(50), step=0.1)
        assert len(series(tmp_path, text).times) == 51

    def test_steps_between_rows(self, tmp_path):
        cells = ["1", "2", "", "", "5", *"6789"]
        with pytest.raises(TaskError, match=r"row 3 \(1 s\) and row 6 \(4 s\)"):
            series(tmp_path, "\n".join(["p,q", *(f"{cell},0" for cell in cells)]), step=1)

    def test_of_weather_is_a_day(self, tmp_path):
        """Also where the rows are left out, not only their values."""
        days, column = days_of(1999, count=30), {7: [0.0] * 720}
        path = epw(tmp_path / "x.epw", days, column)
        lines = path.read_bytes().splitlines(keepends=True)
        for left_out, is_allowed in ((23, True), (24, False)):
            path.write_bytes(b"".join(lines[:108] + lines[108 + left_out :]))
            if is_allowed:
                assert len(series(tmp_path, name="x.epw", column=7).times) == 720 - left_out + 1
                continue
            with pytest.raises(
                TaskError, match=r"row 108 \(01-05 04:00\) and row 109 \(01-06 05:00\)"
            ):
                series(tmp_path, name="x.epw", column=7)
            assert series(tmp_path, name="x.epw", column=7, gaps="2d").period == 30 * 86400

    def test_of_lists_and_pandas(self):
        pd = pytest.importorskip("pandas", reason="needs the extra pandas")
        column = pd.Series(np.arange(48.0), pd.date_range("2023-01-01", periods=48, freq="h"))
        column[10:20] = None
        for given in (
            {"values": column},
            {"values": [*column[:10], *[None] * 10, *column[20:]], "step": 3600},
        ):
            task = Task.from_dict({"data": {"p": given}})
            with pytest.raises(TaskError, match=r"data\.p\.values: 10 of 48.*11 hours"):
                read_data(task.root.child("data").child("p"))
            task = Task.from_dict({"data": {"p": given | {"gaps": "11h"}}})
            assert at(read_data(task.root.child("data").child("p")), 15) == 15

    @pytest.mark.parametrize(
        "given",
        [
            lambda frame: frame["load"],
            lambda frame: frame[["load"]],
            lambda frame: frame,
            lambda frame: {"values": frame, "column": "load"},
            lambda frame: {"values": frame, "column": 2},
            lambda frame: {"values": frame["load"].to_numpy(), "times": frame.index},
            lambda frame: {"values": frame["load"].to_numpy(), "step": "1h"},
            lambda frame: {"values": frame["load"].reset_index(drop=True), "step": "1h"},
        ],
    )
    def test_columns_frames_and_arrays(self, given):
        pd = pytest.importorskip("pandas", reason="needs the extra pandas")
        hours = pd.date_range("2023-01-01", periods=48, freq="h")
        frame = pd.DataFrame({"price": 1.0, "load": np.arange(48.0) ** 2}, hours)
        task = Task.from_dict({"data": {"load": given(frame)}})
        read = read_data(task.root.child("data").child("load"))
        assert [at(read, hour) for hour in range(48)] == [hour**2 for hour in range(48)]

    @pytest.mark.parametrize(
        ("given", "text"),
        [
            (
                lambda frame: {"values": frame, "column": "lod"},
                "data.p: .*'lod'; did you mean 'load'",
            ),
            (
                lambda frame: {"values": frame, "column": 3},
                "data.p: column = 3, but the frame has 2",
            ),
            (lambda frame: frame, "data.p: the frame has the columns 'price', 'load'"),
            (lambda frame: frame["load"], "data.p: give either the 'step'"),
            (lambda frame: frame["load"].to_numpy(), "data.p: give either the 'step'"),
        ],
    )
    def test_columns_that_are_not_clear(self, given, text):
        pd = pytest.importorskip("pandas", reason="needs the extra pandas")
        frame = pd.DataFrame({"price": 1.0, "load": np.arange(48.0)})
        with pytest.raises(ConfigError, match=text):
            read_data(Task.from_dict({"data": {"p": given(frame)}}).root.child("data").child("p"))


class TestRising:
    @pytest.mark.parametrize("after", ["2023-10-28 23:00", "2022-10-29 02:00"])
    def test_the_message_has_row_date_and_column(self, tmp_path, after):
        text = f"when,p\n2023-10-29 00:00,1\n2023-10-29 01:00,2\n{after},3\n"
        with pytest.raises(TaskError) as caught:
            series(tmp_path, text, time="when")
        facts = ["data.p.time", "'when'", f"row 4 ({after})", "row 3 (2023-10-29 01:00)"]
        assert [fact for fact in facts if fact not in str(caught.value)] == []

    def test_seconds_are_told_in_full(self, tmp_path):
        with pytest.raises(
            TaskError, match=r"row 3 \(26013600\.5 s\) is not above row 2 \(26013601 s\)"
        ):
            series(tmp_path, "time,p\n26013601,1\n26013600.5,2\n")
