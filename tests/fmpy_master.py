"""What a master does with FMUs that are in no algebraic loop, written once more over FMPy."""

import contextlib

import numpy as np
from fresh import FreshInstance

from fmugym.systems.plan import End


class Master:
    """A system from its start on; a context manager.

    Args:
        plan: Of the system.
        start_time: In seconds.
    """

    def __init__(self, plan, start_time=0.0):
        self._plan, self._number = plan, 0
        self._ends = {connector.name: connector.ends for connector in plan.connectors}
        self._components = {one.name: one for one in plan.components}
        self._stack = contextlib.ExitStack()
        self._parts = {
            name: self._stack.enter_context(
                FreshInstance(one.path, dict(one.starts), start_time=start_time)
            )
            for name, one in self._components.items()
        }
        for evaluation in plan.initialization:
            for index in evaluation.links:
                self._drive(plan.links[index], self._told(plan.links[index]))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stack.close()

    def get(self, names):
        """The values of variables of components."""
        split = (name.partition(".") for name in names)
        return [self._parts[part].get([name])[0] for part, _, name in split]

    def step(self, inputs, time_step):
        """Set the inputs of the system, and step all components by the order of their groups."""
        values = {link: self._told(link) for link in self._plan.links}
        self._set(inputs)
        for name in (name for group in self._plan.groups for name in group.components):
            for link in (link for link in self._plan.links if link.target == name):
                self._drive(link, values[link])
            steps = self._components[name].steps
            for inner in range(steps):
                self._parts[name].step(self._number * steps + inner, time_step / steps)
            if self._plan.master == "gauss_seidel":
                newest = (link for link in self._plan.links if link.source == name)
                values |= {link: self._told(link) for link in newest}
        self._number += 1

    def _set(self, inputs):
        for name, value in inputs.items():
            part, _, variable = name.partition(".")
            for end in self._ends.get(name, [End(part, variable)]):
                self._parts[end.component].set({end.variable: end.gain * value + end.offset})

    def _told(self, link):
        return self.get([f"{link.source}.{link.output}"])[0]

    def _drive(self, link, value):
        self._parts[link.target].set({link.input: link.gain * value + link.offset})


def play(plan, outputs, steps, time_step, start_time=0.0):
    """The outputs at the start and after each step; the inputs of each step are by name."""
    with Master(plan, start_time) as master:
        rows = [master.get(outputs)]
        for inputs in steps:
            master.step(inputs, time_step)
            rows.append(master.get(outputs))
    return np.array(rows)
