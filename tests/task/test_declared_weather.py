"""Weather of EnergyPlus and tables of Modelica as data of declared tasks.

The files are written here, after the format's data dictionary; the values that come out are closed
forms.
"""

import datetime
import math

import numpy as np
import pytest
from combinations import in_turn
from test_declared_features import AT_REST, BASE

import fmugym
from fmugym import TaskError
from fmugym.task import Task
from fmugym.task.series import read_data

HEAD = (
    "LOCATION,Somewhere,-,XXX,made up,000000,50.0,8.0,1.0,100.0",
    "DESIGN CONDITIONS,0",
    "TYPICAL/EXTREME PERIODS,0",
    "GROUND TEMPERATURES,0",
    "HOLIDAYS/DAYLIGHT SAVINGS,No,0,0,0",
    "COMMENTS 1,",
    "COMMENTS 2,",
    "DATA PERIODS,1,{per_hour},Data,Sunday, 1/ 1,12/31",
)
FIELDS = {  # by the number of the column: the name, a usual value, the code for a missing one
    7: ("Dry Bulb Temperature", "10.0", "99.9"),
    8: ("Dew Point Temperature", "5.0", "99.9"),
    9: ("Relative Humidity", "70", "999"),
    10: ("Atmospheric Station Pressure", "101325", "999999"),
    11: ("Extraterrestrial Horizontal Radiation", "100", "9999"),
    12: ("Extraterrestrial Direct Normal Radiation", "1400", "9999"),
    13: ("Horizontal Infrared Radiation Intensity", "300", "9999"),
    14: ("Global Horizontal Radiation", "100", "9999"),
    15: ("Direct Normal Radiation", "100", "9999"),
    16: ("Diffuse Horizontal Radiation", "50", "9999"),
    17: ("Global Horizontal Illuminance", "9000", "999900"),
    18: ("Direct Normal Illuminance", "9000", "999999"),
    19: ("Diffuse Horizontal Illuminance", "5000", "999999"),
    20: ("Zenith Luminance", "900", "9999"),
    21: ("Wind Direction", "180", "999"),
    22: ("Wind Speed", "3.5", "999"),
    23: ("Total Sky Cover", "10", "99"),
    24: ("Opaque Sky Cover", "5", "99"),
    25: ("Visibility", "777.7", "9999"),
    26: ("Ceiling Height", "77777", "99999"),
    27: ("Present Weather Observation", "9", None),
    28: ("Present Weather Codes", "999999999", None),
    29: ("Precipitable Water", "10", "999"),
    30: ("Aerosol Optical Depth", "0.0440", ".999"),
    31: ("Snow Depth", "0", "999"),
    32: ("Days Since Last Snowfall", "88", "99"),
    33: ("Albedo", "0.220", "999"),
    34: ("Liquid Precipitation Depth", "0.0", "999"),
    35: ("Liquid Precipitation Quantity", "1.0", "99"),
}
PRECEDING = (11, 12, 14, 15, 16, 17, 18, 19, 20)
YEAR = 365 * 86400.0


def days_of(year, first=(1, 1), count=None):
    """The days of a year, or some of them."""
    day = datetime.date(year, *first)
    count = count or (datetime.date(year + 1, 1, 1) - day).days
    return [day + datetime.timedelta(i) for i in range(count)]


def epw(path, days, columns, per_hour=1, head=HEAD, minute="60"):
    """Write weather; columns are given by their number, all others are constant."""
    usual = [value for _, value, _ in FIELDS.values()]
    lines = [line.format(per_hour=per_hour) for line in head]
    records = [(day, hour) for day in days for hour in range(1, 25) for _ in range(per_hour)]
    for i, (day, hour) in enumerate(records):
        own = [*usual]
        for number, values in columns.items():
            own[number - 7] = str(values[i])
        date = [day.year, day.month, day.day, hour, minute, "?9?9?9"]
        lines.append(",".join(map(str, [*date, *own])))
    path.write_bytes("\r\n".join([*lines, ""]).encode("latin-1"))
    return path


def read(path, column, **more):
    """The series of a column."""
    data = {"file": str(path), "column": column} | more
    return read_data(Task.from_dict({"data": {"T": data}}).root.child("data").child("T"))


def at(series, hours):
    """Its values at some hours of the year."""
    place = (np.asarray(hours, float) * 3600 - series.start) % series.period
    return np.interp(place, series.times, series.values)


@pytest.fixture
def day(tmp_path):
    """A day in which each column that counts has the number of its hour."""
    hours = {number: range(1, 25) for number in (7, 13, 22, *PRECEDING)}
    return epw(tmp_path / "day.epw", days_of(1999, count=1), hours)


class TestTime:
    @pytest.mark.parametrize("column", [7, 13, 22])
    def test_a_value_is_that_of_the_end_of_its_hour(self, day, column):
        linear, held = read(day, column), read(day, column, interpolation="previous")
        np.testing.assert_allclose(at(linear, [1, 1.5, 12.25, 24]), [1, 1.5, 12.25, 24])
        np.testing.assert_allclose(at(held, [1, 1.5, 12.25, 24]), [1, 1, 12, 24])
        assert linear.period == held.period == 86400

    @pytest.mark.parametrize("column", PRECEDING)
    def test_radiation_is_the_mean_of_the_hour_before(self, day, column):
        linear, held = read(day, column), read(day, column, interpolation="previous")
        np.testing.assert_allclose(at(held, [0.01, 0.99, 1.01, 23.99]), [1, 1, 2, 24])
        np.testing.assert_allclose(at(linear, [0.5, 1, 11.5, 23.5]), [1, 1.5, 12, 24])
        for series in (linear, held):
            middles = (np.arange(24 * 60) + 0.5) / 60
            assert at(series, middles).mean() == pytest.approx(np.arange(1, 25).mean())

    def test_records_of_a_quarter_of_an_hour(self, tmp_path):
        quarters = {7: np.arange(1, 97) / 4, 14: np.arange(96)}
        path = epw(tmp_path / "q.epw", days_of(1999, count=1), quarters, per_hour=4, minute="0")
        np.testing.assert_allclose(at(read(path, 7), [0.25, 1, 12.1]), [0.25, 1, 12.1])
        held = read(path, 14, interpolation="previous")
        np.testing.assert_allclose(at(held, [0.1, 0.3, 23.9]), [0, 1, 95])

    def test_daylight_saving_of_the_header_moves_nothing(self, tmp_path, day):
        head = [line.replace("No,0,0,0", "Yes,1/ 1,10/26,0") for line in HEAD]
        other = epw(tmp_path / "s.epw", days_of(1999, count=1), {7: range(1, 25)}, head=head)
        np.testing.assert_array_equal(read(other, 7).values, read(day, 7).values)
        np.testing.assert_array_equal(read(other, 7).times, read(day, 7).times)


class TestYears:
    """The value of an hour is its number in a year of 365 days."""

    def load(self, path, clock):
        data = {"T": {"file": str(path), "column": "Dry Bulb Temperature", "min": -1e4, "max": 1e4}}
        agent = {"actions": ["tau"], "observations": ["T", "q"]}
        task = {"data": data, "agent": agent, "time_step": 1800, "parameters": AT_REST}
        return fmugym.load(BASE | task | {"clock": clock})

    def hours_of(self, days):
        hours = ((day.replace(year=2001) - datetime.date(2001, 1, 1)).days * 24 for day in days)
        return [hour + i for hour in hours for i in range(1, 25)]

    @pytest.mark.parametrize(("clock", "hour"), [("03-01", 1416), ("07-15 12:00", 4692)])
    @pytest.mark.parametrize("leap", [False, True])
    def test_the_clock_finds_its_hour(self, tmp_path, leap, clock, hour):
        days = days_of(2024 if leap else 2023)
        own = [day for day in days if (day.month, day.day) != (2, 29)]
        values = iter(self.hours_of(own))
        hours = [next(values) if day in own else -9999 for day in days for _ in range(24)]
        path = epw(tmp_path / "year.epw", days, {7: np.array(hours) / 1000})
        assert len(path.read_bytes().splitlines()) == 8 + (8784 if leap else 8760)
        env = self.load(path, clock)
        seen = [env.reset(seed=0)[0][0], env.step([0.0])[0][0], env.step([0.0])[0][0]]
        env.close()
        np.testing.assert_allclose(seen, np.array([hour, hour + 0.5, hour + 1]) / 1000, rtol=1e-5)
        assert read(path, 7).period == YEAR

    def test_months_of_several_years(self, tmp_path):
        days = days_of(2023)
        years = {month: 2004 - month for month in range(1, 13)}  # each one before the last one
        typical = [day.replace(year=years[day.month]) for day in days]
        hours = np.array(self.hours_of(days)) / 1000
        path = epw(tmp_path / "typical.epw", typical, {7: hours})
        np.testing.assert_allclose(at(read(path, 7), [1, 5000, 8760]), [0.001, 5, 8.76])
        np.testing.assert_allclose(at(read(path, 7), [0.5]), [(8.76 + 0.001) / 2])  # midnight


class TestMissing:
    def test_lines_lead_across_a_code(self, tmp_path):
        coded = {n: (value, code) for n, (_, value, code) in FIELDS.items() if code}
        columns = {n: [value] * 48 for n, (value, _) in coded.items()}
        for number, (_, code) in coded.items():
            columns[number][5], columns[number][10:12] = code, [code, code]
            columns[number][47] = ""  # at the end, and blank
        path = epw(tmp_path / "gaps.epw", days_of(1999, count=2), columns)
        for number, (text, _) in coded.items():
            series, value = read(path, number), float(text)
            assert set(series.values) == {value}
            assert (series.limits, series.period) == ((value, value), 172800)

    def test_a_gap_in_a_slope(self, tmp_path):
        values = [*range(1, 10), 99.9, 99.9, *range(12, 25)]
        path = epw(tmp_path / "slope.epw", days_of(1999, count=1), {7: values})
        np.testing.assert_allclose(at(read(path, 7), [10, 10.5, 11]), [10, 10.5, 11])
        np.testing.assert_allclose(at(read(path, 7, interpolation="previous"), [10, 11.9]), 9)

    @pytest.mark.parametrize(("gap", "count"), [(range(20, 50), 30), (range(72), 72)])
    def test_more_than_a_day_is_an_error(self, tmp_path, gap, count):
        values = [9999 if i in gap else 0 for i in range(72)]
        path = epw(tmp_path / "hole.epw", days_of(1999, count=3), {15: values})
        with pytest.raises(TaskError, match=rf"data\.T.*{count} of 72 .*'Direct Normal Radiation'"):
            read(path, "Direct Normal Radiation")


class TestColumns:
    def test_names_are_those_of_the_data_dictionary(self, tmp_path):
        path = epw(tmp_path / "x.epw", days_of(1999, count=1), {})
        for number, (name, value, _) in FIELDS.items():
            np.testing.assert_array_equal(read(path, name).values, float(value))
            np.testing.assert_array_equal(read(path, number).values, float(value))

    def test_any_encoding_of_the_place(self, tmp_path):
        head = [line.replace("Somewhere", "S\xe3o Paulo \x85") for line in HEAD]
        path = epw(tmp_path / "x.epw", days_of(1999, count=1), {}, head=head)
        assert at(read(path, 7), 3) == 10

    def test_numbers_of_columns_of_other_files(self, tmp_path):
        (tmp_path / "x.csv").write_text("time,T\n0,3\n1,4\n", encoding="utf-8")
        np.testing.assert_array_equal(read(tmp_path / "x.csv", 2).values[:2], [3, 4])

    @pytest.mark.parametrize(
        ("column", "fact"),
        [
            ("Dry bulb temperature", "'Dry Bulb Temperature'"),
            (0, "from 1 to 36, got 0"),
            (37, "from 1 to 36, got 37"),
            (True, "got True"),
            (6, "24 of 24"),
        ],
    )
    def test_mistakes_are_explained(self, tmp_path, column, fact):
        path = epw(tmp_path / "x.epw", days_of(1999, count=1), {})
        with pytest.raises(TaskError, match=rf"^data\.T\.column.*{fact}"):
            read(path, column)

    @pytest.mark.parametrize(
        ("old", "new", "fact"),
        [
            ("DATA PERIODS", "DATA", "'DATA PERIODS"),
            ("DATA PERIODS,1,1", "DATA PERIODS,1,0", "'DATA PERIODS"),
            (",10.0,5.0,", ",warm,5.0,", "'warm'"),
            ("1999,1,1,24,", "1999,1,1,0,", "hours from 1 to 24, got 0"),
            ("1999,1,1,24,", "1999,13,1,24,", "month"),
            ("1999,1,1,24,", "1999,1,1,24", "35 cells"),
            ("1999,1,1,24,", "1999,1,1,22,", "times must rise"),
        ],
    )
    def test_damage_is_explained(self, tmp_path, old, new, fact):
        path = epw(tmp_path / "x.epw", days_of(1999, count=1), {})
        path.write_text(path.read_text().replace(old, new))
        with pytest.raises(TaskError, match=rf"data\.T.*{fact}"):
            read(path, 7)


def test_a_year_is_what_pvlib_reads(tmp_path):
    """Another reader of the format; its times are the beginnings of the hours."""
    pvlib = pytest.importorskip("pvlib", reason="needs pvlib: the extra test")
    numbers = np.random.default_rng(0)
    columns = {number: numbers.uniform(0, 50, 8760).round(1) for number in FIELDS}
    columns[30] /= 100
    path = epw(tmp_path / "year.epw", days_of(2023), columns)
    frame, _ = pvlib.iotools.read_epw(path, coerce_year=2023)
    begins = (frame.index - frame.index[0]).total_seconds().to_numpy() / 3600
    names = {7: "temp_air", 10: "atmospheric_pressure", 13: "ghi_infrared", 14: "ghi"}
    names |= {15: "dni", 16: "dhi", 20: "zenith_luminance", 22: "wind_speed", 33: "albedo"}
    for number, name in names.items():
        held = read(path, number, interpolation="previous")
        place = begins + (0.5 if number in PRECEDING else 1.0)
        np.testing.assert_array_equal(at(held, place), frame[name], err_msg=name)


TABLES = """#1
# two tables
double prices(4,2)   # EUR/kWh
0 0.2
3600,\t0.2
3600; 0.3   # from one o'clock on
7200 0.4

float tab1(3, 3)  what it is
0 1 10
1 3 30 2 5
50
"""


class TestModelica:
    @pytest.fixture
    def tables(self, tmp_path):
        (tmp_path / "tables.txt").write_text(TABLES)
        return tmp_path / "tables.txt"

    def test_columns_by_number(self, tables):
        second, third = read(tables, 2, table="tab1"), read(tables, "3", table="tab1")
        seconds = np.array([0, 0.5, 1, 1.5, 1.99])
        expected = np.interp(seconds, [0, 1, 2], [1, 3, 5])
        np.testing.assert_allclose(at(second, seconds / 3600), expected)
        np.testing.assert_allclose(at(third, seconds / 3600), 10 * expected)

    def test_it_repeats_from_its_first_to_its_last_row(self, tables):
        series = read(tables, 2, table="tab1")
        assert series.period == 2
        np.testing.assert_allclose(at(series, np.array([2, 2.5, 7]) / 3600), [1, 2, 3])

    def test_two_rows_of_one_time_are_a_jump(self, tables):
        series = read(tables, 2, table="prices")
        np.testing.assert_allclose(at(series, [0.5, 0.99, 1, 1.5, 2]), [0.2, 0.2, 0.3, 0.35, 0.2])
        held = read(tables, 2, table="prices", interpolation="previous")
        np.testing.assert_allclose(at(held, [0.5, 0.99, 1, 1.9, 2]), [0.2, 0.2, 0.3, 0.3, 0.2])

    def test_a_period_of_its_own(self, tables):
        assert read(tables, 2, table="tab1", period=5).period == 5

    def test_the_table_of_a_file_with_one(self, tmp_path):
        (tmp_path / "one.mos").write_text("#1\ndouble a(2,2)\n0 1\n10 2\n")
        np.testing.assert_allclose(at(read(tmp_path / "one.mos", 2), 5 / 3600), 1.5)

    @pytest.mark.parametrize(
        ("text", "more", "fact"),
        [
            (TABLES, {}, "'prices', 'tab1'"),
            (TABLES, {"table": "tab2"}, "'tab2'.*'tab1'"),
            (TABLES, {"table": "tab1", "column": 4}, "from 1 to 3, got 4"),
            (TABLES.replace("50", ""), {"table": "tab1"}, "'tab1' of x.txt.* 8 .*3, ?3"),
            (TABLES.replace("50", "fifty"), {"table": "tab1"}, "fifty"),
            (TABLES.replace("7200", "60"), {"table": "prices"}, "60 s"),
            ("#1\ndouble a(0,2)\n", {}, "no table"),
            ("#1\ndouble a(999999999,999999999)\n1\n", {}, "'a'"),
            ("#1\n1 2\n", {}, "no table"),
        ],
    )
    def test_mistakes_are_explained(self, tmp_path, text, more, fact):
        (tmp_path / "x.txt").write_text(text)
        with pytest.raises(TaskError, match=rf"data\.T.*{fact}"):
            read(tmp_path / "x.txt", **({"column": 2} | more))

    def test_rows_of_cells_may_end_with_txt_too(self, tmp_path):
        (tmp_path / "x.txt").write_text("time;T\n0;1\n10;2\n")
        assert at(read(tmp_path / "x.txt", "T"), 5 / 3600) == 1.5


class TestWeatherInModelica:
    """Tables of the Buildings library: the fields of an EPW file after the time."""

    def write(self, path, rows):
        head = [f"double tab1({len(rows)},30)", *(f"#{line}" for line in HEAD), "#C1 Time"]
        text = "\n".join(["#1", *head, *("\t".join(map(str, row)) for row in rows), ""])
        path.write_text(text)
        return path

    @pytest.fixture(params=[0, 1])
    def both(self, request, tmp_path):
        """Two days of weather, and the same as a table that begins at midnight."""
        numbers = np.random.default_rng(3)
        columns = {n: numbers.uniform(0, 40, 48).round(1) for n in (7, 13, 14, 15, 22, 33)}
        columns[7][30] = 99.9
        usual = [value for _, value, _ in FIELDS.values()]
        rows = []
        for i in range(48):
            own = [*usual]
            for number, values in columns.items():
                own[number - 7] = values[i]
            rows.append([(i + 1) * 3600.0, *own])
        ends = [[0.0, *rows[-1][1:]], *(rows if request.param else rows[:-1])]
        table = self.write(tmp_path / "weather.mos", ends)
        return epw(tmp_path / "weather.epw", days_of(1999, count=2), columns), table

    @in_turn({"number": [7, 13, 14, 15, 22, 33], "interpolation": ["linear", "previous"]})
    def test_it_is_the_same_weather(self, both, number, interpolation):
        name, (weather, table) = FIELDS[number][0], both
        hours = np.linspace(0, 96, 4 * 97)[1:] - 0.01
        one = read(weather, name, interpolation=interpolation)
        for column in (name, number - 5):
            other = read(table, column, interpolation=interpolation)
            assert other.period == one.period == 2 * 86400
            np.testing.assert_allclose(at(other, hours), at(one, hours), rtol=1e-4, atol=1e-6)

    def test_the_wind_turns_beyond_a_circle(self, tmp_path):
        """Such tables have 370 degrees after 350, so that lines take the short way."""
        usual = [value for _, value, _ in FIELDS.values()]
        rows = [[i * 3600.0, *usual] for i in range(48)]
        for i, row in enumerate(rows):
            row[15] = 38000 + 10 * i
        path = self.write(tmp_path / "weather.mos", rows)
        np.testing.assert_allclose(at(read(path, "Wind Direction"), [0, 30.5]), [38000, 38305])

    def test_thirty_columns_of_something_else(self, tmp_path):
        rows = "\n".join(" ".join(map(str, [t, *range(2, 31)])) for t in (0, 100, 200))
        (tmp_path / "x.mos").write_text(f"#1\ndouble a(3,30)\n{rows}\n")
        series = read(tmp_path / "x.mos", 7)
        assert series.period == 200
        assert math.isclose(at(series, 0), 7)
