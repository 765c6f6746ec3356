"""Surrogates as FMUs: valid, and with the same outputs."""

import shutil
import sys
from contextlib import closing

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from surrogate_tools import surrogate_of

from fmugym import FMUVectorEnv
from fmugym.deployment.export import write_fmu
from fmugym.deployment.export.exported_agent import agent_of_surrogate
from fmugym.envs import HouseEnv, PendulumEnv
from fmugym.errors import ConfigError
from fmugym.pool.pool_spec import is_start_time

pytestmark = pytest.mark.skipif(
    sys.platform == "win32" or not shutil.which("cc"), reason="needs a C compiler"
)


@pytest.mark.parametrize(
    ("make_env", "version"), [(PendulumEnv, "2.0"), (HouseEnv, "3.0"), (HouseEnv, "2.0")]
)
def test_its_outputs_are_those_of_the_surrogate(make_env, version, tmp_path):
    """Lags, thresholds and products are in that of the house."""
    found = surrogate_of(make_env, held=4, steps=100)
    with closing(FMUVectorEnv(make_env, 1, backend=found)) as envs:
        units = envs.prototype.fmu.description.units
        pool, spec = envs.pool, envs.prototype.pool_spec
        envs.reset(seed=3)
        names = [one.name for one in found.variables]
        can_be_set = [not is_start_time(one) for one in found.variables]
        starts = found.start.mean + np.where(can_be_set, found.start.deviation, 0.0)
        pool.reset(found.variables, starts[:, None])
        rng = np.random.default_rng(0)
        low = [one.start_number - 1 for one in spec.inputs]
        inputs = rng.uniform(low, np.add(low, 2), (20, len(low)))
        expected = [pool.outputs[:, 0].copy()]
        expected += [pool.step(row[:, None])[0][:, 0].copy() for row in inputs]
    file = write_fmu(
        agent_of_surrogate(found, "twin", units), tmp_path / "twin.fmu", fmi_version=version
    )
    assert validate_fmu(str(file)) == []
    description = fmpy.read_model_description(str(file))
    has = {one.name for one in description.modelVariables}
    assert has >= {one.name for one in (*spec.inputs, *spec.outputs)}
    given = {n: v for n, v in zip(names, starts.tolist(), strict=True) if n in has}
    assert len(given) == sum(can_be_set)
    played = simulated(file, description, spec, inputs, given)
    assert played == pytest.approx(np.array(expected), rel=1e-7, abs=1e-7)


def simulated(file, description, spec, inputs, starts):
    """The outputs at the start and after each step, by FMPy."""
    folder = fmpy.extract(str(file))
    fmu = fmpy.instantiate_fmu(folder, description, "CoSimulation")
    references = {one.name: one.valueReference for one in description.modelVariables}
    is_new = description.fmiVersion.startswith("3")
    read = fmu.getFloat64 if is_new else fmu.getReal
    write = fmu.setFloat64 if is_new else fmu.setReal
    if not is_new:
        fmu.setupExperiment(startTime=0.0)
    for name, value in starts.items():
        write([references[name]], [value])
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    outputs = [references[one.name] for one in spec.outputs]
    found = [read(outputs)]
    for place, row in enumerate(inputs):
        write([references[one.name] for one in spec.inputs], row.tolist())
        fmu.doStep(place * spec.time_step, spec.time_step)
        found.append(read(outputs))
    fmu.terminate()
    fmu.freeInstance()
    shutil.rmtree(folder, ignore_errors=True)
    return np.array(found)


def test_a_name_that_c_does_not_have_is_refused():
    with pytest.raises(ConfigError, match="letters"):
        agent_of_surrogate(surrogate_of(PendulumEnv, held=4, steps=40), "a-b", {})
