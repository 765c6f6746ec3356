"""No order of public calls, with faults anywhere, makes an FMI call that the standard forbids.

The FMU knows the standards' state machines and notes illegal calls (``lawful.c``).
"""

import contextlib
import copy
import gc
import logging
import pickle
import warnings

import lawful_tools
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from ways import in_way

from fmugym import FMU, FMUGymError
from fmugym.environment.vector import FMUVectorEnv
from fmugym.pool import PoolSpec
from fmugym.pool.opening import PoolOptions, open_pool

LOG = logging.getLogger("fmugym.test")
N = 3
SETTINGS = settings(
    max_examples=25,
    stateful_step_count=15,
    phases=[Phase.generate],  # to shrink a failure takes minutes
    deadline=None,
    derandomize=True,
    database=None,
    print_blob=False,
    suppress_health_check=list(HealthCheck),
)
CODES = {"get": lawful_tools.NOT_A_NUMBER, "step": lawful_tools.STOP}
FAULTS = st.sampled_from((*lawful_tools.CALLS, "step", "step", "get", "set", "reset")).flatmap(
    lambda call: st.tuples(
        st.just(call), st.integers(1, 3), st.integers(1, 4) | st.just(CODES.get(call, 3))
    )
)
GAINS = st.sampled_from([1.0, 2.0])
ACTIONS = st.sampled_from([0.5, 0.5, -1.0, -1.0, np.nan])
MASKS = st.lists(st.booleans(), min_size=N, max_size=N).map(np.array)


class LawfulEnv(lawful_tools.LawfulEnv):
    """Ends its task now and then."""

    steps_after_end = True

    def _is_done(self):
        return self.state[0] < -1.5


class Machine(RuleBasedStateMachine):
    """What all kinds have in common.

    A kind has ``make``, which returns the subject; and ``start`` and ``advance``, which reset and
    step it.
    """

    def __init__(self, path, version, record):
        super().__init__()
        self.path, self.version, self.record = path, version, record
        record.clear()
        self.subject = None

    @initialize(
        retries=st.sampled_from([0, 2]),
        substeps=st.sampled_from([1, 2]),
        mode=st.sampled_from(["next_step", "same_step", "disabled"]),
        way=st.sampled_from(["arrays", "one by one"]),
    )
    def begin(self, retries, substeps, mode, way):
        self.options = {"substeps": substeps, "fault_retries": retries if self.version > 1 else 0}
        self.way, self.vector_options = way, {"autoreset_mode": mode}
        self.subject = self.make()

    @rule(fault=FAULTS)
    def plan(self, fault):
        """Let a call fail that is still to come."""
        self.record.plan(*fault)

    @rule()
    def collect(self):
        gc.collect(1)

    @rule(abandoned=st.booleans(), uses=st.integers(0, 3))
    def begin_anew(self, abandoned, uses):
        """Give up what there is, or close it and try to go on all the same."""
        if not abandoned:
            self.subject.close()
            self.advance_often(uses)
        with self.faults():
            self.subject = self.make()

    @rule(faults=st.lists(FAULTS, max_size=2), uses=st.integers(1, 4))
    def run_into_faults(self, faults, uses):
        """An episode with faults that come soon, and what follows it."""
        with self.faults():
            self.start()
        for fault in faults:
            self.record.plan(*fault)
        self.advance_often(uses)

    def advance_often(self, count):
        for _ in range(count):
            with self.faults():
                self.advance()

    @contextlib.contextmanager
    def faults(self):
        """What the project raises is fine; anything else is not."""
        with contextlib.suppress(FMUGymError), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield

    @invariant()
    def nothing_illegal(self):
        assert self.record.illegal == ""

    def teardown(self):
        if self.subject is not None:
            self.subject.close()
        self.subject = None
        gc.collect(1)
        assert self.record.illegal == ""


class SingleMachine(Machine):
    def start(self):
        self.subject.reset()

    def advance(self):
        self.subject.step([0.5])

    def make(self):
        return LawfulEnv(self.path, **self.options)

    @rule(gain=GAINS, override=st.booleans())
    def reset(self, gain, override):
        with self.faults():
            self.subject.reset(options={"model_parameters": {"k": gain}} if override else None)

    @rule(actions=st.lists(ACTIONS, min_size=1, max_size=4))
    def step(self, actions):
        for action in actions:
            with self.faults():
                self.subject.step([action])

    @rule(name=st.sampled_from(["u", "y", "k", "z"]))
    def read(self, name):
        with self.faults():
            self.subject.read_variables(name)

    @rule()
    def look(self):
        with self.faults():
            self.subject.render()
        with self.faults():
            assert self.subject.health["steps"] >= 0

    @rule(
        clone=st.sampled_from([copy.copy, copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
    )
    def clone(self, clone):
        with self.faults():
            self.subject = clone(self.subject)


class VectorMachine(Machine):
    def start(self):
        self.subject.reset()

    def advance(self):
        self.subject.step(np.full((N, 1), 0.5))

    def make(self):
        options = {"private_libraries": False} | self.vector_options
        make = in_way(self.way, lambda: LawfulEnv(self.path, **self.options))
        return FMUVectorEnv(make, N, **options)

    @rule(mask=MASKS, masked=st.booleans())
    def reset(self, mask, masked):
        with self.faults():
            self.subject.reset(options={"reset_mask": mask} if masked else None)

    @rule(actions=st.lists(ACTIONS, min_size=N, max_size=N), count=st.integers(1, 4))
    def step(self, actions, count):
        for _ in range(count):
            with self.faults():
                self.subject.step(np.array(actions)[:, None])

    @rule(gain=GAINS)
    def set_attr(self, gain):
        with self.faults():
            self.subject.set_attr("k", [gain, 1.0, 1.0])

    @rule(name=st.sampled_from(["y", "k"]))
    def read(self, name):
        with self.faults():
            self.subject.call("read_variables", name)

    @rule()
    def look(self):
        with self.faults():
            self.subject.render()
        with self.faults():
            assert (self.subject.health["steps"] >= 0).all()


class PoolMachine(Machine):
    def start(self):
        self.subject.reset((self.gain,), np.ones((1, N)))

    def advance(self):
        self.subject.step(np.full((1, N), 0.5))

    def make(self):
        fmu = FMU(self.path)
        spec = PoolSpec((fmu.variable("u"),), (fmu.variable("y"),), 0.5, **self.options)
        self.snapshots = []
        self.gain = fmu.variable("k")
        return open_pool(fmu, spec, N, LOG, PoolOptions(private_libraries=False))

    @rule(gain=GAINS, mask=st.none() | MASKS)
    def reset(self, gain, mask):
        with self.faults():
            self.subject.reset((self.gain,), np.full((1, N), gain), mask)

    @rule(action=ACTIONS, skip=st.none() | MASKS, count=st.integers(1, 4))
    def step(self, action, skip, count):
        for _ in range(count):
            with self.faults():
                self.subject.step(np.array([[0.5, action, 0.5]]), skip)

    @rule()
    def save(self):
        with self.faults():
            self.snapshots.append(self.subject.save())

    @precondition(lambda self: getattr(self, "snapshots", None))
    @rule(data=st.data(), mask=st.none() | MASKS)
    def restore(self, data, mask):
        with self.faults():
            self.subject.restore(data.draw(st.sampled_from(self.snapshots)), mask)

    @precondition(lambda self: getattr(self, "snapshots", None))
    @rule()
    def forget(self):
        self.snapshots.pop(0)

    @rule()
    def look(self):
        with self.faults():
            self.subject.read((self.gain,))
        with self.faults():
            self.subject.failure(0)


@pytest.fixture(name="record")
def fixture_record(tmp_path, monkeypatch):
    """The file where the FMU notes illegal calls."""
    record = lawful_tools.Record(tmp_path)
    monkeypatch.setenv("LAWFUL_RECORD", str(record.path))
    return record


@pytest.mark.parametrize(
    ("machine", "version"),
    [(SingleMachine, 2), (VectorMachine, 3), *((PoolMachine, version) for version in (1, 2, 3))],
)
def test_no_illegal_call(machine, version, record, tmp_path):
    path = lawful_tools.lawful_fmu(tmp_path, version)
    run_state_machine_as_test(lambda: machine(path, version, record), settings=SETTINGS)
