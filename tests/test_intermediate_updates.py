"""The intermediate update mode of FMI 3.0: outputs and inputs within a step."""

import logging
import math
import re
from contextlib import closing

import clocks_tools
import fmu_tools
import numpy as np
import pytest
import updates_tools
import values_tools
import wine_tools
from fmpy import extract
from fmpy.fmi3 import FMU3Slave, fmi3ValueReference
from pool_kinds import require_same_after_restoring
from updates_tools import MISCHIEFS, updating_fmu

import fmugym
from fmugym import FMU, ConfigError
from fmugym import pool as pools
from fmugym.pool import PoolSpec
from fmugym.pool.local import local_pool
from fmugym.trial import opening

LOG = logging.getLogger("fmugym.test")
OPTIONS = {
    "native": {"backend": "native"},
    "process": {"backend": "auto", "isolation": "process", "workers": 1},
}
all_kinds = pytest.mark.parametrize("kind", [*OPTIONS, "wine"])
all_but_wine = pytest.mark.parametrize("kind", list(OPTIONS))
both_backends = pytest.mark.parametrize("kind", ["python", "native"])
H, INNER = 0.1, 0.03
SAMPLINGS = ("mean", "integral", "min", "max", "last")


@pytest.fixture(scope="module", name="path")
def compiled(tmp_path_factory):
    return updating_fmu(tmp_path_factory.mktemp("updating") / "updating.fmu")


@pytest.fixture
def make_pool(request, path, tmp_path):
    made = []

    def make(kind, n=2, *, at=None, outputs="xxxxx", samplings=SAMPLINGS, linear=False, **spec):
        if kind == "native" and not pools.has_native_pool():
            pytest.skip("the C extension was not built")
        place = at or path
        if kind == "wine":
            request.getfixturevalue("wine")
            with wine_tools.building_for_windows():
                place = updating_fmu(tmp_path / "updating.fmu")
        fmu = FMU(place, probe_timeout=None)
        u = fmu.variable("u")
        ramped = (u,) if linear else ()
        told = tuple(map(fmu.variable, outputs))
        spec = {"time_step": H} | spec
        spec = PoolSpec((u,), told, samplings=samplings, ramped=ramped, **spec)
        pool = opening.make_pool(fmu, spec, n, LOG, **OPTIONS.get(kind, {}))
        pool.starts = tuple(map(fmu.variable, ("k", "mischief")))
        made.append(pool)
        return pool

    yield make
    for pool in made:
        pool.close()


def begin(pool, k=(0.5, 2.0), mischief=0):
    values = np.array([k[: pool.num_instances], [mischief] * pool.num_instances], float)
    pool.reset(pool.starts, values)
    assert not pool.statuses.any(), pool.failure(0)


def step(pool, u):
    outputs, statuses = pool.step(np.atleast_2d(np.asarray(u, float)))
    assert not statuses.any(), pool.failure(0)
    return outputs.copy()


def expected(k, actions, substeps=1, line=False):
    """The outputs of one instance by numpy: mean, integral, least, greatest and last value of x."""
    rows, x, before = [], 1.0, 0.0
    for number, action in enumerate(actions):
        parts = []
        for part in range(substeps):
            start = (number + part / substeps) * H

            def inputs(time, first=before, last=action, start=number * H):
                return first + (last - first) * (time - start) / H if line else last

            times, xs, _ = updates_tools.simulate(x, k, inputs, start, H / substeps, INNER)
            x = xs[-1]
            parts.append((updates_tools.mean(start, times, xs), xs.min(), xs.max()))
        means, lows, highs = np.array(parts).T
        rows.append((means.mean(), H * means.mean(), lows.min(), highs.max(), x))
        before = action
    return np.array(rows)


ACTIONS = np.array([[1.0, -2.0], [1.0, 0.5], [-4.0, 0.5], [0.0, 3.0]])


@all_kinds
@pytest.mark.parametrize("substeps", [1, 2])
@pytest.mark.parametrize("linear", [False, True])
def test_points_within_a_step_count(make_pool, kind, substeps, linear):
    pool = make_pool(kind, substeps=substeps, linear=linear)
    for _ in range(3):  # the third time, an episode may begin with a saved state
        begin(pool)
        found = np.array([step(pool, u) for u in ACTIONS])
        for i, k in enumerate((0.5, 2.0)):
            by_numpy = expected(k, ACTIONS[:, i], substeps, linear)
            np.testing.assert_allclose(found[:, :, i], by_numpy, rtol=1e-12)


def test_the_mean_of_a_decay_is_nearly_that_of_its_curve(tmp_path, make_pool):
    """That of exp(-t) over a step of 1 s is 1 - 1/e; without updates it would be 1/e."""
    fine = updating_fmu(tmp_path / "fine.fmu", 1e-4)
    pool = make_pool("native", 1, at=fine, outputs="x", samplings=("mean",), time_step=1.0)
    begin(pool, (1.0,))
    assert step(pool, 0.0)[0, 0] == pytest.approx(1.0 - math.exp(-1.0), rel=2e-4)


def test_a_line_drives_a_linear_system_nearly_as_its_closed_form(tmp_path, make_pool):
    """x' = u - x from x = 0 with u = t gives x = t - 1 + exp(-t)."""
    fine = updating_fmu(tmp_path / "fine.fmu", 1e-4)
    pool = make_pool(
        "native", 1, at=fine, outputs="x", samplings=(), linear=True, time_step=1.0, substeps=4
    )
    begin(pool, (1.0,))
    x = step(pool, 1.0)[0, 0] - math.exp(-1.0)  # the start value 1 decays
    assert x == pytest.approx(math.exp(-1.0), rel=5e-4)


@pytest.mark.parametrize("linear", [False, True])
def test_all_pools_give_the_same_numbers(make_pool, linear):
    if not pools.has_native_pool():
        pytest.skip("the C extension was not built")
    rows = []
    for kind in OPTIONS:
        pool = make_pool(kind, substeps=3, linear=linear, outputs="xyxyy")
        begin(pool)
        random = np.random.default_rng(2)
        rows.append([step(pool, random.uniform(-1, 1, 2)) for _ in range(20)])
    np.testing.assert_array_equal(rows[0], rows[1])
    np.testing.assert_array_equal(rows[0], rows[2])


@all_kinds
def test_a_restored_state_goes_on_alike(make_pool, kind):
    pool = make_pool(kind, linear=True)
    begin(pool)
    require_same_after_restoring(pool, step)


@both_backends
def test_fmpy_gives_the_same_points(make_pool, path, kind, tmp_path):
    """With its own callback, which sets and gets as the standard says."""
    pool = make_pool(kind, 1, linear=True)
    begin(pool, (2.0,))
    found = np.array([step(pool, u)[:, 0] for u in ACTIONS[:, 0]])
    by_fmpy, line = [], (0.0, 0.0, 0.0)

    def update(_, time, set_requested, get_allowed, finished, *__):
        if set_requested:
            start, first, last = line
            slave.setFloat64([u], [first + (last - first) * (time - start) / H])
        if get_allowed and finished:
            points.append((time, *slave.getFloat64([x])))

    description = FMU(path).description
    x, u, k = (description.variables[name].value_reference for name in ("x", "u", "k"))
    slave = FMU3Slave(
        guid=description.instantiation_token,
        unzipDirectory=extract(path, tmp_path / "extracted"),
        modelIdentifier=description.model_identifier,
        instanceName="by_fmpy",
    )
    wanted = (fmi3ValueReference * 2)(u, x)
    slave.instantiate(intermediateUpdate=update, requiredIntermediateVariables=wanted)
    slave.setFloat64([k], [2.0])
    slave.enterInitializationMode(startTime=0.0)
    slave.exitInitializationMode()
    before = 0.0
    for number, action in enumerate(ACTIONS[:, 0]):
        points, line = [], (number * H, before, action)
        slave.setFloat64([u], [before])
        slave.doStep(number * H, H)
        times, values = np.array(points).T
        area = updates_tools.mean(number * H, times, values)
        by_fmpy.append((area, area * H, values.min(), values.max(), values[-1]))
        before = action
    slave.terminate()
    slave.freeInstance()
    np.testing.assert_allclose(found, by_fmpy, rtol=1e-12)


FAULTS = {
    "after_the_step": r"0\.101.* 0 s to 0\.1",
    "before_the_step": r"-0\.001.* 0 s to 0\.1",
    "backwards": r"0\.01[0-9]* s .*0\.02[0-9]* s|0\.0149.*0\.029|0\.015.*0\.03",
    "no_time": "nan",
    "in_a_thread": "thread",
    "for_another": "another instance",
    "no_get": "reading outputs.*0\\.0[23]",
    "no_set": "setting inputs.* 0 s",
    "no_inputs": "asked for no inputs",
}


@both_backends
@pytest.mark.parametrize("name", FAULTS)
def test_faults_in_an_update_end_the_episode(make_pool, kind, name):
    pool = make_pool(kind, linear=True)
    begin(pool, mischief=MISCHIEFS[name])
    _, statuses = pool.step(np.ones((1, 2)))
    assert (statuses == 3).all()
    assert re.search(FAULTS[name], pool.failure(1)), pool.failure(1)
    begin(pool)
    np.testing.assert_allclose(
        step(pool, ACTIONS[0])[:, 1], expected(2.0, ACTIONS[:1, 1], line=True)[0], rtol=1e-12
    )


@both_backends
@pytest.mark.parametrize("name", ["tentative_points", "in_an_update"])
def test_what_does_not_count(make_pool, kind, name):
    """Steps that the FMU does not accept, and updates within updates."""
    pool = make_pool(kind, linear=True)
    begin(pool, mischief=MISCHIEFS[name])
    found = [step(pool, u)[:, 1] for u in ACTIONS]
    np.testing.assert_allclose(found, expected(2.0, ACTIONS[:, 1], line=True), rtol=1e-12)


@both_backends
def test_without_points_the_end_of_the_substep_counts(make_pool, kind):
    pool = make_pool(kind, substeps=2)
    fine = make_pool(kind, time_step=H / 2, outputs="x", samplings=())
    begin(pool, mischief=MISCHIEFS["no_outputs"])
    begin(fine)
    for u in ACTIONS:
        halves = np.array([step(fine, u)[0] for _ in range(2)])
        means = halves.sum(axis=0) / 2
        lows, highs = halves.min(axis=0), halves.max(axis=0)
        sums = halves.sum(axis=0) * (H / 2)
        np.testing.assert_array_equal(step(pool, u), [means, sums, lows, highs, halves[1]])


@all_but_wine
def test_points_of_smaller_steps_count_after_a_discarded_one(tmp_path, make_pool, kind):
    hesitant = updating_fmu(tmp_path / "hesitant.fmu", more=("-DLONGEST=0.06",))
    pool = make_pool(kind, 1, at=hesitant, fault_retries=1)
    begin(pool, (2.0,))
    first = updates_tools.simulate(1.0, 2.0, lambda _: 1.0, 0.0, H / 2)
    second = updates_tools.simulate(first[1][-1], 2.0, lambda _: 1.0, H / 2, H / 2)
    times, xs = np.concatenate([first, second], axis=1)[:2]
    mean = updates_tools.mean(0.0, times, xs)
    assert step(pool, 1.0)[:2, 0] == pytest.approx([mean, H * mean], rel=1e-12)
    assert pool.info()["retries"].tolist() == [1]


@all_but_wine
def test_an_early_return_changes_nothing(tmp_path, make_pool, kind):
    """The FMU returns at its third internal step, and then goes on."""
    hasty = updating_fmu(tmp_path / "hasty.fmu", more=("-DEARLY=0.06",))
    pool = make_pool(kind, 1, at=hasty, linear=True)
    begin(pool, (2.0,))
    found = [step(pool, u)[:, 0] for u in ACTIONS[:, 0]]
    by_numpy = expected(2.0, ACTIONS[:, 0], line=True)
    np.testing.assert_allclose(found, by_numpy, rtol=1e-12)


@all_but_wine
@pytest.mark.parametrize("substeps", [1, 2])
def test_event_mode(tmp_path, make_pool, kind, substeps):
    """The FMU, whose x is the time, tells the middle and the end of its steps between events."""
    place = clocks_tools.clocks_fmu(tmp_path / "clocks.fmu", flags=updates_tools.PROVIDES)
    fmu = FMU(place, probe_timeout=None)
    spec = PoolSpec((), (fmu.variable("x"),), 0.13, samplings=("mean",), substeps=substeps)
    events = np.union1d(0.05 + 0.1 * np.arange(30), 0.25 * np.arange(12))  # of the first clocks
    with closing(opening.make_pool(fmu, spec, 1, LOG, **OPTIONS[kind])) as pool:
        pool.reset((), np.zeros((0, 1)))
        plain = [pool.step(np.zeros((0, 1)))[0][0, 0] for _ in range(8)]
        assert not pool.statuses.any(), pool.failure(0)
    starts = 0.13 * np.arange(8)
    # the mean of the time but for the first half of the first step, where its end counts
    below = np.array(plain) - (starts + 0.065)
    assert (below > 0).all()
    longest = np.diff(events).max() / 2
    assert (below <= 0.5 * longest**2 / (0.13 / substeps) + 1e-12).all()


class Env(fmugym.FMUEnv):
    def _is_done(self):
        return False


CONFIG = {
    "model_input_names": ["u"],
    "model_output_names": ["x"],
    "monitor_names": ["y"],
    "bounds": {"u": (-10, 10)},
    "time_step": H,
    "model_parameters": {"k": 2.0},
    "samplings": {"x": "mean", "y": "max"},
    "input_interpolation": "linear",
}


def test_environments(path):
    isolated = CONFIG | {"isolation": "process"}
    with (
        closing(Env(path, CONFIG)) as env,
        closing(Env(path, isolated)) as apart,
        closing(fmugym.FMUVectorEnv(lambda: Env(path, CONFIG), num_envs=3)) as envs,
        closing(fmugym.FMUVectorEnv(lambda: Env(path, isolated), num_envs=3)) as envs_apart,
    ):
        for one in (env, apart, envs, envs_apart):
            one.reset(seed=1)
        means = expected(2.0, ACTIONS[:, 0], line=True)[:, 0]
        for action, mean in zip(ACTIONS[:, 0], means, strict=True):
            u = np.array([action], np.float32)
            seen = env.step(u)[0]
            assert seen == pytest.approx([mean], rel=1e-6)
            assert np.array_equal(apart.step(u)[0], seen)
            many = np.tile(u, (3, 1))
            for each in (envs, envs_apart):
                assert np.array_equal(each.step(many)[0], np.tile(seen, (3, 1)))
        snapshot = env.save_state()
        first = env.step(np.array([1.0]))[0]
        env.restore_state(snapshot)
        assert env.step(np.array([1.0]))[0] == first


@pytest.mark.parametrize(
    ("changes", "facts"),
    [
        ({"flags": ""}, ["'u'", "providesIntermediateUpdate"]),
        ({"updated": ("x", "y")}, ["'u'", "(intermediateUpdate"]),
    ],
)
def test_inputs_that_cannot_be_linear_are_named(tmp_path, changes, facts):
    place = updating_fmu(tmp_path / "updating.fmu", **changes)
    with pytest.raises(ConfigError) as caught:
        Env(place, CONFIG)
    assert all(fact in str(caught.value) for fact in facts)


def test_inputs_in_event_mode_cannot_be_linear(tmp_path):
    place = clocks_tools.clocks_fmu(tmp_path / "clocks.fmu", flags=updates_tools.PROVIDES)
    config = {"model_input_names": "plain", "model_output_names": "x", "time_step": H}
    config |= {"input_interpolation": "linear", "bounds": {"plain": (0, 1)}}
    with pytest.raises(ConfigError, match=r"'plain'|event mode"):
        Env(place, config)


@both_backends
@pytest.mark.parametrize("changes", [{"flags": ""}, {"updated": ("u",)}])
def test_fmus_that_tell_nothing_are_not_asked(tmp_path, make_pool, kind, changes):
    """Otherwise this FMU would tell: its ``calls`` count updates that anybody wants."""
    place = updating_fmu(tmp_path / "updating.fmu", **changes)
    pool = make_pool(kind, 1, at=place)
    begin(pool, (2.0,))
    last = expected(2.0, [1.0])[0, -1]
    assert step(pool, 1.0)[:, 0] == pytest.approx([last, H * last, last, last, last], rel=1e-12)


@both_backends
def test_components_of_systems_have_linear_inputs(path, kind):
    if kind == "native" and not pools.has_native_pool():
        pytest.skip("the C extension was not built")
    fmu = fmugym.FMUSystem({"a": path}).as_fmu()
    u = fmu.variable("a.u")
    outputs = (fmu.variable("a.x"), fmu.variable("a.x"))
    spec = PoolSpec((u,), outputs, H, samplings=("mean", "last"), substeps=2, ramped=(u,))
    with closing(local_pool(fmu, spec, 1, LOG, native=kind == "native")) as pool:
        pool.reset((fmu.variable("a.k"),), np.array([[2.0]]))
        found = np.array([step(pool, action)[:, 0] for action in ACTIONS[:, 0]])
    x, before = 1.0, 0.0
    for number, (row, action) in enumerate(zip(found, ACTIONS[:, 0], strict=True)):
        ends = []
        for part in (0, 0.5):

            def line(time, number=number, first=before, last=action):
                return first + (last - first) * (time - number * H) / H

            x = updates_tools.simulate(x, 2.0, line, (number + part) * H, H / 2)[1][-1]
            ends.append(x)
        assert row == pytest.approx([np.mean(ends), x], rel=1e-12)
        before = action


@pytest.fixture(name="arrays")
def state_space(tmp_path):
    path = values_tools.state_space_fmu(tmp_path / "plain.fmu", ("CoSimulation",))
    kept = {"<CoSimulation ": f"<CoSimulation {updates_tools.PROVIDES} "}
    kept |= {f'name="{name}"': f'name="{name}" intermediateUpdate="true"' for name in "ux"}
    return fmu_tools.edited_fmu(path, tmp_path, kept)


@all_but_wine
def test_elements_of_arrays_are_told(arrays, kind):
    """With u = 1, x[2] is (1 - exp(-2 t)) / 4, of which a step of 1 s gives the mean."""
    fmu = FMU(arrays, probe_timeout=None)
    outputs = tuple(map(fmu.variable, ("x[2]", "y[1]", "x[2]")))
    spec = PoolSpec((fmu.variable("u[1]"),), outputs, 1.0, samplings=("mean", "mean", "last"))
    with closing(opening.make_pool(fmu, spec, 2, LOG, **OPTIONS[kind])) as pool:
        pool.reset((), np.zeros((0, 2)))
        found = step(pool, [1.0, 1.0])
    end = 0.25 * (1.0 - math.exp(-2.0))
    np.testing.assert_allclose(found[0], 0.25 - end / 2, rtol=1e-4)
    np.testing.assert_allclose(found[2], end, rtol=1e-9)


def test_elements_of_arrays_cannot_be_linear(arrays):
    config = {"model_input_names": "u", "model_output_names": "x", "time_step": H}
    with pytest.raises(ConfigError, match=r"'u\[1\]' cannot be linear.*element"):
        Env(arrays, config | {"input_interpolation": {"u": "linear"}})
