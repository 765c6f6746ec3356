"""Dates of data: zones, daylight saving time, leap years and years that begin in July.

The reference is pandas: what it says of the same rows is what the task reads at a time of its
clock, which has 365 days and one offset from UTC.
"""

import datetime
import zoneinfo
from itertools import product

import numpy as np
import pytest
from test_declared_features import AT_REST, BASE
from test_declared_weather import HEAD, at, days_of, epw

import fmugym
from fmugym import ConfigError, TaskError
from fmugym.task import Task
from fmugym.task.data_rows import standard_time
from fmugym.task.dates import moment_of_year, zone_of
from fmugym.task.series import read_data

pd = pytest.importorskip("pandas", reason="needs the extra pandas")

ZONES = "Europe/Berlin", "America/New_York", "Australia/Lord_Howe", "Europe/Dublin", "Asia/Kolkata"


def series_of(folder=None, timezone=None, **data):
    """The series of some data of a task, by name."""
    document = {"data": data} | ({"timezone": timezone} if timezone else {})
    root = Task.from_dict(document, folder).root
    offset = standard_time(root).offset
    return {name: read_data(one, offset) for name, one in root.child("data").items().items()}


def hours(begin="2023-01-01", end="2024-01-01", zone="Europe/Berlin", step="1h"):
    """A frame whose values are the seconds of its moments since the beginning of 2020, by 1e5."""
    index = pd.date_range(begin, end, freq=step, tz=zone, inclusive="left", name="time")
    begin = pd.Timestamp("2020-01-01", tz="UTC" if zone else None)
    since = (index.tz_convert("UTC") if zone else index) - begin
    return pd.DataFrame({"p": since.total_seconds().to_numpy() / 1e5}, index=index)


def require_read(series, frame, standard):
    """Compare a series with all rows of a frame, whose index has a zone."""
    moments = frame.index.tz_convert(zone_of("", standard))
    kept = frame["p"][(moments.month != 2) | (moments.day != 29)]
    moments = moments[(moments.month != 2) | (moments.day != 29)]
    within = moments.tz_localize(None)
    same = pd.to_datetime(within.strftime("2023-%m-%d %H:%M:%S"))
    seconds = (same - pd.Timestamp("2023-01-01")).total_seconds().to_numpy()
    assert len(kept) > 100
    np.testing.assert_allclose(at(series, seconds / 3600), kept.to_numpy(), rtol=1e-12)


def write(path, frame, **options):
    if path.suffix == ".parquet":
        pytest.importorskip("pyarrow", reason="needs the extra parquet")
        frame.to_parquet(path)
    else:
        frame.to_csv(path, **options)
    return {"file": str(path), "column": "p"}


class TestOffsets:
    @pytest.mark.parametrize("suffix", [".csv", ".parquet"])
    @pytest.mark.parametrize("zone", [*ZONES[:3], "UTC"])
    @pytest.mark.parametrize("begin", ["2023-01-01", "2023-07-01"])
    def test_the_smallest_offset_of_a_file_is_the_standard_time(
        self, tmp_path, suffix, zone, begin
    ):
        frame = hours(begin, "2024-01-01", zone)
        column = write(tmp_path / f"x{suffix}", frame)
        offset = min(moment.utcoffset() for moment in frame.index)
        series = series_of(p=column)["p"]
        require_read(series, frame, datetime.timezone(offset))

    @pytest.mark.parametrize("standard", ["+01:00", "+00:00", "-05:00", "+05:30", "Europe/Berlin"])
    def test_all_files_are_converted_to_the_key(self, tmp_path, standard):
        frames = {zone: hours(zone=zone) for zone in ("Europe/Berlin", "UTC", "America/New_York")}
        data = {
            zone.replace("/", "_"): write(tmp_path / f"{number}.csv", frame)
            for number, (zone, frame) in enumerate(frames.items())
        }
        fixed = "+01:00" if "/" in standard else standard
        for name, series in series_of(timezone=standard, **data).items():
            require_read(series, frames[name.replace("_", "/", 1)], fixed)

    @pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
    @pytest.mark.parametrize("zone", ["Europe/Berlin", "UTC", None])
    def test_any_resolution(self, tmp_path, unit, zone):
        frame = hours(zone=zone or "UTC")
        frame.index = frame.index.as_unit(unit)
        written = frame if zone else frame.tz_localize(None)
        column = write(tmp_path / "x.parquet", written)
        found = series_of(
            file=column,
            index={"values": written["p"].to_numpy(), "times": written.index},
            column={"values": written["p"]},
            numpy={"values": written["p"].to_numpy(), "times": written.index.to_numpy()},
        )
        assert len(found) == 4
        for series in found.values():
            require_read(series, frame, "+01:00" if zone == "Europe/Berlin" else "+00:00")

    def test_an_index_without_a_name(self, tmp_path):
        frame = hours()
        frame.index.name = None
        for suffix in (".csv", ".parquet"):
            series = series_of(p=write(tmp_path / f"x{suffix}", frame))["p"]
            require_read(series, frame, "+01:00")

    def test_files_that_differ_are_refused(self, tmp_path):
        data = {
            "one": write(tmp_path / "one.csv", hours()),
            "two": write(tmp_path / "two.csv", hours(zone="UTC")),
        }
        with pytest.raises(
            TaskError, match=r"one\.csv has \+01:00.*two\.csv has \+00:00.*timezone"
        ):
            series_of(**data)
        agent = {"actions": ["tau"], "observations": ["one", "two", "q"]}
        with pytest.raises(TaskError, match=r"timezone"):
            fmugym.load(BASE | {"data": data, "agent": agent})

    def test_offsets_that_no_daylight_saving_makes_are_refused(self, tmp_path):
        (tmp_path / "x.csv").write_text(
            "time,p\n2023-01-01T00:00+00:00,1\n2023-01-01T06:00+05:00,2\n", encoding="utf-8"
        )
        with pytest.raises(TaskError, match=r"x\.csv.*\+05:00.*timezone"):
            series_of(p={"file": str(tmp_path / "x.csv"), "column": "p"})

    @pytest.mark.parametrize("row", [2, 3])
    def test_rows_with_and_without_an_offset(self, tmp_path, row):
        rows = ["time,p", "2023-05-01 00:00+02:00,1", "2023-05-01 01:00,2"]
        rows += ["2023-05-01 02:00,3"]
        if row == 3:
            rows[1] = rows[1].replace("+02:00", "")
            rows[2] = rows[2].replace(",", "Z,")
        (tmp_path / "x.csv").write_text("\n".join(rows), encoding="utf-8")
        with pytest.raises(
            TaskError, match=r"x\.csv, row 3, column 'time'.*2023-05-01 01:00.*offset"
        ):
            series_of(p={"file": str(tmp_path / "x.csv"), "column": "p"})

    @pytest.mark.parametrize(
        "name", ["Europe/Berln", "Europe", "../x", "+25:00", "1", "", "+\u0661:\u0660\u0660"]
    )
    def test_an_unknown_zone_is_named(self, name):
        document = {"timezone": name, "data": {"p": {"values": [1], "step": 1, "timezone": name}}}
        with pytest.raises(TaskError) as caught:
            assert Task.from_dict(document).root
        assert len(str(caught.value).splitlines()) == 2
        assert "zone" in str(caught.value)
        if name == "Europe/Berln":
            assert "'Europe/Berlin'" in str(caught.value)

    def test_a_machine_without_zones_is_told_what_it_lacks(self, monkeypatch):
        monkeypatch.setattr(zoneinfo, "available_timezones", set)
        with pytest.raises(ConfigError, match="tzdata"):
            zone_of("timezone", "Europe/Nowhere")


class TestHeaders:
    """An EPW file tells its offset, here +01:00; data of other offsets are converted to it."""

    def weather(self, tmp_path, offset="1.0"):
        head = [line.replace(",1.0,", f",{offset},") for line in HEAD]
        path = epw(
            tmp_path / f"w{offset}.epw", days_of(2023), {7: np.arange(8760) / 1000}, head=head
        )
        return {"file": str(path), "column": "Dry Bulb Temperature"}

    def test_it_is_the_standard_time(self, tmp_path):
        frame = hours(zone="UTC")
        found = series_of(T=self.weather(tmp_path), p=write(tmp_path / "p.csv", frame))
        require_read(found["p"], frame, "+01:00")
        np.testing.assert_allclose(at(found["T"], [1, 5000, 8760]), [0, 4.999, 8.759])

    def test_weather_is_converted_to_the_key(self, tmp_path):
        found = series_of(timezone="+03:00", T=self.weather(tmp_path), U=self.weather(tmp_path, -2))
        np.testing.assert_allclose(at(found["T"], [3, 5002, 2]), [0, 4.999, 8.759])
        np.testing.assert_allclose(at(found["U"], [6, 5005, 5]), [0, 4.999, 8.759])

    def test_headers_that_differ_are_refused(self, tmp_path):
        with pytest.raises(
            TaskError, match=r"w1\.0\.epw has \+01:00.*w-2\.epw has -02:00.*timezone"
        ):
            series_of(T=self.weather(tmp_path), U=self.weather(tmp_path, -2))

    def test_tables_of_modelica_have_it_too(self, tmp_path):
        lines = ["#1", "double tab1(3,2)", "#LOCATION,-,-,-,-,-,50,8,1.0,100", "0 0", "3600 1"]
        (tmp_path / "x.mos").write_text("\n".join([*lines, "7200 2", ""]), encoding="utf-8")
        column = {"file": str(tmp_path / "x.mos"), "column": 2}
        assert at(series_of(T=column)["T"], 0.5) == 0.5
        shifted = series_of(timezone="+00:00", T=column)["T"]
        assert at(shifted, 1.5 - 1) == pytest.approx(1.5)


class TestOwnZone:
    def local(self, frame):
        return frame.tz_localize(None)

    @pytest.mark.parametrize(
        ("zone", "step"), [*product(ZONES, ["15min"]), ("Europe/Berlin", "1h")]
    )
    def test_dates_are_read_as_pandas_infers_them(self, tmp_path, zone, step):
        frame = hours("2023-01-01", "2025-01-01", zone, step)
        local = self.local(frame)
        again = local.index.tz_localize(zone, ambiguous="infer")
        assert (again == frame.index).all()
        standard = min(moment.utcoffset() for moment in frame.index)
        data = write(tmp_path / "x.csv", local) | {"timezone": zone}
        (series,) = series_of(p=data | {"interpolation": "previous"}).values()
        zone = datetime.timezone(standard)
        require_read(series, frame[frame.index.tz_convert(zone).year == 2023], zone)

    def test_a_missing_hour_does_not_exist(self, tmp_path):
        local = self.local(hours("2023-03-25", "2023-03-28", "UTC"))
        data = write(tmp_path / "x.csv", local) | {"timezone": "Europe/Berlin"}
        with pytest.raises(TaskError, match=r"x\.csv, row 28, .*'time': 2023-03-26 02:00 .*Berlin"):
            series_of(p=data)

    @pytest.mark.parametrize("rows", [slice(0, 30), slice(26, 60), slice(0, 27)])
    def test_a_doubled_hour_that_order_does_not_tell(self, tmp_path, rows):
        """Of pandas' own refusals: the hour comes once, and nobody knows which one it is."""
        local = self.local(hours("2023-10-28", "2023-10-31")).iloc[rows]
        local = local[~local.index.duplicated()]
        with pytest.raises(ValueError, match="no repeated times"):
            local.index.tz_localize("Europe/Berlin", ambiguous="infer")
        data = write(tmp_path / "x.csv", local) | {"timezone": "Europe/Berlin"}
        with pytest.raises(TaskError, match=r"x\.csv, row \d+, .*2023-10-29 02:00 comes twice"):
            series_of(p=data)

    @pytest.mark.parametrize("interpolation", ["linear", "previous"])
    @pytest.mark.parametrize("step", ["1h", "15min"])
    @pytest.mark.parametrize(
        ("zone", "begin", "end", "date"),
        [
            ("Europe/Berlin", "2023-03-20", "2023-04-20", "2023-03-26 03:00"),
            ("Europe/Berlin", "2023-10-20", "2023-11-20", "2023-10-29 02:00"),
            ("America/New_York", "2023-03-01", "2023-04-01", "2023-03-12 03:00"),
            ("America/New_York", "2023-10-20", "2023-11-20", "2023-11-05 01:00"),
            ("Australia/Sydney", "2023-09-20", "2023-10-20", "2023-10-01 03:00"),
        ],
    )
    def test_without_it_daylight_saving_is_refused(
        self, tmp_path, step, interpolation, zone, begin, end, date
    ):
        data = write(tmp_path / "x.csv", self.local(hours(begin, end, zone, step)))
        with pytest.raises(TaskError, match=rf"row \d+.*{date}.*timezone = \"Europe/Berlin\""):
            series_of(p=data | {"interpolation": interpolation})

    def test_an_offset_says_that_nothing_is_missing(self, tmp_path):
        local = self.local(hours("2023-03-20", "2023-04-20"))
        data = write(tmp_path / "x.csv", local) | {"timezone": "+01:00"}
        assert series_of(p=data)["p"].period == 31 * 86400

    def test_an_hour_may_be_missing_on_any_other_day(self, tmp_path):
        frame = hours("2023-06-01", "2023-07-01", "UTC")
        local = self.local(frame.drop(frame.index[100]))
        assert len(series_of(p=write(tmp_path / "x.csv", local))["p"].times) == 30 * 24

    def test_seconds_have_no_zone(self):
        data = {"values": [1, 2], "times": [0, 1], "timezone": "Europe/Berlin"}
        with pytest.raises(TaskError, match=r"data\.p\.timezone.*seconds"):
            series_of(p=data)


class TestLeapYears:
    def seen(self, column, clock):
        data = {"p": column | {"min": -1e6, "max": 1e6}}
        agent = {"actions": ["tau"], "observations": ["p", "q"]}
        task = {"data": data, "agent": agent, "time_step": 3600, "parameters": AT_REST}
        env = fmugym.load(BASE | task | {"clock": clock})
        found = [env.reset(seed=0)[0][0], env.step([0.0])[0][0]]
        env.close()
        return found

    @pytest.mark.parametrize("suffix", [".csv", ".parquet"])
    @pytest.mark.parametrize("has_leap_day", [True, False])
    @pytest.mark.parametrize("date", ["02-28 23:00", "03-01 00:00", "03-01 12:00", "12-31 23:00"])
    def test_the_clock_reads_its_date(self, tmp_path, suffix, has_leap_day, date):
        frame = hours("2024-01-01", "2025-01-01", None)
        if not has_leap_day:
            frame = frame[~((frame.index.month == 2) & (frame.index.day == 29))]
        column = write(tmp_path / f"x{suffix}", frame)
        after = pd.Timestamp(f"2024-{date}") + pd.Timedelta("1h")
        after = {"02-28": "2024-03-01", "12-31": "2024-01-01"}.get(date[:5], after)
        expected = frame["p"][[pd.Timestamp(f"2024-{date}"), pd.Timestamp(after)]]
        np.testing.assert_allclose(self.seen(column, date), expected, rtol=1e-6)
        assert series_of(p=column)["p"].period == 365 * 86400

    def test_a_day_after_conversion_counts(self, tmp_path):
        frame = hours("2024-02-28", "2024-03-03", "UTC")
        series = series_of(timezone="+02:00", p=write(tmp_path / "x.csv", frame))["p"]
        rows = frame.drop(frame.loc["2024-02-28 22:00":"2024-02-29 21:00"].index)
        assert len(rows) == 72
        assert series.period == 3 * 86400
        np.testing.assert_allclose(series.values[:-1], rows["p"].to_numpy())

    @pytest.mark.parametrize("year", [2023, 2024])
    @pytest.mark.parametrize("kind", ["csv", "epw"])
    def test_a_year_from_july_to_june(self, tmp_path, kind, year):
        days = days_of(year - 1, (7, 1), 184) + days_of(year, count=days_in_half(year))
        begins = [pd.Timestamp(day) + pd.Timedelta(hours=k + 1) for day in days for k in range(24)]
        numbers = np.arange(len(begins)) / 1000
        if kind == "epw":
            path = epw(tmp_path / "x.epw", days, {7: numbers})
            column = {"file": str(path), "column": "Dry Bulb Temperature"}
        else:
            frame = pd.DataFrame({"p": numbers}, index=pd.DatetimeIndex(begins, name="time"))
            column = write(tmp_path / "x.csv", frame)
        series = series_of(p=column)["p"]
        assert series.period == 365 * 86400
        found = dict(zip(begins, numbers, strict=True))
        for date in (f"{year - 1}-07-15 12:00", f"{year}-01-15 12:00", f"{year}-06-30 23:00"):
            moment = moment_of_year(datetime.datetime.fromisoformat(date)) / 3600
            assert at(series, moment) == pytest.approx(found[pd.Timestamp(date)])
        np.testing.assert_allclose(
            self.seen(column, "12-31 23:00"),
            [found[pd.Timestamp(f"{year - 1}-12-31 23:00")], found[pd.Timestamp(f"{year}-01-01")]],
            rtol=1e-6,
        )

    @pytest.mark.parametrize(
        ("begin", "end", "dates"),
        [
            (
                "2022-11-01",
                "2023-03-01",
                ["2022-11-01 06:00", "2022-12-31 23:00", "2023-01-15 12:00"],
            ),
            (
                "2022-07-01",
                "2024-01-01",
                ["2023-01-15 12:00", "2023-06-30 12:00", "2023-07-01 06:00"],
            ),
            ("2022-01-01", "2023-02-01", ["2022-01-15 12:00", "2022-12-31 23:00"]),
            (
                "2021-07-01",
                "2023-07-01",
                ["2022-01-15 12:00", "2022-12-31 12:00", "2022-07-01 06:00"],
            ),
        ],
    )
    def test_rows_beyond_the_year(self, tmp_path, begin, end, dates):
        """Each time of the clock reads a row of its date, wherever the file begins."""
        frame = hours(begin, end, None)
        series = series_of(p=write(tmp_path / "x.csv", frame))["p"]
        for date in dates:
            moment = moment_of_year(datetime.datetime.fromisoformat(date)) / 3600
            assert at(series, moment) == pytest.approx(frame["p"][pd.Timestamp(date)])

    def test_a_short_file_over_the_turn_of_the_year_repeats(self, tmp_path):
        frame = hours("2022-12-29", "2023-01-04", None)
        series = series_of(p=write(tmp_path / "x.csv", frame))["p"]
        assert series.period == 365 * 86400
        assert at(series, 2 * 24) == pytest.approx(frame["p"][pd.Timestamp("2023-01-03")])
        for repetition in (0, 7):
            assert at(series, (3 + 6 * repetition) * 24) == pytest.approx(frame["p"].iloc[0])

    def test_moments_of_a_year(self):
        for year in (2023, 2024):
            moments = [datetime.datetime(year, month, 1, 6, 30, 15) for month in range(1, 13)]
            expected = [(one.replace(year=2023) - datetime.datetime(2023, 1, 1)) for one in moments]
            assert [*map(moment_of_year, moments)] == [one.total_seconds() for one in expected]
        leap = datetime.datetime(2024, 2, 29, 12)
        assert moment_of_year(leap) == moment_of_year(datetime.datetime(2024, 2, 28, 12))

    @pytest.mark.parametrize(
        ("clock", "fact"),
        [
            ("2024-01-15T06:00:00+01:00", "offset"),
            ("2024-02-29T06:00:00", "365 days"),
            ("2024-02-29", "365 days"),
        ],
    )
    def test_a_clock_that_does_not_exist(self, clock, fact):
        given = datetime.datetime.fromisoformat(clock)
        with pytest.raises(TaskError, match=fact):
            assert Task.from_dict({"clock": given if "T" in clock else given.date()}).root

    def test_a_clock_with_seconds(self):
        given = datetime.datetime(2024, 3, 1, 6, 0, 30)
        root = Task.from_dict({"clock": given}).root
        assert root.child("clock").value == 59 * 86400 + 6 * 3600 + 30


def days_in_half(year):
    return (datetime.date(year, 7, 1) - datetime.date(year, 1, 1)).days
