"""Episodes as FMPy plays them: each on a fresh instance of a fresh copy of the library."""

import contextlib
import ctypes
import math
import os
import shutil
import tempfile
import zipfile
from pathlib import Path

import fmpy
import numpy as np
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import fmi2Discard, fmi2Terminated
from fmpy.simulation import (
    apply_start_values,
    has_start_value,
    instantiate_fmu,
    settable_in_initialization_mode,
    settable_in_instantiated,
)


class FreshInstance:
    """One instance, as FMPy's own simulation sets it up; a context manager.

    Args:
        path: The FMU.
        start_values: Values by name that are set before the initialization.
        start_time: In seconds.
        tolerance: Of the solver, relative; None if it is left to the FMU.
    """

    def __init__(self, path, start_values=None, *, start_time=0.0, tolerance=None):
        self._directory = os.getcwd()
        self._folder = extract(path)
        self.description = fmpy.read_model_description(self._folder, validate=False)
        self._variables = {v.name: v for v in self.description.modelVariables}
        self._version = int(self.description.fmiVersion[0])
        self._start_time = start_time
        self._fmu = None
        try:
            self._fmu = self._instantiate()
            self._initialize(start_values or {}, tolerance)
        except BaseException:
            self.close()
            raise

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        """Free the instance and its files."""
        if self._fmu is not None:
            with contextlib.suppress(FMICallException):
                self._fmu.terminate()
            self._fmu.freeInstance()  # and its library
            self._fmu = None
        os.chdir(self._directory)  # which the FMU may have changed
        shutil.rmtree(self._folder, ignore_errors=True)

    def _instantiate(self):
        fmu = instantiate_fmu(self._folder, self.description, "CoSimulation")
        if self._version == 1:  # FMPy declares strings, and dereferences every status except OK
            for name in ("fmi1InitializeSlave", "fmi1DoStep"):
                fmu._functions[name].restype = ctypes.c_int
        if not fmu.component:
            raise RuntimeError("it could not be instantiated")
        return fmu

    def _initialize(self, values, tolerance):
        def apply(settable):
            apply_start_values(self._fmu, self.description, values, settable=settable)

        if self._version == 1:
            apply(has_start_value)
            self._fmu.initialize(tStart=self._start_time)
            return
        times = {"startTime": self._start_time, "tolerance": tolerance}
        if self._version == 2:
            self._fmu.setupExperiment(**times)
        apply(settable_in_instantiated)
        self._fmu.enterInitializationMode(**(times if self._version == 3 else {}))
        apply(settable_in_initialization_mode)
        self._fmu.exitInitializationMode()

    def get(self, names):
        """The values of variables and of elements of arrays, such as ``y[2]``, as floats."""
        return [self._get(name) for name in names]

    def get_at_start(self, names):
        """The same before the first step; start values if the FMU cannot be read yet."""
        try:
            return self.get(names)
        except FMICallException:
            return [float(self._variables[name].start or 0.0) for name in names]

    def _get(self, name):
        variable, element = self._found(name)
        return float(self._all(variable)[element])

    def set(self, values):
        """Set variables by name."""
        for name, value in values.items():
            variable, element = self._found(name)
            convert = {"Real": float, "Float64": float, "Float32": float, "Boolean": bool}
            changed = [0] if not variable.shape else self._all(variable)
            changed[element] = convert.get(variable.type, round)(float(value))
            getattr(self._fmu, f"set{self._kind(variable)}")([variable.valueReference], changed)

    def _found(self, name):
        """The variable that a name stands for, and the place of the element in it."""
        if name in self._variables:
            return self._variables[name], 0
        array, _, place = name.removesuffix("]").rpartition("[")
        variable = self._variables[array]
        indices = [int(index) - 1 for index in place.split(",")]
        return variable, int(np.ravel_multi_index(indices, variable.shape))

    def _all(self, variable):
        get = getattr(self._fmu, f"get{self._kind(variable)}")
        if not variable.shape:
            return get([variable.valueReference])
        return get([variable.valueReference], nValues=math.prod(variable.shape))

    def _kind(self, variable):
        if variable.type == "Enumeration":
            return "Int64" if self._version == 3 else "Integer"
        return variable.type

    def step(self, number, step_size):
        """Do the step of a number, counted from 0; returns whether the episode goes on."""
        time = self._start_time + number * step_size
        try:
            result = self._fmu.doStep(time, step_size)
        except FMICallException as error:
            discarded = error.status == fmi2Discard and self._version == 2
            if discarded and self._fmu.getBooleanStatus(fmi2Terminated):
                return False
            raise
        return not (self._version == 3 and result[1])


def extract(path):
    """Extract an FMU as FMPy does, but let it have backslashes in the names of its files."""
    folder = tempfile.mkdtemp()
    with zipfile.ZipFile(path) as archive:
        for name in filter(lambda name: name[-1] not in "/\\", archive.namelist()):
            file = Path(folder, name.replace("\\", "/"))
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(archive.read(name))
    return folder


def play(path, outputs, rows, step_size, start_values=None, **options):
    """Play an episode.

    Args:
        path: The FMU.
        outputs: Names.
        rows: For each step the inputs by name.
        step_size: In seconds.
        start_values: As ``FreshInstance`` takes them, like the options.

    Returns:
        The outputs of the start and of each step; fewer if the FMU asked to stop.
    """
    with FreshInstance(path, start_values, **options) as instance:
        results = [instance.get_at_start(outputs)]
        for number, row in enumerate(rows):
            instance.set(row)
            goes_on = instance.step(number, step_size)
            results.append(instance.get(outputs))
            if not goes_on:
                break
        return results
