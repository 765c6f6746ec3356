"""What ``import fmugym`` imports, and the names that come later."""

import pytest
from process_tools import run_python

import fmugym
from fmugym.environment import vector

HEAVY = (
    "fmpy",
    "pygame",
    "fmugym.environment.env",
    "fmugym.pool",
    "fmugym.environment.vector.vector_env",
    "fmugym.envs",
)

OPTIONAL = (
    *("cli", "control.identification", "deployment", "fmi.systems.ssp_archive"),
    *("fmi.source_compiler", "fmi.fortran_libraries", "lab", "records", "training"),
)


def run(program):
    """The output of a program in a new interpreter, as words."""
    return run_python("-c", program, check=True).stdout.split()


def test_importing_the_package_imports_little():
    assert run(f"import sys, fmugym; print(*(m for m in {HEAVY} if m in sys.modules))") == []


def test_a_class_brings_neither_vector_environments_nor_pictures():
    program = "import sys, fmugym; fmugym.FMI2CSEnv; print(*(m for m in sys.modules))"
    imported = set(run(program))
    assert "fmugym.environment.env" in imported
    assert not {"pygame", "fmugym.environment.vector.vector_env", "fmugym.lab"} & imported


def test_environments_work_without_optional_rooms():
    program = f"""
import sys
for room in {OPTIONAL}:
    sys.modules["fmugym." + room] = None  # as if it had not been installed
import gymnasium, fmugym
fmu = {{"bundled": "Pendulum"}}
task = {{"fmu": fmu, "time_step": "20ms", "agent": {{"actions": ["tau"], "observations": ["q"]}}}}
task["variables"] = {{"tau": {{"min": -1, "max": 1}}}}
task["reward"] = "-q * q"
make, make_vec = gymnasium.make, gymnasium.make_vec
for env in (make("fmugym/CartPole-v0"), fmugym.load(task), make_vec("fmugym/Pendulum-v0", 2)):
    env.reset(seed=1)
    env.step(env.action_space.sample())
    env.close()
print(*(name for name in sys.modules if name.startswith("fmugym.envs")))
"""
    assert "fmugym.envs" in run(program)


def test_every_public_name_is_there():
    assert dir(fmugym) == sorted(dir(fmugym))
    for name in fmugym.__all__:
        assert getattr(fmugym, name) is not None
        assert name in dir(fmugym)
    program = "from fmugym import *; print(CartPole := envs.CartPoleEnv, FMUVectorEnv, register)"
    assert "fmugym.environment.vector.vector_env.FMUVectorEnv" in " ".join(run(program))


@pytest.mark.parametrize("name", ["lab", "environment", "control", "rendering", "records"])
def test_rooms_are_imported_by_name(name):
    assert run(f"import fmugym; print(fmugym.{name}.__name__)") == [f"fmugym.{name}"]


@pytest.mark.parametrize("module", [fmugym, vector])
def test_other_names_are_refused(module):
    with pytest.raises(AttributeError, match=rf"module '{module.__name__}' has no attribute 'Foo'"):
        module.Foo  # noqa: B018 (the access is what is tested)
    assert not hasattr(module, "__wrapped__")


@pytest.mark.parametrize(
    ("module", "library"),
    [
        ("training.sb3", "stable_baselines3"),
        ("records.minari", "minari"),
        ("training.rllib", "ray"),
    ],
)
def test_a_missing_library_names_its_extra(module, library):
    program = f"import sys; sys.modules[{library!r}] = None; import fmugym.{module}"
    done = run_python("-c", program)
    assert done.returncode == 1
    assert f"pip install '.[{module.rpartition('.')[2]}]'" in done.stderr
