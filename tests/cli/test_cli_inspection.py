"""Commands ``info`` and ``new``: what they say of FMUs and data, and that what they write runs."""

import json
import re
import sys
import tomllib
import zipfile
import zlib

import foreign_talker
import makers
import pytest
import quirk_table
import zoo_tools
from command_tasks import PRICES
from fmu_tools import edited_fmu, library_name, probe_fmu, read_fmu
from plants import ONCE
from process_tools import run_python
from pythonfmu.builder import FmuBuilder

import fmugym
from fmugym.cli.command_line import run_command_line
from fmugym.fmi.bundled import FMI_VERSIONS

XML = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="{model}" guid="{{1}}" description="{description}">
  <CoSimulation modelIdentifier="odd" {flags}/>
  <ModelVariables>{variables}</ModelVariables>
  <ModelStructure/>
</fmiModelDescription>
"""


def variable(name, inner, causality="input", variability="continuous", **attributes):
    attributes |= {"name": name, "valueReference": zlib.crc32(name.encode())}
    attributes |= {"causality": causality, "variability": variability}
    listing = " ".join(f'{key}="{value}"' for key, value in attributes.items())
    return f"<ScalarVariable {listing}>{inner}</ScalarVariable>"


INPUT = variable("u", '<Real start="0"/>')
OUTPUT = variable("y", "<Real/>", "output", initial="calculated")


def parameter(name, inner):
    return variable(name, inner, "parameter", "fixed", initial="exact")


@pytest.fixture
def make_fmu(tmp_path):
    def make(*variables, model="odd", description="", flags=""):
        path = tmp_path / "odd.fmu"
        xml = XML.format(
            model=model, description=description, flags=flags, variables="".join(variables)
        )
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("modelDescription.xml", xml)
            archive.writestr("binaries/plan9/odd.so", "")
        return path

    return make


@pytest.fixture
def info(ran):
    return lambda path, *options: ran("info", path, *options)


@pytest.fixture
def facts(info):
    return lambda path, *options: json.loads(info(path, "--json", *options))


@pytest.fixture
def skeleton(capsys):
    def call(path):
        assert run_command_line(["new", "--class", str(path)]) == 0
        return capsys.readouterr()

    return call


class TestInfo:
    @pytest.mark.parametrize(("model", "fmi_version"), ONCE)
    def test_says_what_the_fmu_is(self, info, model, fmi_version):
        text = info(fmugym.bundled_fmu(model, fmi_version))
        assert text.startswith(f"{model} (FMI {fmi_version})\n")
        inputs = {"DoublePendulum": 2, "House": 4}.get(model, 1)
        for heading in (f"Inputs ({inputs})", "Outputs (", "Parameters ("):
            assert heading in text
        assert "Locals" not in text
        assert text.isascii()
        assert ": runs here" in text

    @pytest.mark.parametrize("fmi_version", FMI_VERSIONS)
    def test_variables_have_type_unit_range_start(self, facts, fmi_version):
        found = facts(fmugym.bundled_fmu("Pendulum", fmi_version))
        variables = {v["name"]: v for v in found["variables"]}
        tau = variables["tau"]
        assert tau["type"] == ("Float64" if fmi_version == "3.0" else "Real")
        assert (tau["causality"], tau["unit"], tau["start"]) == ("input", "N.m", 0.0)
        assert (tau["min"], tau["max"], tau["nominal"]) == (-100.0, 100.0, 0.1)
        assert variables["theta"]["min"] is None
        assert variables["q_0"]["start"] == pytest.approx(3.141592653589793, abs=0)
        assert variables["solver"]["start"] == 3
        assert variables["solver"]["items"][2] == {"name": "rk4", "value": 3}

    def test_json_has_platforms_capabilities_and_experiment(self, facts):
        found = facts(fmugym.bundled_fmu("Pendulum"))
        assert found["schema"] == 1
        assert found["platforms"] == ["darwin64", "linux64", "win64"]
        assert found["runs_here"] is True
        assert found["capabilities"]["can_get_and_set_fmu_state"] is True
        assert found["capabilities"]["needs_execution_tool"] is False
        assert found["default_experiment"] == {
            "start_time": 0.0,
            "stop_time": 10.0,
            "step_size": 0.01,
            "tolerance": None,
        }
        assert found["findings"] == []
        assert sum(found["variable_counts"].values()) == 22

    def test_locals_are_counted_and_listed_when_asked_for(self, info):
        path = fmugym.bundled_fmu("Pendulum")
        assert info(path).endswith("Not listed: 1 independent, 1 local\n")
        everything = info(path, "--all")
        assert "Locals (1)" in everything
        assert "theta_ddot" in everything
        assert "Not listed" not in everything

    @pytest.mark.parametrize(
        ("options", "listed"), [((), 20), (("-v",), 25), (("--all",), 25), (("--filter", "p*"), 25)]
    )
    def test_of_many_parameters_twenty_are_listed(self, info, make_fmu, options, listed):
        many = (parameter(f"p{number:02}", '<Real start="1"/>') for number in range(25))
        text = info(make_fmu(INPUT, OUTPUT, *many), *options)
        assert "Parameters (25)" in text
        assert len(re.findall(r"^  p\d\d ", text, re.M)) == listed
        assert ("5 more with -v" in text) is (listed == 20)

    def test_of_twenty_parameters_all_are_listed(self, info, make_fmu):
        text = info(make_fmu(*(parameter(f"p{n:02}", '<Real start="1"/>') for n in range(20))))
        assert "p19" in text
        assert "more with -v" not in text

    def test_the_json_has_all_parameters(self, facts, make_fmu):
        many = (parameter(f"p{number:02}", '<Real start="1"/>') for number in range(25))
        assert len(facts(make_fmu(*many))["variables"]) == 25

    def test_filter_finds_names_of_every_causality(self, facts):
        found = facts(fmugym.bundled_fmu("Pendulum"), "--filter", "theta_d?*")
        names = [v["name"] for v in found["variables"]]
        assert names == ["theta_dot", "theta_ddot", "theta_dot_max", "theta_dot_0"]

    def test_brackets_in_a_filter_stand_for_themselves(self, facts, make_fmu):
        path = make_fmu(*(variable(name, "<Real/>", "local") for name in ("x[1]", "x1", "x[2]")))
        names = [v["name"] for v in facts(path, "--filter", "x[1]")["variables"]]
        assert names == ["x[1]"]

    def test_a_foreign_platform_and_findings_are_told(self, info, make_fmu):
        text = info(make_fmu(variable("u", "<Real/>"), OUTPUT))
        assert "does NOT run here" in text
        assert "platforms           plan9" in text
        assert "Findings (" in text

    @pytest.mark.parametrize(
        ("tool", "flag", "named"),
        [
            ("Dymola 2024x", "true", "Dymola 2024x"),
            ("", "true", "the tool that exported it"),
            ("EnergyPlusToFMU 3.1", "false", "EnergyPlus"),
            ("Overture 3.0", "false", "Java"),
            ("Simulink (R2023b)", "true", "MATLAB"),
            ("Simulink (R2023b)", "false", None),
            ("Dymola 2024x", "false", None),
        ],
    )
    def test_a_tool_that_must_be_installed_is_named(
        self, info, facts, tmp_path, monkeypatch, tool, flag, named
    ):
        edits = {
            "<CoSimulation ": f'<CoSimulation needsExecutionTool="{flag}" ',
            'fmiVersion="2.0"': f'fmiVersion="2.0" generationTool="{tool}"',
        }
        path = probe_fmu(tmp_path, 2, edits)
        monkeypatch.setenv("PATH", str(tmp_path))  # nothing is installed, no compiler either
        end = f": runs here if it is installed: {named}\n" if named else ": runs here\n"
        assert end in info(path)
        assert facts(path)["missing_tool"] == named

    @pytest.mark.skipif(sys.platform == "win32", reason="programs of Unix")
    def test_a_tool_that_is_installed_is_not(self, info, tmp_path, monkeypatch):
        program = tmp_path / "energyplus"
        program.touch(0o755)
        edits = {'fmiVersion="2.0"': 'fmiVersion="2.0" generationTool="EnergyPlus 23.1"'}
        path = probe_fmu(tmp_path, 2, edits)
        monkeypatch.setenv("PATH", str(tmp_path))
        assert ": runs here\n" in info(path)

    def test_a_library_of_another_processor_does_not_run_here(self, info, facts, tmp_path):
        library = bytearray(read_fmu(probe_fmu(tmp_path))[library_name(2)])
        library[18:20] = (22).to_bytes(2, "little")  # the machine of an ELF file: s390
        text = info(probe_fmu(tmp_path, add={library_name(2): bytes(library)}))
        assert "does NOT run here: Probe.fmu: " in text
        assert "was built for ELF machine 22, this process runs on" in text

    def test_texts_of_a_foreign_file_are_made_harmless(self, info, make_fmu):
        path = make_fmu(INPUT, description="25 \u00b0C\u2028and &#x85; \u202e more")
        text = info(path)
        assert "25 \u00b0C and" in text
        assert r"\u202e more" in text

    def test_malformed_start_values_are_shown_as_text(self, facts, make_fmu):
        path = make_fmu(
            parameter("a", '<Real start="INF"/>'),
            parameter("b", '<Integer start="x"/>'),
            parameter("c", '<Boolean start="true"/>'),
            parameter("d", '<String start="007"/>'),
            parameter("e", f'<Integer start="{"9" * 400}"/>'),
        )
        starts = [v["start"] for v in facts(path)["variables"]]
        assert starts == ["INF", "x", True, "007", "9" * 400]


class TestSkeleton:
    @pytest.mark.parametrize(("model", "fmi_version"), ONCE)
    def test_runs_and_keeps_the_contract(self, tmp_path, model, fmi_version):
        assert_skeleton_runs(fmugym.bundled_fmu(model, fmi_version), tmp_path, "-W", "error")

    @pytest.mark.parametrize("fmi_version", FMI_VERSIONS)
    def test_base_class_and_names_are_those_of_the_fmu(self, skeleton, fmi_version):
        text = skeleton(fmugym.bundled_fmu("Pendulum", fmi_version)).out
        assert f"class PendulumEnv(fmugym.FMI{fmi_version[0]}CSEnv):" in text
        assert '"tau",  # [N.m] Torque' in text
        assert '"g": 9.81,  # [m/s2]' in text
        assert '"body": "point_mass",' in text
        assert '"bounds"' not in text  # the FMU has limits for its input

    def test_paths_are_relative_to_the_file(self, ran, tmp_path):
        for place, path in (("model.fmu", "model.fmu"), ("beside.fmu", "../beside.fmu")):
            folder = tmp_path / "mine"
            folder.mkdir(exist_ok=True)
            fmu = (folder if "/" not in path else tmp_path) / place
            fmu.write_bytes(fmugym.bundled_fmu("Pendulum").read_bytes())
            file = folder / f"{fmu.stem}.py"
            ran("new", "--class", fmu, "--output", file)
            assert f'FMU_PATH = "{path}"' in file.read_text()
            done = run_python(file.name, cwd=folder, timeout=300)
            assert done.returncode == 0, done.stderr

    def test_libraries_that_it_lacks_are_preloaded(self, ran, tmp_path, monkeypatch):
        name = "libgfortran.so.3"
        monkeypatch.setattr("fmugym.cli.class_skeleton.replaceable", lambda fmu: (name,))
        line = f'"foreign": {{"preload": ["./{name}"]}},'
        for is_there in (False, True):
            if is_there:
                (tmp_path / name).write_bytes(b"")
            file = tmp_path / f"env_{is_there}.py"
            ran("new", "--class", fmugym.bundled_fmu("Pendulum"), "--output", file)
            assert f"{' ' * 12}{'' if is_there else '# '}{line}\n" in file.read_text()

    def test_unbounded_inputs_get_placeholders_and_a_note(self, skeleton, make_fmu):
        half = variable("v", '<Real start="0" min="2"/>')
        scaled = variable("w", '<Real start="0" nominal="300"/>')
        made = skeleton(make_fmu(INPUT, half, scaled, OUTPUT))
        config = config_of(made.out)
        assert config["bounds"] == {"u": (0.0, 1.0), "v": (2.0, 3.0), "w": (-300.0, 300.0)}
        assert "limits of input 'u'" in made.err
        assert "no step size" in made.err
        assert "does not run on this machine" in made.err

    def test_numbers_of_no_use_get_placeholders_too(self, skeleton, make_fmu):
        odd = variable("v", '<Real start="0" min="NaN" nominal="NaN"/>')
        experiment = '/><DefaultExperiment stopTime="1e300" stepSize="1e-300"'
        config = config_of(skeleton(make_fmu(odd, OUTPUT, flags=experiment)).out)
        assert config["bounds"] == {"v": (0.0, 1.0)}
        assert (config["time_step"], config["max_episode_steps"]) == (1e-300, 200)

    @pytest.mark.parametrize(
        ("attributes", "bounds"),
        [
            ('start="293.15"', (263.835, 322.465)),
            ('start="293.15" nominal="20"', (273.15, 313.15)),
            ('start="-2" max="-1.9"', (-2.2, -1.9)),
            ('start="1e5" min="0"', (0.0, 1.1e5)),
            ('start="1e5" min="0" max="0"', (9e4, 1.1e5)),
        ],
    )
    def test_guessed_limits_are_near_the_start_value(self, skeleton, make_fmu, attributes, bounds):
        config = config_of(skeleton(make_fmu(variable("T", f"<Real {attributes}/>"), OUTPUT)).out)
        assert config["bounds"]["T"] == pytest.approx(bounds)

    @pytest.mark.parametrize(
        ("experiment", "time_step", "steps"),
        [
            ('stopTime="3600"', 5.0, 720),
            ('startTime="10" stopTime="10.01"', 2e-5, 500),
            ('stopTime="1"', 0.002, 500),
            ('stopTime="1" stepSize="5"', 0.002, 500),
            ('stopTime="86400" stepSize="60"', 60.0, 1440),
            ('startTime="5"', 0.01, 200),
        ],
    )
    def test_time_step_fits_the_default_experiment(
        self, skeleton, make_fmu, experiment, time_step, steps
    ):
        path = make_fmu(INPUT, OUTPUT, flags=f"/><DefaultExperiment {experiment}")
        config = config_of(skeleton(path).out)
        assert (config["time_step"], config["max_episode_steps"]) == (time_step, steps)

    @pytest.mark.parametrize("limits", ['min="1" max="-1"', 'min="-1e308" max="1e308"'])
    def test_limits_that_mean_nothing_are_guessed(self, skeleton, make_fmu, limits):
        made = skeleton(make_fmu(variable("u", f'<Real start="0" {limits}/>'), OUTPUT))
        assert config_of(made.out)["bounds"] == {"u": (0.0, 1.0)}
        assert "limits of input 'u'" in made.err

    def test_time_step_is_a_multiple_of_the_internal_one(self, skeleton, tmp_path):
        """FMI 3.0 has it; a shorter step does nothing."""
        edits = {'modelIdentifier="Probe"': 'modelIdentifier="Probe" fixedInternalStepSize="0.3"'}
        edits["<TypeDefinitions>"] = '<DefaultExperiment stopTime="1000"/><TypeDefinitions>'
        config = config_of(skeleton(probe_fmu(tmp_path, 3, edits)).out)
        assert config["time_step"] == pytest.approx(2.1)

    def test_settings_of_the_solver_are_left_out(self, skeleton, make_fmu):
        names = (
            "_cs_solver",
            "_log_level",
            "a._enforce",
            "solver",
            "rel_tol",
            "x.solver.tolerance",
        )
        names += ("dymola.maxStep", "max_step_size", "nle_solver_max_iter")
        kept = ("dissolver", "tolerance_of_hatch", "step", "idaho", "tank.a_to_l")
        rows = [parameter(name, '<Real start="1"/>') for name in names + kept]
        made = skeleton(make_fmu(INPUT, OUTPUT, *rows))
        assert tuple(config_of(made.out)["model_parameters"]) == kept
        assert f"# {len(names)} more are listed by: fmugym info" in made.out

    @pytest.mark.parametrize("version", [1, 2, 3])
    def test_runs_for_fmus_of_the_tests(self, tmp_path, version):
        made = [probe_fmu(tmp_path, version)]
        made.append(quirk_table.quirk_fmu(tmp_path, version, "well behaved"))
        made.append(zoo_tools.zoo_fmu(tmp_path, version))
        for path in made:
            assert_skeleton_runs(path, tmp_path)

    @pytest.mark.parametrize("name", makers.MADE)
    def test_runs_for_fmus_of_other_makers(self, tmp_path, name):
        assert_skeleton_runs(makers.MADE[name].build(tmp_path), tmp_path)

    def test_what_a_number_cannot_carry_is_left_out(self, skeleton, make_fmu):
        made = skeleton(
            make_fmu(
                INPUT,
                variable("file", '<String start="a"/>', variability="discrete"),
                OUTPUT,
                parameter("good", '<Integer start="3"/>'),
                parameter("endless", '<Real start="INF"/>'),
                parameter("text", '<String start="it\'s"/>'),
            )
        )
        config = config_of(made.out)
        assert config["model_input_names"] == ["u"]
        assert config["model_parameters"] == {"good": 3, "text": "it's"}
        assert "# 1 more are listed by: fmugym info" in made.out

    def test_no_text_of_the_fmu_becomes_code(self, skeleton, make_fmu):
        evil = "&quot;&quot;&quot;&#10;raise SystemExit(9)&#10;#'"
        made = skeleton(
            make_fmu(
                variable(evil, '<Real start="0"/>', description=evil),
                OUTPUT,
                parameter("p", f'<String start="{evil}"/>'),
                model=f"a.b-1 {evil}",
                description=evil,
            )
        )
        assert made.out.isascii()
        names = config_of(made.out)["model_input_names"]
        assert names[0].startswith('"""')
        assert "class B1RaiseSystemExit9Env(" in made.out

    def test_without_inputs_and_outputs(self, skeleton, make_fmu):
        made = skeleton(make_fmu(variable("x", "<Real/>", "local", initial="calculated")))
        assert config_of(made.out)["model_input_names"] == []
        assert config_of(made.out)["model_output_names"] == ["x"]
        assert "spaces.Discrete(1)" in made.out
        assert "no numeric input" in made.err
        assert "locals" in made.err

    def test_nothing_to_observe_is_an_error(self, make_fmu, refused):
        assert "to observe" in refused("new", "--class", make_fmu(INPUT))

    def test_runs_for_an_fmu_without_inputs_of_another_exporter(self, tmp_path):
        fmu = FmuBuilder.build_FMU(foreign_talker.__file__, tmp_path)
        assert_skeleton_runs(fmu, tmp_path)


class TestNew:
    def test_what_it_leaves_out_is_counted(self, make_fmu, cli):
        rows = [parameter(f"p{n}", f'<Real start="{n}"/>') for n in range(47)]
        code, out, err = cli("new", make_fmu(INPUT, OUTPUT, *rows))
        assert code == 0
        assert [f"# p{n} = {n}.0" in out for n in (39, 40)] == [True, False]
        assert "# 7 more are listed by: fmugym info" in out
        assert "7 parameters are left out; 'fmugym info -v' lists them" in err

    def test_locals_that_look_like_results_are_listed(self, make_fmu, ran):
        """As comments: each is a line of [variables] once its # is gone."""
        real = '<Real unit="{}"/>'
        wanted = {"room.T[1]": "degC", "P": "W", "E.total": "kWh"}
        rows = [variable(name, real.format(unit), "local") for name, unit in wanted.items()]
        rows += [variable("room.T_start", real.format("K"), "local", "fixed")]
        rows += [variable("der(x)", real.format("m/s"), "local"), variable("n", "<Real/>", "local")]
        text = ran("new", make_fmu(INPUT, OUTPUT, *rows))
        table = text[text.index("# These locals") :].partition("\n[setpoints]")[0]
        table = re.sub(r"^# ", "", table.partition("\n")[2], flags=re.M)
        assert {row["name"] for row in tomllib.loads(table).values()} == wanted.keys()
        assert tomllib.loads(text)["variables"].keys() == {"u"}


def assert_skeleton_runs(fmu, folder, *options):
    """Write a skeleton into a folder and run it."""
    assert (
        run_command_line(
            ["new", "--class", str(fmu), "--output", str(folder / "made.py"), "--force"]
        )
        == 0
    )
    done = run_python(*options, "made.py", cwd=folder, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "keeps the contract" in done.stdout


def config_of(text):
    """The config that a skeleton hands to its base class; the FMU is not loaded."""
    namespace = {"__name__": "made"}
    program = text.replace("super().__init__(FMU_PATH, config, log_level)", "self.given = config")
    exec(compile(program, "made.py", "exec"), namespace)
    (cls,) = (c for name, c in namespace.items() if name.endswith("Env"))
    return cls().given


class TestCommand:
    def test_output_fits_the_narrowest_console(self, make_fmu):
        path = make_fmu(INPUT, OUTPUT, description="25 \u00b0C")
        commands = [
            ["info", str(path)],
            ["info", str(path), "--json"],
            ["new", "--class", str(path)],
        ]
        program = "from fmugym.cli.command_line import run_command_line as run"
        program = f"{program}\nassert not any(map(run, {commands}))"
        done = run_python("-c", program, environment={"PYTHONIOENCODING": "ascii:strict"})
        assert done.returncode == 0, done.stderr
        assert r"25 \xb0C" in done.stdout

    def test_letters_of_other_languages_stay(self, info, make_fmu, tmp_path, ran):
        described = variable("u", '<Real start="0"/>', description="Außentemperatur 温度")
        path = make_fmu(described, OUTPUT).rename(tmp_path / "Übung größer.fmu")
        text = info(path)
        assert str(path) in text
        assert "Außentemperatur 温度" in text
        for kind in ([], ["--class"]):
            made = tmp_path / f"made{len(kind)}"
            ran("new", path, *kind, "--output", made)
            assert "# Außentemperatur 温度" in made.read_text(encoding="utf-8")


class TestTasks:
    @pytest.mark.parametrize(("model", "version"), ONCE)
    def test_what_it_writes_passes_validate(self, model, version, tmp_path, cli):
        path = tmp_path / "task.toml"
        fmu = fmugym.bundled_fmu(model, version)
        code, out, err = cli("new", fmu, "--output", path)
        assert (code, out) == (0, "")
        assert "reward and set point are guesses" in err
        code, out, err = cli("validate", path, "--json")
        findings = json.loads(out)["findings"]
        assert (code, err) == (0, "")
        bad = {finding["check"] for finding in findings if finding["verdict"] != "ok"}
        # sizes of temperatures and powers differ, nothing writes the weather, and the FMU's default
        # experiment is shorter than the time constant of its walls
        of_house = {"inputs", "observations", "length"}
        assert bad <= (of_house if model == "House" else {"observations"})

    def test_names_that_are_no_names_of_python(self, tmp_path, ran, load):
        odd = {'name="tau"': 'name="a.b[1] &quot;x&quot;\\ \u00e4"', 'name="q"': 'name="step"'}
        fmu = edited_fmu(fmugym.bundled_fmu("Pendulum"), tmp_path, odd)
        out = ran("new", fmu)
        assert out.isascii()
        env = load(tomllib.loads(out))
        assert env.config.model_input_names == ('a.b[1] "x"\\ \u00e4',)
        assert "step" in env.config.model_output_names

    def test_the_path_of_an_fmu_below_the_file_is_relative(self, tmp_path, cli):
        (tmp_path / "fmus").mkdir()
        fmu = tmp_path / "fmus" / "Pendulum.fmu"
        fmu.write_bytes(fmugym.bundled_fmu("Pendulum").read_bytes())
        cli("new", fmu, "--output", tmp_path / "task.toml")
        assert 'fmu = "fmus/Pendulum.fmu"' in (tmp_path / "task.toml").read_text()
        fmugym.load(tmp_path / "task.toml").close()


@pytest.fixture
def task(tmp_path):
    hours = [*range(3), *range(3, 24)]
    rows = [f"2024-10-27 {hour:02d}:00;{hour},5;{hour if hour != 9 else ''}" for hour in hours]
    rows.insert(3, "2024-10-27 02:00;2,75;2")
    (tmp_path / "prices.csv").write_text("\n".join(["time;p;q", *rows, ""]), encoding="utf-8")
    (tmp_path / "task.toml").write_text(PRICES, encoding="utf-8")
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
    task.write_text(PRICES.replace("prices", "prises", 1), encoding="utf-8")
    out = ran("info", task)
    assert "unknown file 'prises.csv'; did you mean 'prices.csv'?" in out
    task.write_text(
        PRICES.partition("[data]")[0] + PRICES[PRICES.index("[agent]") :], encoding="utf-8"
    )
    assert "\nData" not in ran("info", task)


class TestJson:
    @pytest.mark.parametrize("options", [[], ["--class"]])
    def test_of_new(self, options, tmp_path, cli):
        fmu = fmugym.bundled_fmu("Pendulum")
        path = tmp_path / "out"
        code, out, err = cli("new", fmu, *options, "--output", path, "--json")
        facts = json.loads(out)
        assert (code, err, facts["output"]) == (0, "", str(path))
        text = path.read_text()
        if options:
            assert facts["program"] == text
        else:
            assert facts["task"] == tomllib.loads(text)
            assert any("reward" in note for note in facts["notes"])
