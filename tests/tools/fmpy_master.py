"""What a master does with FMUs that are in no algebraic loop, written once more over FMPy."""

import contextlib
import shutil

import fmpy
import numpy as np
from fmpy.simulation import instantiate_fmu

from fmugym.fmi.systems.system_plan import End


class Part:
    """One component from its start on.

    Args:
        component: Of a plan; its variables are floats.
        start_time: In seconds.
    """

    def __init__(self, component, start_time):
        self._folder = fmpy.extract(component.path)
        description = fmpy.read_model_description(self._folder, validate=False)
        version = int(description.fmiVersion[0])
        self._references = {v.name: v.valueReference for v in description.modelVariables}
        self._type = "Float64" if version == 3 else "Real"
        self._fmu = instantiate_fmu(self._folder, description, "CoSimulation")
        times = {"startTime": start_time}
        if version == 2:
            self._fmu.setupExperiment(**times)
        self.set(dict(component.starts))
        if version == 1:
            self._fmu.initialize(tStart=start_time)
        else:
            self._fmu.enterInitializationMode(**(times if version == 3 else {}))
            self._fmu.exitInitializationMode()

    def close(self):
        self._fmu.terminate()
        self._fmu.freeInstance()
        shutil.rmtree(self._folder)

    def get(self, name):
        return getattr(self._fmu, f"get{self._type}")([self._references[name]])[0]

    def set(self, values):
        references = [self._references[name] for name in values]
        getattr(self._fmu, f"set{self._type}")(references, list(values.values()))

    def step(self, time, step_size):
        self._fmu.doStep(time, step_size)


class Master:
    """A system from its start on.

    Args:
        plan: Of the system.
        start_time: In seconds.
    """

    def __init__(self, plan, start_time):
        self._plan, self._start_time, self._number = plan, start_time, 0
        self._ends = {connector.name: connector.ends for connector in plan.connectors}
        self._parts = {one.name: Part(one, start_time) for one in plan.components}
        for evaluation in plan.initialization:
            for index in evaluation.links:
                self._drive(plan.links[index], self._told(plan.links[index]))

    def close(self):
        for part in self._parts.values():
            part.close()

    def get(self, names):
        """The values of variables of components."""
        split = (name.partition(".") for name in names)
        return [self._parts[part].get(name) for part, _, name in split]

    def step(self, inputs, time_step):
        """Set the inputs of the system, and step all components by the order of their groups."""
        values = {link: self._told(link) for link in self._plan.links}
        self._set(inputs)
        for name in (name for group in self._plan.groups for name in group.components):
            for link in (link for link in self._plan.links if link.target == name):
                self._drive(link, values[link])
            self._step(name, time_step)
            if self._plan.master == "gauss_seidel":
                newest = (link for link in self._plan.links if link.source == name)
                values |= {link: self._told(link) for link in newest}
        self._number += 1

    def _set(self, inputs):
        for name, value in inputs.items():
            part, _, variable = name.partition(".")
            for end in self._ends.get(name, [End(part, variable)]):
                self._parts[end.component].set({end.variable: end.gain * value + end.offset})

    def _step(self, name, time_step):
        (steps,) = (one.steps for one in self._plan.components if one.name == name)
        for number in range(self._number * steps, (self._number + 1) * steps):
            step_size = time_step / steps
            self._parts[name].step(self._start_time + number * step_size, step_size)

    def _told(self, link):
        return self._parts[link.source].get(link.output)

    def _drive(self, link, value):
        self._parts[link.target].set({link.input: link.gain * value + link.offset})


def play(plan, outputs, steps, time_step, start_time=0.0):
    """The outputs at the start and after each step; the inputs of each step are by name."""
    with contextlib.closing(Master(plan, start_time)) as master:
        rows = [master.get(outputs)]
        for inputs in steps:
            master.step(inputs, time_step)
            rows.append(master.get(outputs))
    return np.array(rows)
