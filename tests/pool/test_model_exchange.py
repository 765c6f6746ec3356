"""Model exchange: solvers, events, pools and environments."""

import functools
import math
import re

import exchange_tools
import fmu_tools
import numpy as np
import pytest
import wine_tools
from combinations import in_turn
from pool_tools import KINDS, open_pool, start, step
from scipy.integrate import solve_ivp

import fmugym
from fmugym import FMU, ConfigError, FMULoadError
from fmugym.cli.class_skeleton import Skeleton
from fmugym.cli.task_proposal import Proposal
from fmugym.control.linearization import linearize
from fmugym.fmi import Status
from fmugym.pool.pool_spec import SOLVERS
from fmugym.pool.states import SaveMethod

DERIVATIVES = 'providesDirectionalDerivative="true"'
all_solvers = pytest.mark.parametrize("solver", SOLVERS)
all_versions = pytest.mark.parametrize("version", [1, 2, 3])
each_solver_and_version = in_turn(
    {
        "kind,version": [
            *(("native", version) for version in (1, 2, 3, 2)),
            *(("wine", version) for version in (1, 3)),
        ],
        "solver": SOLVERS,
    }
)
with_states = pytest.mark.parametrize("version", [2, 3])


@pytest.fixture(scope="session")
def fmu_path(tmp_path_factory):
    """Write FMUs of the models, each once."""

    @functools.cache
    def make(model, version=2, interfaces=("ModelExchange",), flags="", tools=exchange_tools):
        path = tmp_path_factory.mktemp("exchange") / f"{model}.fmu"
        return tools.exchange_fmu(path, model, version, interfaces, flags)

    return make


@pytest.fixture
def make_pool(request, fmu_path, opened):
    """Make pools that are closed after the test."""

    def make(model, step, kind="native", n=1, inputs=(), outputs=None, version=2, flags="", **spec):
        if kind == "wine":
            request.getfixturevalue("wine")
        tools = wine_tools if kind == "wine" else exchange_tools
        fmu = FMU(fmu_path(model, version, flags=flags, tools=tools), probe_timeout=None)
        outputs = exchange_tools.STATES[model] if outputs is None else outputs
        return opened(open_pool(fmu, inputs, outputs, step, n, KINDS.get(kind, {}), **spec))

    return make


def run(pool, steps, values=None):
    """Reset a pool of one, and do steps; the outputs after each, shape (steps + 1, k)."""
    rows = [start(pool, values).outputs[:, 0].copy()]
    return np.array(rows + [step(pool)[:, 0] for _ in range(steps)])


class TestSolvers:
    @in_turn({"tolerance": [1e-4, 1e-6, 1e-8], "solver": ["dormand_prince", "rosenbrock"]})
    def test_adaptive_steps_keep_the_tolerance(self, make_pool, solver, tolerance):
        pool = make_pool("van_der_pol", 0.5, solver=solver, tolerance=tolerance)
        found = run(pool, 20)
        expected = solve_ivp(
            lambda t, x: [x[1], (1 - x[0] ** 2) * x[1] - x[0]],
            (0, 10),
            [2, 0],
            rtol=1e-12,
            atol=1e-12,
            t_eval=np.linspace(0, 10, 21),
            method="DOP853",
        ).y.T
        errors = np.abs(found - expected).max()
        assert errors < 30 * tolerance
        assert errors > 1e-4 * tolerance  # a method that ignored it would be much better or worse

    @pytest.mark.parametrize("flags", ["", DERIVATIVES], ids=["differences", "derivatives"])
    def test_stiff_equations_may_depend_on_time(self, make_pool, flags):
        pool = make_pool("prothero", 0.25, solver="rosenbrock", tolerance=1e-5, flags=flags)
        found = run(pool, 20, {"k": 1e6})[:, 0]
        np.testing.assert_allclose(found, np.cos(0.25 * np.arange(21)), atol=2e-5)

    @pytest.mark.parametrize("flags", ["", DERIVATIVES], ids=["differences", "derivatives"])
    def test_stiff_kinetics_agree_with_scipy(self, make_pool, flags):
        pool = make_pool("robertson", 4.0, solver="rosenbrock", tolerance=1e-7, flags=flags)
        np.testing.assert_allclose(run(pool, 10), robertson(4.0, 10), rtol=3e-6)

    def test_the_stiff_solver_is_not_held_back_by_stiffness(self, make_pool):
        pool = make_pool("robertson", 1e6, solver="rosenbrock")
        np.testing.assert_allclose(run(pool, 1), robertson(1e6, 1), rtol=1e-3)

    @all_solvers
    def test_inputs_take_effect_at_once(self, make_pool, solver):
        pool = make_pool("dahlquist", 0.1, inputs=["u"], solver=solver, max_step=0.001)
        start(pool, {"x": 0})
        x = 0.0
        for u in (1, -2, -2, 3):
            x = u + (x - u) * math.exp(-0.1)
            assert step(pool, u)[0, 0] == pytest.approx(x, abs=2e-4 if solver == "euler" else 1e-6)

    @pytest.mark.parametrize(
        ("kind", "solver"),
        [("native", "dormand_prince"), ("native", "rosenbrock"), ("wine", "rosenbrock")],
    )
    def test_adaptive_steps_get_shorter_where_the_fmu_discards(self, make_pool, solver, kind):
        outputs = ["x", "discards"]
        pool = make_pool("tank", 0.19, kind, outputs=outputs, solver=solver, tolerance=0.01)
        x, discards = run(pool, 1)[-1]
        assert x == pytest.approx(0.005**2, abs=2e-5)
        assert discards > 0

    def test_fixed_steps_are_retried_where_the_fmu_discards(self, make_pool):
        pool = make_pool("tank", 0.09, solver="rk4")
        start(pool)
        assert [int(pool.step()[1][0]) for _ in range(2)] == [0, Status.DISCARD]
        pool = make_pool("tank", 0.09, solver="rk4", fault_retries=3)
        assert run(pool, 2)[-1, 0] == pytest.approx(0.01**2, abs=1e-5)
        assert pool.health()["retries"].tolist() == [2]  # with 2 parts, and with 4

    def test_a_step_that_gets_too_small_is_a_fault(self, make_pool):
        pool = make_pool("van_der_pol", 0.1)
        start(pool, {"mu": 1e200})
        _, statuses = pool.step()
        assert statuses[0] == Status.ERROR
        assert "dormand_prince" in pool.failure(0)
        start(pool, {"mu": 1.0})
        _, statuses = pool.step()
        assert not statuses[0]


class TestEvents:
    @staticmethod
    def height(t, h=1.0, g=9.81, e=0.7):
        """The ball's height in closed form, before it comes to rest."""
        duration = math.sqrt(2 * h / g)
        if t < duration:
            return h - g * t * t / 2
        t, v = t - duration, g * duration
        while True:
            v *= e
            if t < 2 * v / g:
                return v * t - g * t * t / 2
            t -= 2 * v / g

    @each_solver_and_version
    def test_bounces_are_where_the_closed_form_has_them(self, make_pool, solver, version, kind):
        spec = {"solver": solver, "max_step": 1e-3}
        pool = make_pool("ball", 0.05, kind, outputs=["h"], version=version, **spec)
        found = run(pool, 40)[:, 0]
        expected = [self.height(0.05 * i) for i in range(41)]
        tolerance = 2e-2 if solver == "euler" else 1e-8
        np.testing.assert_allclose(found, expected, atol=tolerance)

    @pytest.mark.parametrize("solver", ["rk4", "dormand_prince", "rosenbrock"])
    def test_the_ball_comes_to_rest(self, make_pool, solver):
        outputs = ["h", "v", "bounces"]
        pool = make_pool("ball", 5.0, outputs=outputs, solver=solver)
        speed, bounces = math.sqrt(2 * 9.81), 0
        while speed >= 0.1:
            speed, bounces = 0.7 * speed, bounces + 1
        assert run(pool, 1)[-1].tolist() == [0, 0, bounces]

    def test_bounces_without_end_are_a_fault(self, make_pool):
        pool = make_pool("ball", 1.0)
        start(pool, {"v_min": 0})
        statuses = [int(pool.step()[1][0]) for _ in range(3)]
        assert statuses == [0, 0, Status.ERROR]  # they accumulate at t = 2.56 s
        assert "100000 events" in pool.failure(0)
        assert "t = 2.558" in pool.failure(0)

    @each_solver_and_version
    def test_time_events_and_the_wish_to_stop(self, make_pool, solver, version, kind):
        pool = make_pool("stair", 0.3, kind, outputs=["count"], solver=solver, version=version)
        start(pool)
        for i in range(1, 34):
            outputs, statuses = pool.step()
            assert outputs[0, 0] == math.floor(0.3 * i + 1e-9)
            assert statuses[0] == 0
        outputs, statuses = pool.step()
        assert (outputs[0, 0], statuses[0]) == (10, Status.TERMINATED)

    @in_turn({"solver": SOLVERS, "version": [1, 2, 3]})
    def test_events_after_complete_steps(self, make_pool, solver, version):
        outputs = ["x", "turns"]
        spec = {"solver": solver, "max_step": 0.1, "version": version}
        pool = make_pool("relay", 0.5, outputs=outputs, **spec)
        found = run(pool, 7)
        expected = [[0, 0], [0.5, 0], [1, 1], [0.5, 1], [0, 2], [0.5, 2], [1, 3], [0.5, 3]]
        np.testing.assert_allclose(found, expected, atol=1e-12)

    @pytest.mark.parametrize(("kind", "version"), [("native", 2), ("native", 3), ("wine", 3)])
    def test_the_wish_to_stop_after_a_step(self, make_pool, version, kind):
        pool = make_pool("relay", 0.5, kind, outputs=["x", "turns"], max_step=0.1, version=version)
        start(pool, {"last": 2})
        statuses = [int(pool.step()[1][0]) for _ in range(5)]
        assert statuses == [0, 0, 0, 0, Status.TERMINATED]
        np.testing.assert_allclose(pool.outputs[:, 0], [0.1, 2], atol=1e-12)

    def test_an_fmu_may_do_without_telling_of_steps(self, make_pool):
        flags = 'completedIntegratorStepNotNeeded="true"'
        pool = make_pool("relay", 0.5, outputs=["x", "turns"], flags=flags)
        np.testing.assert_allclose(run(pool, 7)[-1], [3.5, 0], atol=1e-12)

    @pytest.mark.parametrize("solver", ["rk4", "dormand_prince", "rosenbrock"])
    def test_a_switched_circuit(self, make_pool, solver):
        pool = make_pool("circuit", 0.02, solver=solver, max_step=0.02)
        found = run(pool, 300, {"limit": 0.42})[:, 0]
        np.testing.assert_allclose(found, circuit(0.42, 0.02, 300), atol=2e-7)

    @pytest.mark.parametrize("solver", ["rk4", "dormand_prince", "rosenbrock"])
    def test_stick_and_slip(self, make_pool, solver):
        pool = make_pool("friction", 0.1, outputs=["x", "v", "mode"], solver=solver, max_step=0.05)
        found = run(pool, 600)
        np.testing.assert_allclose(found, stick_and_slip(0.1, 600), atol=3e-6)

    def test_states_in_arrays(self, tmp_path, opened):
        """The states of FMI 3.0 may be elements of arrays; their number is what counts."""
        path = exchange_tools.exchange_fmu(tmp_path / "friction.fmu", "friction", 3)
        edits = {
            re.compile('<Float64 name="x"[^>]*/>'): '<Float64 name="x" valueReference="0" '
            'causality="local" initial="exact" start="0 0.1"><Dimension start="2"/></Float64>',
            re.compile('<Float64 name="der.x."[^>]*/>'): '<Float64 name="der(x)" derivative="0" '
            'valueReference="2" causality="local"><Dimension start="2"/></Float64>',
            re.compile('<Float64 name="(v|der.v.)"[^>]*/>'): "",
            re.compile('<ContinuousStateDerivative valueReference="3"/>'): "",
        }
        files = fmu_tools.read_fmu(path)
        text = files["modelDescription.xml"].decode()
        for old, new in edits.items():
            text, count = old.subn(new, text)
            assert count
        fmu_tools.write_fmu(path, files | {"modelDescription.xml": text})
        fmu = FMU(path)
        assert fmu.description.model_exchange.number_of_states == 2
        found = run(opened(open_pool(fmu, (), ["mode"])), 600)[:, 0]
        assert found.tolist() == [row[2] for row in stick_and_slip(0.1, 600)]

    @pytest.mark.parametrize("model", ["stair", "ball"])
    def test_are_told_at_events_only(self, tmp_path, opened, model):
        """FMI 1.0: what ``fmiEventUpdate`` leaves as it is stays so, as in FMPy."""
        outputs = {"stair": ["count"], "ball": ["h", "bounces"]}[model]
        played = []
        for name, options in (("full", ()), ("sparse", ("-DSPARSE=1",))):
            path = exchange_tools.exchange_fmu(tmp_path / f"{name}.fmu", model, 1, options=options)
            pool = start(opened(open_pool(FMU(path, probe_timeout=None), (), outputs, 0.3)))
            played.append([step(pool) for _ in range(30)])
        np.testing.assert_array_equal(*played)
        assert played[0][-1][-1, 0] > 3

    def test_time_does_not_drift(self, make_pool):
        """The period of the source stays where it is through a million steps."""
        pool = make_pool("circuit", 0.05, outputs=["voltage"])
        start(pool, {"limit": 2.0})
        for _ in range(1_000_000):
            outputs, statuses = pool.step()
        decay = math.exp(-0.05 / 0.3)
        assert statuses[0] == 0
        assert outputs[0, 0] == pytest.approx(decay * (1 - decay) / (1 - decay**2), abs=1e-5)


def robertson(step, count):
    """The concentrations at each step, from scipy."""
    return solve_ivp(
        lambda t, y: [
            -0.04 * y[0] + 1e4 * y[1] * y[2],
            0.04 * y[0] - 1e4 * y[1] * y[2] - 3e7 * y[1] ** 2,
            3e7 * y[1] ** 2,
        ],
        (0, step * count),
        [1, 0, 0],
        method="Radau",
        rtol=1e-11,
        atol=1e-14,
        t_eval=np.linspace(0, step * count, count + 1),
    ).y.T


def circuit(limit, step, count, tau=0.3, half=0.05):
    """The voltage of the circuit at each step, from event to event."""
    voltage, time, source, switch, rows = 0.0, 0.0, 1.0, 1, []
    for i in range(count + 1):
        while True:
            end = min(i * step, switch * half)
            target = source + (voltage - source) * math.exp((time - end) / tau)
            if target >= limit:
                time += tau * math.log((source - voltage) / (source - limit))
                voltage = 0.0
                continue
            voltage, time = target, end
            if end < switch * half - 1e-9:
                break
            source, switch = 1.0 - source, switch + 1
        rows.append(voltage)
    return rows


def stick_and_slip(step, count, belt=0.1, static=1.0, kinetic=0.6):
    """Place, speed and mode of the block at each step: a line and an arc in turn."""
    rows = []
    radius = math.hypot(static - kinetic, belt)
    sine = (static - kinetic) / radius
    slip_time = 2 * math.pi - 2 * math.asin(sine)
    first, place = 0.0, 0.0  # sticks from here
    slips = False
    for i in range(count + 1):
        time = i * step
        while True:
            duration = slip_time if slips else (static - place) / belt
            if time - first < duration - 1e-12:
                break
            first += duration
            place = place if not slips else 2 * kinetic - static
            slips = not slips
        since = time - first
        if slips:
            phase = math.asin(sine) + since
            rows.append([kinetic + radius * math.sin(phase), radius * math.cos(phase), -1.0])
        else:
            rows.append([place + belt * since, belt, 0.0])
    return rows


@with_states
def test_linear_models(fmu_path, version):
    """The FMU's derivatives can be read in continuous time, too."""
    plural = "s" if version == 3 else ""
    flags = f'providesDirectionalDerivative{plural}="true"'
    model = linearize(fmu_path("dahlquist", version, flags=flags), inputs=[], at={"k": 3})
    assert model.A.tolist() == [[-3.0]]


class TestPools:
    """The contract of ``fmugym.pool.pool`` for pools of model exchange."""

    every_kind = pytest.mark.parametrize("kind", [*KINDS, "wine"])
    PAIRS = (("native", 3), ("native", 1), ("process", 2), ("wine", 1), ("wine", 3))
    STATES = (("native", 2), ("native", 3), ("process", 3), ("wine", 2))
    CASES = (
        ("ball", [], ["h", "v", "bounces"], "h", "dormand_prince"),
        ("circuit", ["duty"], ["voltage", "discharges"], "limit", "rk4"),
        ("friction", [], ["x", "v", "mode"], "static", "dormand_prince"),
        ("robertson", [], ["y1", "y2", "y3"], "y1", "rosenbrock"),
        ("van_der_pol", [], ["x1", "x2"], "mu", "euler"),
    )
    NAMED = {f"{case[0]}-{case[4]}": case for case in CASES}  # noqa: RUF012  (nothing changes it)
    every_case = pytest.mark.parametrize("case", CASES, ids=NAMED)

    MANY = 70

    def episode(self, pool, steps, first=0, column=0):
        """Do steps with changing inputs, which those of the column begin; the outputs of each."""
        rng = np.random.default_rng(1)
        inputs = rng.uniform(0.2, 0.8, (first + steps, len(pool.inputs), self.MANY))
        columns = slice(column, column + pool.num_instances)
        return np.array([step(pool, *row) for row in np.round(inputs[first:, :, columns], 1)])

    def pool_of(self, make_pool, case, kind, n, version=2, **spec):
        model, inputs, outputs, name, solver = case
        step = 1.0 if model == "robertson" else 0.04
        spec = {"solver": solver, "max_step": 0.01 if solver in ("euler", "rk4") else None} | spec
        pool = make_pool(model, step, kind, n, inputs, outputs, version, **spec)
        return start(pool, {name: np.linspace(0.4, 1.0, n)})

    @in_turn({"case": NAMED, "kind,version": PAIRS})
    def test_all_pools_give_the_same_bits(self, make_pool, case, version, kind):
        native = self.episode(self.pool_of(make_pool, case, "native", 3), 60)
        other = self.episode(self.pool_of(make_pool, case, kind, 3, version), 60)
        assert native.tobytes() == other.tobytes()

    @every_case
    def test_neighbours_and_threads_change_nothing(self, make_pool, case):
        many = self.episode(self.pool_of(make_pool, case, "native", self.MANY), 10)
        again = self.episode(self.pool_of(make_pool, case, "native", self.MANY), 10)
        assert many.tobytes() == again.tobytes()
        alone = self.pool_of(make_pool, case, "native", 1)
        for i, value in enumerate(np.linspace(0.4, 1.0, self.MANY)):
            start(alone, {case[3]: value})
            assert self.episode(alone, 10, column=i)[..., 0].tobytes() == many[..., i].tobytes()

    @in_turn({"case": NAMED, "kind,version": STATES})
    def test_a_restored_state_goes_on_in_the_same_way(self, make_pool, case, version, kind):
        pool = self.pool_of(make_pool, case, kind, 2, version)
        self.episode(pool, 17)
        snapshot = pool.save()
        went_on = self.episode(pool, 30, first=17)
        pool.restore(snapshot)
        assert self.episode(pool, 30, first=17).tobytes() == went_on.tobytes()

    @in_turn(
        {
            "case": NAMED,
            "version": [2, 3],
            "kinds": [("native", "process"), ("process", "native")],
        }
    )
    def test_states_pass_from_pool_to_pool(self, make_pool, case, version, kinds):
        first, second = (self.pool_of(make_pool, case, kind, 1, version) for kind in kinds)
        for pool in (first, second):
            pool.save_by(lambda: SaveMethod.STATE)
        self.episode(first, 17)
        zero = np.zeros(1, np.int64)
        second.restore_instances(first.save_instances(zero), zero, zero)
        went_on = self.episode(first, 30, first=17)
        assert self.episode(second, 30, first=17).tobytes() == went_on.tobytes()

    @pytest.mark.parametrize(("kind", "version"), PAIRS)
    def test_a_reset_forgets_the_solver(self, make_pool, version, kind):
        case = self.CASES[0]
        pool = self.pool_of(make_pool, case, kind, 2, version)
        first = self.episode(pool, 30)
        start(pool, {case[3]: np.linspace(0.4, 1.0, 2)})
        assert self.episode(pool, 30).tobytes() == first.tobytes()
        assert pool.health()["replacements"].tolist() == [0, 0]

    @every_kind
    def test_tunable_parameters_change_between_steps(self, make_pool, kind):
        pool = start(make_pool("dahlquist", 0.5, kind, inputs=["u"]))
        x = step(pool, 1.0)[0, 0]
        pool.write((pool.variable("k"),), np.array([[2.0]]))
        expected = 0.5 + (x - 0.5) * math.exp(-1)
        assert step(pool, 1.0)[0, 0] == pytest.approx(expected, abs=1e-6)

    @every_kind
    def test_warm_up_and_substeps(self, make_pool, kind):
        pool = start(make_pool("dahlquist", 0.5, kind, warm_up_steps=3, substeps=4))
        assert pool.outputs[0, 0] == pytest.approx(math.exp(-1.5), abs=1e-6)
        assert step(pool)[0, 0] == pytest.approx(math.exp(-2), abs=1e-6)


E = np.array([0.7], np.float32)
"""The action: which part of its speed the ball keeps."""


class BallEnv(fmugym.FMI2MEEnv):
    """Is done when the ball has bounced thrice."""

    def __init__(self, path, backend=None, isolation=None, **config):
        config = {
            "model_input_names": "e",
            "bounds": {"e": (0, 1)},
            "model_output_names": ["h", "v", "bounces"],
            "model_parameters": {"h": fmugym.Uniform(0.5, 1.5)},
            "time_step": 0.05,
        } | config
        super().__init__(path, config, backend=backend, isolation=isolation)

    def _is_done(self):
        return self.out["bounces"] > 2.5


class AnyBallEnv(BallEnv):
    fmi_version = fmi_interface = None


class Ball1Env(BallEnv, fmugym.FMI1MEEnv):
    fmi_version = 1


class Ball3Env(BallEnv, fmugym.FMI3MEEnv):
    fmi_version = 3


class TestEnvironments:
    BOTH = ("ModelExchange", "CoSimulation")

    @pytest.mark.parametrize(("env_class", "version"), [(Ball1Env, 1), (BallEnv, 2), (Ball3Env, 3)])
    def test_an_episode(self, fmu_path, env_class, version):
        env = env_class(fmu_path("ball", version))
        env.reset(seed=3)
        first = env.state[0]
        terminated, steps = False, 0
        while not terminated:
            _, _, terminated, truncated, _ = env.step(E)
            steps += 1
            assert not truncated
        fall = math.sqrt(2 * first / 9.81)
        last = fall * (1 + 2 * 0.7 + 2 * 0.49)  # the third bounce
        assert steps == math.ceil(last / 0.05)
        env.close()

    # Episodes of FMI 1.0, which has no FMU states, are played again.
    @in_turn({"version": [1, 2, 3], "isolation": ["none", "process"]})
    def test_a_snapshot(self, fmu_path, version, isolation):
        env = AnyBallEnv(fmu_path("ball", version), isolation=isolation)
        env.reset(seed=1)
        for _ in range(11):
            env.step(E)
        snapshot = env.save_state()
        went_on = [env.step(E)[0].tolist() for _ in range(10)]
        env.restore_state(snapshot)
        assert [env.step(E)[0].tolist() for _ in range(10)] == went_on
        env.close()

    @with_states
    def test_an_fmu_with_both_interfaces_may_choose(self, fmu_path, version):
        path = fmu_path("ball", version, interfaces=self.BOTH)
        for interface in (None, "co_simulation", "model_exchange"):
            env = AnyBallEnv(path, interface=interface)
            assert env.fmu.description.interface == (interface or "co_simulation")
            env.reset(seed=1)
            for _ in range(8):
                env.step(E)
            exact = TestEvents.height(0.4, h=env.parameters["h"])
            is_exact = abs(env.state[0] - exact) < 1e-6
            assert is_exact == (interface == "model_exchange")
            env.close()

    def test_interfaces_that_contradict_each_other(self, fmu_path):
        with pytest.raises(ConfigError, match=r"co_simulation.*BallEnv.*model_exchange"):
            BallEnv(fmu_path("ball"), interface="co_simulation")
        with pytest.raises(FMULoadError, match=r"model exchange.*co-simulation"):
            BallEnv(fmu_path("ball", interfaces=("CoSimulation",)))
        with pytest.raises(FMULoadError, match=r"co-simulation.*model exchange"):
            AnyBallEnv(fmu_path("ball"), interface="co_simulation")
        with pytest.raises(ConfigError, match=r"BallEnv.*FMI 3.*FMI3MEEnv"):
            BallEnv(fmu_path("ball", 3))

    @pytest.mark.parametrize(
        "config", [{"solver": "rk45"}, {"solver": 4}, {"max_step": 0}, {"interface": "me"}]
    )
    def test_bad_config(self, fmu_path, config):
        with pytest.raises(ConfigError, match=next(iter(config))):
            BallEnv(fmu_path("ball"), **config)

    def test_a_solver_that_gives_up_truncates(self, fmu_path):
        class EndlessBall(BallEnv):
            def _is_done(self):
                return False

        env = EndlessBall(fmu_path("ball"), model_parameters={"v_min": 0.0}, time_step=1.0)
        env.reset()
        results = [env.step(E) for _ in range(3)]
        assert [result[3] for result in results] == [False, False, True]
        assert "100000" in results[-1][4]["fault"]
        env.reset()
        assert not env.step(E)[3]
        env.close()


class TestTools:
    @all_versions
    def test_a_skeleton_derives_from_the_class_for_the_interface(self, fmu_path, version):
        text = Skeleton(FMU(fmu_path("circuit", version))).text()
        assert f"(fmugym.FMI{version}MEEnv)" in text

    def test_a_task_file_names_interface_and_solver(self, fmu_path, tmp_path):
        both = fmu_path("circuit", interfaces=TestEnvironments.BOTH)
        text = Proposal(FMU(both)).text()
        text += '\n[config]\ninterface = "model_exchange"\nsolver = "rk4"\nmax_step = 0.001\n'
        (tmp_path / "task.toml").write_text(text)
        env = fmugym.load(tmp_path / "task.toml")
        env.reset(seed=1)
        env.step(env.action_space.sample())
        assert env.fmu.description.interface == "model_exchange"
        assert (env.pool_spec.solver, env.pool_spec.max_step) == ("rk4", 0.001)
        env.close()

    def test_fixed_steps_are_by_default_those_of_the_fmu(self, fmu_path):
        for solver, max_step in (("euler", 0.01), ("dormand_prince", None)):
            env = BallEnv(fmu_path("ball"), solver=solver)
            assert env.pool_spec.max_step == max_step
            env.close()
