"""Fits to logs of plants: what is in the log is found, and what is not is said."""

import json
import tomllib
from contextlib import contextmanager
from functools import partial

import fit_coverage
import gymnasium as gym
import numpy as np
import pytest
from fit_coverage import fitted, house_log
from letters import GREEK, MICRO, wide, with_names, with_wide_names
from test_identification import TRUE, swing

import fmugym
from fmugym import ConfigError
from fmugym.environment.distributions import DrawnColumn, Normal, draw_all
from fmugym.records.log_fit import fit_logs, write_rows
from fmugym.records.plant_log import PlantLog

TASK = """
fmu = { bundled = "Pendulum" }
time_step = 0.02
reward = "-angle ** 2"
episode_length = 1
parameters = { c = 0 }

[variables]
angle = { name = "q", unit = "deg" }
first = { name = "q_0", unit = "deg" }

[agent]
actions = ["tau"]
observations = ["angle"]
"""
START = "--start", "first=angle"
NAMES = "--parameter", "l=0.05..0.2", "--parameter", "b"


@pytest.fixture(name="task")
def fixture_task(tmp_path):
    path = tmp_path / "pendulum.toml"
    path.write_text(TASK)
    return path


def write_log(path, heading="time,angle [deg],tau", c=0.0, noise=0.2, edit=None):
    """A swing by SciPy's integrator, in degrees, with noise."""
    time, q, _ = swing(2.0, c, 3.0, 0.02)
    angle = np.degrees(q) + np.random.default_rng(0).normal(0.0, noise, len(q))
    rows = np.stack([time, angle, np.zeros(len(q))], axis=1)
    if edit is not None:
        rows = edit(rows)
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    path.write_text("\n".join([heading, *lines]) + "\n")
    return path


def drawn(env, seed):
    return env.reset(seed=seed)[1]["drawn"]


class TestPendulum:
    """A task in degrees, and a log that an integrator of SciPy has made."""

    def test_what_it_writes_is_a_task_that_draws_the_truth(self, ran, refused, task, tmp_path):
        log, output = write_log(tmp_path / "log.csv"), tmp_path / "fitted.toml"
        plot = tmp_path / "fit.svg"
        options = *NAMES, *START, "--output", output, "--plot", plot
        found = json.loads(ran("fit", task, "--log", log, *options, "--json"))
        for name in ("l", "b"):
            low, high = found["parameters"][name]["interval"]
            assert low < TRUE[name] < high
            assert high - low < 0.3 * TRUE[name]
        assert found["outputs"]["q"]["is_noise"]
        assert found["outputs"]["q"]["rms"] == pytest.approx(np.radians(0.2), rel=0.2)
        assert found["start_values"][0]["q_0"] == pytest.approx(2.0, abs=0.005)
        assert tomllib.loads(output.read_text()) == {
            "extends": "pendulum.toml",
            "fitted": "fitted.npz",
        }
        assert plot.stat().st_size > 5000
        with np.load(tmp_path / "fitted.npz") as file:
            rows = file["rows"]
        with fmugym.load(output) as env:
            values = drawn(env, 0)
            assert [values["l"], values["b"]] in rows.tolist()
        assert np.std(rows[:, 0]) == pytest.approx(
            found["parameters"]["l"]["standard_error"], rel=0.1
        )
        assert "exists" in refused("fit", task, "--log", log, *NAMES, "--output", output)

    def test_it_shows_how_far_it_is(self, ran, task, tmp_path, monkeypatch):
        counts = []
        shown = contextmanager(lambda total, what, unit: iter([counts.append]))
        monkeypatch.setattr("fmugym.cli.fit_command.progress_bar", shown)
        log = write_log(tmp_path / "log.csv")
        ran("fit", task, "--log", log, *NAMES, *START, "--candidates", 5)
        assert counts[0] == 1
        assert max(counts) == 4  # two parameters, a start, and none of them changed
        assert sum(counts) > 20

    def test_a_wrong_model_is_told(self, cli, task, tmp_path):
        """The friction of the plant is Coulomb's, the model's is viscous."""
        log = write_log(tmp_path / "log.csv", c=2e-3)
        code, out, err = cli("fit", task, "--log", log, *NAMES, *START)
        assert code == 0
        assert out.startswith("parameter")
        assert "residuals of q are no noise" in err
        code, _, err = cli("fit", task, "--log", log, *NAMES, *START, "--parameter", "c=0..0.01")
        assert code == 0
        assert "no noise" not in err

    def test_what_the_log_does_not_tell_is_told(self, cli, task, tmp_path):
        """A free swing tells g / l and b / (m l^2), and nothing of the torque's limit."""
        log = write_log(tmp_path / "log.csv")
        _, _, err = cli("fit", task, "--log", log, *NAMES, "--parameter", "g=5..20", *START)
        assert "the log does not tell l and b and g apart" in err
        _, _, err = cli("fit", task, "--log", log, *NAMES, "--parameter", "tau_max", *START)
        assert "the log does not tell tau_max" in err

    def test_columns_have_other_names_and_episodes_their_own_starts(self, ran, task, tmp_path):
        log = write_log(tmp_path / "log.csv", "time,pos [deg],tau")
        options = *NAMES, "--start", "q_0=q", "--column", "pos=angle"
        out = ran("fit", task, "--log", log, "--log", log, *options, "--json")
        first, second = json.loads(out)["start_values"]
        assert first == pytest.approx(second)

    @pytest.mark.parametrize(("own", "given"), [(MICRO, GREEK), (GREEK, MICRO)])
    def test_names_are_found_by_letters_that_look_the_same(self, ran, tmp_path, own, given):
        with_names(tmp_path, q=f"q{own}", q_0=f"q_0{own}", l=f"l{own}", tau=f"tau{own}")
        task = fmugym.Task.from_dict(
            tomllib.loads(TASK)
            | {
                "fmu": str(tmp_path / "model.fmu"),
                "reward": f"-angle{own} ** 2",
                "variables": {f"angle{own}": {"name": f"q{own}", "unit": "deg"}},
                "agent": {"actions": [f"tau{own}"], "observations": [f"angle{own}"]},
            }
        )
        task.write(tmp_path / "task.toml")
        log = write_log(tmp_path / "log.csv", f"time,pos{given} [deg],tau{given}")
        options = "--parameter", f"l{given}=0.05..0.2", "--start", f"q_0{given}=angle{given}"
        renaming = "--column", f"pos{own}=angle{given}"
        file = tmp_path / "task.toml"
        found = json.loads(ran("fit", file, "--log", log, *options, *renaming, "--json"))
        low, high = found["parameters"][f"l{own}"]["interval"]
        assert low < TRUE["l"] < high
        assert found["start_values"][0][f"q_0{own}"] == pytest.approx(2.0, abs=0.005)

    def test_an_episode_ends_where_nothing_was_measured(self, ran, task, tmp_path):
        def with_a_gap(rows):
            return np.where(np.arange(len(rows))[:, None] == 20, [1.0, np.nan, 1.0] * rows, rows)

        found = []
        for number, edit in enumerate((None, with_a_gap)):
            log = write_log(tmp_path / f"{number}.csv", edit=edit)
            out = ran("fit", task, "--log", log, *NAMES, *START, "--json")
            found.append(json.loads(out))
        assert [len(one["start_values"]) for one in found] == [1, 2]
        for name in ("l", "b"):
            low, high = found[1]["parameters"][name]["interval"]
            assert low < TRUE[name] < high

    @pytest.mark.parametrize(
        ("heading", "edit", "more", "match"),
        [
            ("time,angle [deg],tua", None, (), "unknown column of the log 'tau'.*'tua'"),
            ("time,ange [deg],tau", None, (), "unknown column of the log 'q'"),
            (f"time,tau,{wide('tau')}", None, (), r"two columns.*2, 'tau', and number 3, '.uff"),
            ("time,angle [kg],tau", None, (), "column 'angle' of the log.*kg"),
            (None, lambda rows: rows[:1], (), "no two rows.*angle"),
            (None, lambda rows: rows[:3], (), "2 measured values are too few for 3 values"),
            (None, lambda rows: np.where(rows == rows[7, 1], np.inf, rows), (), "log at 0.14 s.*"),
            (None, lambda rows: rows[::-1], (), "no two rows.*angle"),
            (None, None, ("--parameter", "ll"), "unknown variable.*'ll'.*'l'"),
            (None, None, ("--parameter", "q"), "'q' cannot be set.*continuous output"),
            (None, None, ("--parameter", "solver"), "only Reals"),
            (None, None, ("--parameter", "tau"), "'tau' cannot be fitted: it is an input"),
            (None, None, ("--parameter", "c"), "'c' needs a range such as c=1..10"),
            (None, None, ("--parameter", "c=1-2"), "expected NAME=LOW..HIGH, got 'c=1-2'"),
            (None, None, ("--parameter", "c=2..1e-9"), None),
            (None, None, ("--wash-in", "1h"), "no samples after a wash-in of 3600 s"),
            (None, None, ("--wash-in", "soon"), "--wash-in must be a number of seconds"),
            (None, None, ("--start", "q_0=angel"), "unknown measured output 'angel'"),
            (None, None, ("--output", "fitted.txt"), "a task file ends with .toml"),
        ],
    )
    def test_each_mistake_is_a_line(self, cli, task, tmp_path, heading, edit, more, match):
        heading = heading or "time,angle [deg],tau"
        log = write_log(tmp_path / "log.csv", heading, edit=edit)
        code, _, err = cli("fit", task, "--log", log, *NAMES, *START, *more, "--candidates", 1)
        if match is None:
            assert code == 0
            return
        assert code == 1
        errors = [line for line in err.splitlines() if "error:" in line]
        assert len(errors) == 1
        with pytest.raises(ConfigError, match=match):
            raise ConfigError(errors[0])

    def test_without_parameters_it_tells_which_there_are(self, refused, task, tmp_path):
        err = refused("fit", task, "--log", write_log(tmp_path / "log.csv"))
        assert "m, l, b, c" in err.replace("g, ", "")

    def test_means_need_rows_at_steps(self, refused, task, tmp_path):
        task.write_text(
            TASK.replace('unit = "deg" }\nfirst', 'unit = "deg", sample = "mean" }\nfirst')
        )
        odd = write_log(
            tmp_path / "odd.csv", edit=lambda rows: rows + [[0.007, 0, 0]] * (rows[:, :1] == 0.5)
        )
        err = refused("fit", task, "--log", odd, *NAMES)
        assert "the mean of q needs rows that are 0.02 s apart" in err
        fine = write_log(tmp_path / "fine.csv")
        slow = write_log(tmp_path / "slow.csv", edit=lambda rows: rows[::3])
        err = refused("fit", task, "--log", fine, "--log", slow, *NAMES)
        assert "the log at 0 s: the mean of q needs rows that are 0.02 s apart" in err


class TestHouse:
    def test_parameters_are_found(self):
        """By fitted start values. Without them, a tenth of the log is not counted."""
        true = {"UA": 500.0, "H_ve": 75.0, "cop_factor": 0.8}
        log = house_log(true, seed=1, days=4)
        fit = fitted(log, list(true), candidates=1)
        for name, (low, high) in fit.confidence_intervals(0.999).items():
            assert low < true[name] < high, name
            assert high - low < 0.25 * true[name]
        assert all(one.is_noise for one in fit.correlations.values())
        make_env = partial(fmugym.load, fit_coverage.HOUSE_TASK)
        washed = fit_logs(make_env, [log], dict.fromkeys(true), candidates=1)
        assert washed.experiment.wash_in == pytest.approx(0.4 * 86400.0)
        assert not washed.correlations["T_op"].is_noise  # the walls do not forget so soon

    @pytest.mark.parametrize(
        "changed", [str, with_wide_names], ids=["own letters", "other letters"]
    )
    def test_a_recorded_episode_is_a_log(self, cli, ran, tmp_path, changed):
        """Its columns of data hold from their rows on, its inputs until then."""
        base, output = tmp_path / "house.toml", tmp_path / "plant.csv"
        fmugym.Task.read(fit_coverage.HOUSE_TASK).write(base)
        plant = tmp_path / "plant.toml"
        plant.write_text('extends = "house.toml"\nparameters = { UA = 520, T_start = 20 }\n')
        who = "--controller", "hysteresis of=T setpoint=T_set band=1", "--steps", "200"
        ran("simulate", plant, "--scenario", "frost", *who, "--output", output)
        output.write_text(changed(output.read_text(encoding="utf-8")), encoding="utf-8")
        starts = "--start", "T_m_0", "--start", "T_w_0=T_floor"
        options = "--parameter", "UA", *starts, "--candidates", "1", "--json"
        code, out, err = cli("fit", base, "--log", output, *options)
        assert code == 0
        assert json.loads(out)["parameters"]["UA"]["value"] == pytest.approx(520.0, rel=1e-6)
        assert "no noise" not in err


class TestFitted:
    """What a fit has found goes into a task."""

    @pytest.fixture(name="document")
    def fixture_document(self, task, tmp_path):
        rows = np.random.default_rng(0).uniform(0.05, 0.2, (40, 1)) * [1.0, 0.5]
        np.savez(tmp_path / "rows.npz", names=np.array(["l", "c"]), rows=rows)
        return tomllib.loads(TASK) | {"fitted": str(tmp_path / "rows.npz")}

    def test_rows_are_drawn_whole_by_all_environments(self, document, make_envs):
        with fmugym.load(document) as env:
            assert env.episode_start.recipes[-1].kind == "same_row"
            single = [drawn(env, seed) for seed in range(20)]
        assert all(one["c"] == pytest.approx(0.5 * one["l"], rel=1e-12) for one in single)
        assert len({one["l"] for one in single}) > 10
        many = make_envs(partial(fmugym.load, document), 20)
        info = many.reset(seed=0)[1]["drawn"]
        assert info["l"].tolist() == [one["l"] for one in single]
        assert info["c"].tolist() == [one["c"] for one in single]

    def test_rows_are_in_the_units_of_the_fmu(self, document):
        document["variables"] = document.get("variables", {}) | {"cm": {"name": "l", "unit": "cm"}}
        document["parameters"] = {"cm": 10}
        with fmugym.load(document) as env:
            assert 0.05 <= drawn(env, 0)["l"] <= 0.2

    def test_python_draws_the_same_where_c_cannot(self, document):
        """A distribution of the user's between them is drawn by Python."""

        class Own:
            def sample(self, rng):
                return 0.001 * rng.random()

        document["parameters"] = {"b": Own()}
        with fmugym.load(document) as env:
            assert env.episode_start.recipes is None
            values = drawn(env, 3)
            again = env.reset(seed=3, options={"model_parameters": {"l": 0.1}})[1]["drawn"]
        assert values["c"] == pytest.approx(0.5 * values["l"], rel=1e-12)
        assert again["l"] == 0.1
        assert again["c"] == values["c"]

    def test_columns_that_are_apart_still_belong_together(self):
        left, right = (
            DrawnColumn([1.0, 2.0, 3.0], table="t"),
            DrawnColumn([10.0, 20.0, 30.0], table="t"),
        )
        rng = np.random.default_rng(0)
        for _ in range(20):
            first, _, second = draw_all([left, Normal(0.0, 1.0), right], rng)
            assert second == 10.0 * first

    @pytest.mark.parametrize(
        ("names", "rows", "match"),
        [
            (["l", "lc"], np.ones((2, 2)), r"fitted: .*'lc'"),
            (["l"], np.ones((2, 2)), r"fitted: .*a column for each"),
            (["l"], np.full((2, 1), np.nan), r"fitted: .*finite"),
            (["l"], -np.ones((2, 1)), r"fitted: .*'l'.*-1"),
            (["q"], np.ones((2, 1)), r"fitted: 'q' cannot be set"),
        ],
    )
    def test_mistakes(self, document, tmp_path, names, rows, match):
        np.savez(tmp_path / "rows.npz", names=np.array(names), rows=rows)
        with pytest.raises(ConfigError, match=match):
            fmugym.load(document)

    def test_no_such_file(self, document, tmp_path):
        np.save(tmp_path / "rows.npy", np.ones((2, 1)))
        array = (tmp_path / "rows.npy").read_bytes()
        for write in (
            lambda path: path.write_text("no zip"),
            lambda path: np.savez(path, rows=np.ones((2, 1))),
            lambda path: path.write_bytes(array),
        ):
            write(tmp_path / "rows.npz")
            with pytest.raises(ConfigError, match="no file that 'fmugym fit' has written"):
                fmugym.load(document)
        (tmp_path / "rows.npz").unlink()
        with pytest.raises(ConfigError, match=r"fitted: there is no file"):
            fmugym.load(document)


def test_logs_fit_any_environment():
    """A class, or an id: here the cart-pole, whose log is made of its own numbers."""
    rng, rows = np.random.default_rng(0), []
    with gym.make("fmugym/CartPole-v0") as env:
        plant = env.unwrapped
        _, info = env.reset(seed=0, options={"model_parameters": {"m_pole": 0.15}})
        inputs = rng.integers(2, size=30)
        rows = [plant.state]
        for action in inputs:
            env.step(action)
            rows.append(plant.state)
            if plant.done:
                break
        names = [variable.name for variable in plant.pool_spec.outputs]
        written = np.array([10.0 if one else -10.0 for one in inputs[: len(rows) - 1]])
        step = plant.pool_spec.time_step
    columns = dict(zip(names, np.array(rows).T, strict=True))
    columns["f"] = np.append(written, 0.0)
    log = PlantLog(step * np.arange(len(rows)), columns, {}, np.zeros(len(rows)))
    starts = {name: name.removesuffix("_0") for name in info["drawn"] if name.endswith("_0")}
    fit = fit_logs(
        partial(gym.make, "fmugym/CartPole-v0"), [log], {"m_pole": (0.05, 0.3)}, starts=starts
    )
    assert fit.values["m_pole"] == pytest.approx(0.15, rel=1e-6)


def test_rows_are_written_once(tmp_path):
    log = house_log({}, seed=0, days=1)
    fit = fitted(log, ["UA"], candidates=1)
    write_rows(fit, tmp_path / "rows.npz")
    with pytest.raises(FileExistsError):
        write_rows(fit, tmp_path / "rows.npz")
    with np.load(tmp_path / "rows.npz") as file:
        assert file["names"].tolist() == ["UA"]
        assert file["rows"].shape == (1000, 1)


def test_intervals_cover(monkeypatch, capsys):
    """The short form of ``fit_coverage.py``."""
    monkeypatch.setattr("sys.argv", ["fit_coverage.py", "--count", "2"])
    monkeypatch.setattr(fit_coverage, "MOST", 1.0)
    monkeypatch.setattr(fit_coverage, "LEAST", 0.5)
    assert fit_coverage.main() == 0
    assert "2 logs: covered" in capsys.readouterr().out
    monkeypatch.setattr(fit_coverage, "LEAST", 1.1)
    assert fit_coverage.main() == 1
