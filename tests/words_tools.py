"""An FMU that says why it fails (``words.c``), and an environment over it."""

import functools
import subprocess
import tempfile
from pathlib import Path

import fmpy
import fmu_tools
import zoo_tools

import fmugym

SOURCE = Path(__file__).parent / "words.c"
CATEGORIES = ("logEvents", "logStatusError", "logStatusDiscard", "logAll")
STEP = 0.5


@functools.cache
def library(version):
    """The compiled library; made once a session."""
    flags = ["-shared", "-fPIC", "-O1", "-g0", "-Wall", "-Wextra", "-Wno-unused-parameter"]
    prefix = "Words_fmi" if version == 1 else f"fmi{version}"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"Words{fmpy.sharedLibraryExtension}"
        stub = "#define STUB(name) int name(void) { return 3; }\n"
        (path.parent / "stubs.h").write_text(stub + fmu_tools.stubs(version, prefix, SOURCE))
        command = [*zoo_tools.compiler(), *flags, f"-DFMI_VERSION={version}", f"-I{folder}"]
        subprocess.run([*command, '-DSTUBS="stubs.h"', SOURCE, "-o", path], check=True)
        return path.read_bytes()


def words_fmu(folder, version, token, categories=CATEGORIES):
    """Write an FMU; see ``words.c`` for the tokens."""
    files = {
        "modelDescription.xml": _description(version, token, categories),
        fmu_tools.library_name(version, "Words"): library(version),
    }
    return fmu_tools.write_fmu(Path(folder) / "Words.fmu", files)


def _description(version, token, categories):
    head = f'fmiVersion="{version}.0" modelName="Words"'
    head += f' {"instantiationToken" if version == 3 else "guid"}="{token}"'
    listed = "".join(f'<Category name="{name}"/>' for name in categories)
    listed = f"<LogCategories>{listed}</LogCategories>" if categories else ""
    variables = "".join(_variables(version))
    middle = f"<ModelVariables>{variables}</ModelVariables>"
    if version == 1:
        head += ' modelIdentifier="Words" numberOfContinuousStates="0" numberOfEventIndicators="0"'
        end = "<Implementation><CoSimulation_StandAlone><Capabilities/>"
        inside = f"{middle}{end}</CoSimulation_StandAlone></Implementation>"
    else:
        interface = '<CoSimulation modelIdentifier="Words"/>'
        inside = f"{interface}{listed}{middle}<ModelStructure/>"
    return f"<fmiModelDescription {head}>{inside}</fmiModelDescription>"


def _variables(version):
    parameter = 'causality="parameter" variability="fixed"'
    if version == 1:
        parameter = 'causality="internal" variability="parameter"'
    rows = {
        "u": 'causality="input"',
        "y": 'causality="output"',
        "at": parameter,
        "asked": 'causality="output"',
    }
    for index, (name, rest) in enumerate(rows.items()):
        start = "" if "output" in rest else 'start="0"'
        common = f'name="{name}" valueReference="{index}" {rest}'
        if version == 3:
            yield f"<Float64 {common} {start}/>"
        else:
            yield f"<ScalarVariable {common}><Real {start}/></ScalarVariable>"


class WordsEnv(fmugym.FMUEnv):
    """Integrates its action until the FMU fails in step ``at``."""

    def __init__(self, path, at=0, level=30, **options):
        keywords = {key: options.pop(key) for key in ("backend",) if key in options}
        config = {
            "model_input_names": "u",
            "model_output_names": ["y", "asked"],
            "model_parameters": {"at": at},
            "time_step": STEP,
            "bounds": {"u": (-1, 1)},
        } | options
        super().__init__(path, config, level, **keywords)

    def _is_done(self):
        return self.state[0] > 1e9
