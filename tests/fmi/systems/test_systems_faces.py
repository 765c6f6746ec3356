"""Systems where an FMU can stand: environments, task files, the command line, pictures."""

import json
import pickle
from contextlib import closing

import numpy as np
import pytest
import ssp_tools
from fmu_tools import PlainEnv

import fmugym
from fmugym import Component, ConfigError, FMUSystem, TaskError, bundled_fmu
from fmugym.control.identification import Trajectory, fit_parameters
from fmugym.environment.env_checker import check_fmu_env

HOUSE = bundled_fmu("House")

TASK = """
version = 1
time_step = "15min"
episode_length = "6h"
{head}

[system]
name = "two houses"
connections = [
  "outside -> east.T_out",
  "outside -> west.T_out",
  {{ source = "east.Q_em", target = "west.Q_int", gain = 0.1 }},
]
units = {{ outside = "degC" }}
step_size = "60s"

[system.components]
east = {{ bundled = "House" }}
west = {{ fmu = {{ bundled = "House" }}, start_values = {{ T_m_0 = 290.0 }} }}

[variables]
T = {{ name = "east.T_air", unit = "degC", min = 0, max = 50 }}
T2 = {{ name = "west.T_air", unit = "degC", min = 0, max = 50 }}
u = {{ name = "east.u" }}
u2 = {{ name = "west.u" }}

[agent]
actions = ["u", "u2"]
observations = ["T", "T2"]

{tail}
"""
ONE_REWARD = {"head": 'reward = "-abs(T - 21)"', "tail": ""}
TWO_REWARDS = {
    "head": "",
    "tail": '[reward.warm]\nexpr = "-abs(T - 21)"\n[reward.cool]\nexpr = "-abs(T2 - 18)"\n',
}


def two_houses(**options):
    return FMUSystem(
        {"east": HOUSE, "west": Component(HOUSE, {"T_m_0": 290.0})},
        [
            "outside -> east.T_out",
            "outside -> west.T_out",
            fmugym.Connection("east.Q_em", "west.Q_int", 0.1),
            "east.T_air -> warmth",
        ],
        units={"outside": "degC", "warmth": "degC"},
        **{"step_size": 60.0, "name": "two houses"} | options,
    )


class TwoHouses(PlainEnv):
    def __init__(self, path, **options):
        config = {
            "model_input_names": ["east.u", "outside"],
            "model_output_names": ["east.T_air", "west.T_air", "warmth", "west.E"],
            "model_parameters": {"east.A_f": fmugym.Uniform(100, 200)},
            "time_step": 900.0,
            "max_episode_steps": 20,
        }
        super().__init__(path, config, **options)


def played(env, steps=12, seed=3):
    env.action_space.seed(seed)
    rows = [env.reset(seed=seed)[0]]
    rows += [env.step(env.action_space.sample())[0] for _ in range(steps)]
    env.close()
    return np.array(rows)


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    return ssp_tools.write(two_houses(), tmp_path_factory.mktemp("ssp") / "houses.ssp")


@pytest.fixture
def task(tmp_path):
    def write(**parts):
        path = tmp_path / "houses.toml"
        path.write_text(TASK.format(**ONE_REWARD | parts))
        return path

    return write


class TestEnvironments:
    def test_an_object_and_an_archive_give_the_same(self, archive):
        assert np.array_equal(played(TwoHouses(two_houses())), played(TwoHouses(archive)))

    def test_a_relative_archive_is_found_beside_the_class(self):
        with pytest.raises(fmugym.FMULoadError, match=r"tests.*none\.ssp"):
            TwoHouses("none.ssp")

    def test_units_of_the_system_hold_in_the_environment(self):
        env = TwoHouses(two_houses())
        (_, outside) = env.action_space.low
        assert outside == pytest.approx(200 - 273.15, abs=1e-4)  # the FMU gives 200 K
        state = env.reset(seed=0)[0]
        assert state[2] == pytest.approx(state[0] - 273.15, abs=1e-4)

    def test_start_values_of_components_are_in_the_episode(self):
        """A house that begins colder is colder, and the environment's own values win."""
        first = TwoHouses(two_houses()).reset(seed=0)[0]
        env = TwoHouses(two_houses())
        options = {"model_parameters": {"west.T_m_0": 295.0}}
        assert env.reset(seed=0, options=options)[0][1] > first[1] + 2

    def test_the_checks_of_any_environment(self):
        check_fmu_env(TwoHouses(two_houses()))

    def test_parameters_of_a_component_are_identified(self):
        """The data are of a house of 140 m2; the default is 150."""
        env = TwoHouses(two_houses())
        env.reset(seed=0, options={"model_parameters": {"east.A_f": 140.0}})
        inputs = np.array([[step % 4 / 3, 3.0 + step % 3] for step in range(19)], np.float32)
        states = [env.state] + [(env.step(action), env.state)[1] for action in inputs]
        inputs = np.vstack([inputs, inputs[-1:]]).astype(float)
        trajectory = Trajectory(
            np.arange(20) * 900.0,
            {"east.T_air": np.array(states)[:, 0]},
            {"east.u": inputs[:, 0], "outside": inputs[:, 1]},
        )
        fit = fit_parameters(
            two_houses(),
            {"east.A_f": (150.0, 100.0, 200.0)},
            [trajectory],
        )
        assert fit.values["east.A_f"] == pytest.approx(140.0, rel=1e-3)

    def test_what_drives_a_name_is_the_only_one(self):
        """An input behind a name of the system is set by that name alone."""
        with pytest.raises(ConfigError, match=r"east\.T_out.*'outside'"):
            PlainEnv(
                two_houses(),
                {"model_input_names": ["east.T_out"], "model_output_names": ["warmth"]},
            )

    def test_keys_for_a_single_fmu(self):
        for fact, given in (
            ("'interface'.* to a component", {"interface": "co_simulation"}),
            ("'preload'.* to the FMU of a component", {"foreign": {"preload": ["/x.so"]}}),
        ):
            config = {"model_input_names": [], "model_output_names": ["warmth"], **given}
            with pytest.raises(ConfigError, match=fact):
                PlainEnv(two_houses(), config)


class TestTaskFiles:
    def test_the_section_makes_the_same_system(self, task):
        env = fmugym.load(task())
        assert env.fmu.plan.links == two_houses().plan.links
        assert env.fmu.plan.components[1].starts == (("T_m_0", 290.0),)
        assert env.fmu.plan.step_size == 60.0
        rows = played(env, steps=10)
        assert rows.shape == (11, 2)

    def test_it_can_be_written_and_read_again(self, task, tmp_path):
        env = fmugym.load(task())
        env.task.write(tmp_path / "again.toml")
        assert fmugym.Task.read(tmp_path / "again.toml") == env.task

    def test_paths_of_components_are_relative_to_the_file(self, task, tmp_path):
        (tmp_path / "parts").mkdir()
        (tmp_path / "parts" / "own.fmu").write_bytes(HOUSE.read_bytes())
        path = task()
        path.write_text(
            path.read_text().replace('east = { bundled = "House" }', 'east = "parts/own.fmu"')
        )
        loaded = fmugym.load(path)
        assert loaded.fmu.plan.components[0].path == tmp_path / "parts" / "own.fmu"
        copy = tmp_path / "parts" / "copy.toml"
        loaded.task.write(copy)
        assert 'east = "own.fmu"' in copy.read_text()

    @pytest.mark.parametrize(
        ("old", "new", "facts"),
        [
            ("gain = 0.1", "gian = 0.1", ["connections", "gian", "gain"]),
            ("gain = 0.1", 'gain = "much"', ["gain", "much"]),
            ('source = "east.Q_em", ', "", ["source"]),
            ('step_size = "60s"', 'step_size = "soon"', ["step_size", "soon"]),
            ('step_size = "60s"', 'master = "jacob"', ["jacobi"]),
            ('{ bundled = "House" }\nwest', '"none.fmu"\nwest', ["east", "none.fmu"]),
            ("version = 1", 'version = 1\nfmu = "a.fmu"', ["'fmu'", "'system'"]),
        ],
    )
    def test_mistakes_say_where_they_are(self, task, old, new, facts):
        path = task()
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))
        with pytest.raises(TaskError) as error:
            fmugym.load(path)
        assert str(error.value).startswith("houses.toml, line "), error.value
        assert all(fact in str(error.value) for fact in facts), error.value


def test_the_master_of_an_archive_can_be_chosen(archive):
    system = FMUSystem.read(archive, master="jacobi")
    assert pickle.loads(pickle.dumps(system)).plan.master == "jacobi"
    document = {
        "fmu": str(archive),
        "time_step": "15min",
        "reward": "-T",
        "variables": {"T": {"name": "east.T_air"}, "u": {"name": "east.u"}},
        "agent": {"actions": ["u"], "observations": ["T"]},
    }
    for given in ("jacobi", "gauss_seidel"):
        with closing(fmugym.load(document, master=given)) as env:
            assert env.fmu.plan.master == given
            assert pickle.loads(pickle.dumps(env)).fmu.plan.master == given
    with pytest.raises(ConfigError, match=r"jacob.*jacobi"):
        fmugym.load(document, master="jacob")


class TestCommandLine:
    def test_info_of_an_archive_and_of_a_task(self, archive, task, ran):
        for path in (archive, task()):
            text = ran("info", path)
            for fact in (
                "two houses (a system of 2 FMUs)",
                "east.Q_em -> west.Q_int (* 0.1)",
                "input outside -> east.T_out (+ 273.15), west.T_out (+ 273.15)",
                "east -> west",
            ):
                assert fact in text

    @pytest.mark.parametrize("declared", [True, False])
    def test_the_master_can_be_chosen(self, archive, task, tmp_path, cli, ran, declared):
        path = task()
        if not declared:
            head, _, rest = path.read_text().partition("[system]")
            path.write_text(f'{head}fmu = "{archive}"\n{rest[rest.index("[variables]") :]}')
        _, facts, _ = cli("info", path, "--master", "jacobi", "--json")
        assert json.loads(facts)["system"]["master"] == "jacobi"
        runs = []
        for options in ([], ["--master", "gauss_seidel"], ["--master", "jacobi"]):
            file = tmp_path / f"{len(runs)}.csv"
            ran("simulate", path, "--steps", 3, "--output", file, *options)
            runs.append(file.read_text())
        assert runs[0] == runs[1] != runs[2]

    def test_a_single_fmu_has_no_master(self, tmp_path, refused):
        path = tmp_path / "task.toml"
        path.write_text('fmu = { bundled = "House" }\n')
        for one in (HOUSE, path):
            error = refused("info", one, "--master", "jacobi")
            assert "House.fmu is a single FMU" in error
        assert "'somewhere:Own'" in refused("validate", "somewhere:Own", "--master", "jacobi")

    def test_info_as_json(self, archive, cli):
        _, facts, _ = cli("info", archive, "--json")
        system = json.loads(facts)["system"]
        assert [one["name"] for one in system["components"]] == ["east", "west"]
        assert system["connections"][0]["gain"] == 0.1
        assert system["order"] == [
            {"components": ["east"], "is_loop": False},
            {"components": ["west"], "is_loop": False},
        ]

    def test_info_of_a_task_with_an_fmu_is_that_of_the_fmu(self, tmp_path, cli):
        path = tmp_path / "task.toml"
        path.write_text('fmu = { bundled = "House" }\n')
        found = cli("info", path)
        assert found == cli("info", HOUSE)
        assert found[0] == 0

    def test_from_an_archive_to_a_task_and_an_episode(self, archive, tmp_path, ran):
        path = tmp_path / "new.toml"
        ran("new", archive, "--output", path)
        run = tmp_path / "run.csv"
        ran("simulate", path, "--steps", 3, "--output", run)
        header = run.read_text().splitlines()[0]
        assert "west_E" in header
        program = tmp_path / "houses.py"
        ran("new", "--class", archive, "--output", program)
        assert "(fmugym.FMUEnv)" in program.read_text()
        ran("bench", archive, "--envs", 2, "--seconds", 0.1)

    def test_validation_of_an_archive(self, archive, ran):
        assert "repetition" in ran("validate", archive)


def test_inputs_and_parameters_of_the_system_are_read_in_its_own_units():
    """273.15 K are 0 degC, by definition; and half a pendulum is a gain of 2."""
    system = fmugym.FMUSystem(
        {"house": fmugym.bundled_fmu("House"), "rod": fmugym.bundled_fmu("Pendulum")},
        ["outside -> house.T_out", fmugym.Connection("half", "rod.m", gain=2.0)],
        units={"outside": "degC"},
    )
    names = ["outside", "house.T_out", "half", "rod.m"]

    class Read(PlainEnv):
        def __init__(self):
            config = {
                "model_input_names": ["outside"],
                "model_output_names": names,
                "model_parameters": {"outside": -3.0, "half": 0.25},
                "bounds": {"outside": (-20, 40)},
                "time_step": 60.0,
            }
            super().__init__(system, config)

    env = Read()
    env.reset(seed=0)
    assert env.state == pytest.approx((-3.0, 270.15, 0.25, 0.5), rel=1e-12)
    env.step(np.array([7.0]))
    assert env.state == pytest.approx((7.0, 280.15, 0.25, 0.5), rel=1e-12)
    env.close()
