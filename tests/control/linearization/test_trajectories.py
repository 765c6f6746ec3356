"""Linear models along a trajectory, compared with equations, scipy and each other."""

from functools import partial

import exchange_tools
import gymnasium
import numpy as np
import pytest
from combinations import in_turn
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from test_derivatives import DT, HORIZON, B, G, L, M, Precise
from ways import in_way
from zoo_tools import ZooEnv, parameters, zoo_fmu

import fmugym
from fmugym import ConfigError, FMUVectorEnv, SimulationError
from fmugym.control.linearization import derivatives, linearize, linearize_along
from fmugym.control.linearization.linear_trajectory import discrete
from fmugym.envs import CartPoleEnv
from fmugym.pool.native_pool import NativePool

TORQUES = np.random.default_rng(0).uniform(-0.015, 0.015, (HORIZON, 1)).astype(np.float32)
STARTS = {"q": "q_0", "q_dot": "q_dot_0"}
EXACT = {"solver": 3, "max_step": 1e-3}
vector_of = partial(FMUVectorEnv, autoreset_mode="Disabled")


def along(make_env=Precise, actions=TORQUES, num_envs=8, options=None, **arguments):
    """Linearize along a trajectory from the first moment of an episode."""
    envs = vector_of(make_env, num_envs, **(options or {}))
    with make_env() as env:
        env.reset(seed=0)
        snapshot = env.save_state()
    try:
        return linearize_along(envs, snapshot, actions, **arguments)
    finally:
        envs.close()


def exact(**changes):
    """The point mass, solved precisely."""
    return Precise(model_parameters=Precise.plant | EXACT, **changes)


def jacobian(q):
    """Of the equations of the point mass, by q and q_dot."""
    return np.array([[0.0, 1.0], [-G / L * np.cos(q), -B / (M * L**2)]])


def variational(x, torque, step=DT):
    """A and B of one step, by the variational equations and scipy."""

    def slopes(_, row):
        q, v, *rest = row
        phi = np.reshape(rest, (2, 3))
        forced = np.zeros((2, 3))
        forced[1, 2] = 1 / (M * L**2)
        change = -G / L * np.sin(q) + (torque - B * v) / (M * L**2)
        return [v, change, *(jacobian(q) @ phi + forced).ravel()]

    begin = [*x, *np.eye(2, 3).ravel()]
    found = solve_ivp(slopes, (0, step), begin, rtol=1e-11, atol=1e-12).y[2:, -1].reshape(2, 3)
    return found[:, :2], found[:, 2:]


class TestDifferences:
    @pytest.mark.parametrize("num_envs", [1, 8, 64])
    def test_are_those_of_the_equations(self, num_envs):
        """One step of explicit Euler: x + DT f(x, u)."""
        found = along(num_envs=num_envs, states=STARTS, method="differences")
        expected = np.array([np.eye(2) + DT * jacobian(q) for q in found.x[:-1, 0]])
        assert pytest.approx(expected, abs=1e-8) == found.A
        assert found.B[:, :, 0] == pytest.approx(
            np.tile([0, DT / (M * L**2)], (HORIZON, 1)), abs=1e-8
        )
        assert pytest.approx(found.A, abs=1e-12) == found.C  # the outputs are the states
        assert pytest.approx(found.B, abs=1e-12) == found.D
        assert (found.states, found.outputs) == (("q", "q_dot"), ("q", "q_dot"))
        assert found.method == "differences"

    def test_at_rest(self):
        """The states are not exactly zero then."""

        class Hanging(Precise):
            def __init__(self):
                super().__init__(model_parameters={"q_0": 1e-17, "q_dot_0": -3e-16})

        found = along(Hanging, np.zeros((30, 1)), states=STARTS, method="differences")
        directional = along(Hanging, np.zeros((30, 1)))
        assert np.abs(found.x).max() < 1e-14
        assert pytest.approx(directional.A, abs=1e-5) == found.A
        assert pytest.approx(directional.B, abs=1e-5) == found.B

    def test_chained_are_those_by_all_actions(self):
        """``derivatives`` gives the effect of each action on each later observation."""
        with Precise() as env:
            env.reset(seed=0)
            snapshot = env.save_state()
        envs = vector_of(Precise, 32)
        by_actions = derivatives(envs, snapshot, TORQUES).by_actions
        found = linearize_along(envs, snapshot, TORQUES, states=STARTS)
        envs.close()
        effect = found.B[2]
        for step in range(3, HORIZON):
            effect = found.A[step] @ effect
        assert effect == pytest.approx(by_actions[-1, :, 2], rel=1e-4, abs=1e-4)

    def test_in_a_worker_process(self):
        wanted = along(states=STARTS, method="differences")
        found = along(states=STARTS, method="differences", options={"isolation": "process"})
        assert found.A.tobytes() == wanted.A.tobytes()
        assert found.B.tobytes() == wanted.B.tobytes()

    def test_include_hooks(self):
        """Inputs that depend on the state are part of A."""
        gain = 0.01

        class Damped(Precise):
            vectorized = True

            def _get_inputs(self):
                return 0.5 * self.action - gain * self.out["q_dot"]

        found = along(Damped, states=STARTS)
        by_torque = DT / (M * L**2)
        expected = np.array([np.eye(2) + DT * jacobian(q) for q in found.x[:-1, 0]])
        expected[:, 1, 1] -= gain * by_torque
        assert pytest.approx(expected, abs=1e-7) == found.A
        assert found.B[:, 1, 0] == pytest.approx(np.full(HORIZON, 0.5 * by_torque), rel=1e-5)
        with pytest.raises(ConfigError, match="_get_inputs"):
            along(Damped, method="directional")

    @pytest.mark.parametrize("num_envs", [1, 16])
    def test_of_fmi_1(self, num_envs):
        """Its states can be replayed only."""

        class Old(Precise):
            version = "1.0"

        found = along(Old, num_envs=num_envs, states=STARTS)
        assert found.method == "differences"
        assert found.A.tobytes() == along(states=STARTS, method="differences").A.tobytes()
        with pytest.raises(ConfigError, match=r"FMI 1\.0"):
            along(Old, states=STARTS, method="directional")


@in_turn({"method": ["directional", "differences"], "shape": [(), (2, 2)]})
def test_of_actions_of_any_shape(method, shape):
    class Shaped(Precise):
        def _get_action_space(self):
            return gymnasium.spaces.Box(-1.0, 1.0, shape, np.float64)

        def _get_inputs(self):
            first, last = (self.action[0, 0], self.action[1, 1]) if shape else [self.action] * 2
            return 0.01 * (first + 2 * last**2)

    actions = np.full((3, *shape), 0.25)
    found = along(Shaped, actions, states=STARTS if method == "differences" else None)
    torque = along(exact if method == "directional" else Precise, np.full((3, 1), 0.00375))
    wanted = 0.01 * torque.B[:, :, 0]
    slopes = [1.0, 0.0, 0.0, 1.0] if shape else [2.0]
    assert found.method == method
    if method == "directional":
        assert pytest.approx(wanted[:, :, None] * np.array(slopes), rel=1e-2, abs=1e-3) == found.B
    else:
        by_torque = 0.01 * DT / (M * L**2) * np.array(slopes)
        assert found.B[:, 1] == pytest.approx(np.tile(by_torque, (3, 1)), abs=1e-7)


class TestDirectional:
    def test_are_those_of_scipy(self):
        found = along(exact)
        assert (found.method, found.states) == ("directional", ("theta", "theta_dot"))
        for k, torque in enumerate(TORQUES[:, 0]):
            a, b = variational([found.x[k, 0] - np.pi, found.x[k, 1]], float(torque))
            assert found.A[k] == pytest.approx(a, abs=1e-3)
            assert found.B[k] == pytest.approx(b, rel=1e-3, abs=1e-4)

    def test_error_is_of_order_three(self):
        errors = []
        for step in (0.04, 0.02, 0.01):
            found = along(lambda step=step: exact(time_step=step), TORQUES[:1])
            x = [found.x[0, 0] - np.pi + 0.0, found.x[0, 1]]
            a, _ = variational(x, float(TORQUES[0, 0]), step)
            errors.append(np.abs(found.A[0] - a).max())
        assert errors[0] / errors[1] > 5
        assert errors[1] / errors[2] > 5

    @pytest.mark.parametrize("version", ["2.0", "3.0"])
    def test_equal_differences_of_the_double_pendulum(self, version):
        names = ("q1", "q2", "q1_dot", "q2_dot")

        class Double(fmugym.FMUEnv):
            def __init__(self):
                start = dict(zip((f"{n}_0" for n in names), (0.4, -0.9, 1.0, -2.0), strict=True))
                config = {
                    "model_input_names": ["tau1", "tau2"],
                    "model_output_names": ["q1", "q2_dot"],
                    "model_parameters": start | {"cf1": 0.0, "cf2": 0.0},  # they have a kink
                    "bounds": {"tau1": (-0.1, 0.1), "tau2": (-0.1, 0.1)},
                    "time_step": 0.002,
                }
                super().__init__(fmugym.bundled_fmu("DoublePendulum", version), config)

            def _is_done(self):
                return False

        actions = np.random.default_rng(1).uniform(-0.02, 0.02, (6, 2)).astype(np.float32)
        directional = along(Double, actions)
        starts = {name: f"{name}_0" for name in directional.states}
        differences = along(Double, actions, states=starts, method="differences")
        assert (directional.method, differences.method) == ("directional", "differences")
        for name in "ABCD":
            mine, other = getattr(directional, name), getattr(differences, name)
            assert mine == pytest.approx(other, rel=2e-3, abs=2e-3 * np.abs(other).max())
        assert directional.C.shape == (6, 2, 4)
        assert directional.D.shape == (6, 2, 2)
        assert directional.x == pytest.approx(differences.x, abs=1e-9)

    def test_at_an_equilibrium_are_those_of_linearize(self):
        class Upright(Precise):
            def __init__(self):
                super().__init__(model_parameters={"q_0": np.pi})

        found = along(Upright, np.zeros((2, 1)))
        model = linearize(fmugym.bundled_fmu("Pendulum"), at={"q_0": np.pi})
        joined = np.zeros((3, 3))
        joined[:2] = np.hstack([model.A, model.B])
        expected = expm(joined * DT)[:2]
        assert np.hstack([found.A[1], found.B[1]]) == pytest.approx(expected, rel=1e-12)

    def test_of_scaled_actions(self):
        class Scaled(Precise):
            def _get_inputs(self):
                return 0.25 * self.action

        scaled, own = along(Scaled), along(Precise, TORQUES / 4)
        assert pytest.approx(own.A, abs=1e-9) == scaled.A
        assert pytest.approx(0.25 * own.B, rel=1e-4) == scaled.B

    def test_in_a_worker_process(self):
        found = along(lambda: Precise(isolation="process"), method="directional")
        assert found.A.tobytes() == along(method="directional").A.tobytes()

    def test_exponential_of_stiff_models(self):
        slopes = np.array([[[-3e4, 2.0, 1.0], [5.0, -0.1, 0.0]], [[0, 1, 0], [0, 0, 1]]], float)
        a, b = discrete(slopes, 0.1)
        for index in range(2):
            joined = np.zeros((3, 3))
            joined[:2] = slopes[index]
            expected = expm(0.1 * joined)
            assert a[index] == pytest.approx(expected[:2, :2], rel=1e-9, abs=1e-12)
            assert b[index] == pytest.approx(expected[:2, 2:], rel=1e-9, abs=1e-12)


class TestModelExchange:
    """x' = u - k x, solved by fmugym."""

    @pytest.fixture(name="make_env", params=["2", "3"])
    def fixture_make_env(self, request, tmp_path):
        version = int(request.param)
        flag = "providesDirectionalDerivative" + ("s" if version == 3 else "")
        flags = f' {flag}="true"'
        path = tmp_path / "Model.fmu"
        exchange_tools.exchange_fmu(path, "dahlquist", version, flags=flags)

        class Dahlquist(fmugym.FMUEnv):
            def __init__(self):
                config = {
                    "model_input_names": "u",
                    "model_output_names": "x",
                    "model_parameters": {"k": 2.0},
                    "bounds": {"u": (-1, 1)},
                    "tolerance": 1e-10,
                    "time_step": 0.1,
                }
                super().__init__(path, config)

            def _is_done(self):
                return False

        return Dahlquist

    @pytest.mark.parametrize("method", ["directional", "differences"])
    def test_is_the_solution_of_the_equation(self, make_env, method):
        found = along(make_env, np.full((4, 1), 0.5), method=method)
        exact = {"A": np.exp(-0.2), "B": (1 - np.exp(-0.2)) / 2}
        exact |= {"C": exact["A"], "D": exact["B"]}
        for name, value in exact.items():
            assert getattr(found, name).ravel() == pytest.approx([value] * 4, rel=1e-6), name
        assert (found.states, found.method) == (("x",), method)


class TestTimeDependentFMU:
    """x' = cos(t) (x + u), whose matrices change from step to step."""

    @pytest.fixture(name="make_env", params=["1", "2", "3"])
    def fixture_make_env(self, request, tmp_path):
        """FMI 1.0 has no saved states."""
        path = exchange_tools.exchange_fmu(tmp_path / "M.fmu", "season", int(request.param))

        class Season(fmugym.FMUEnv):
            fmu_version = request.param

            def __init__(self):
                config = {
                    "model_input_names": "u",
                    "model_output_names": "x",
                    "bounds": {"u": (-1, 1)},
                    "tolerance": 1e-10,
                    "time_step": 0.3,
                    "start_time": 2.0,
                    "substeps": 2,
                }
                super().__init__(path, config)

            def _is_done(self):
                return False

        return Season

    @pytest.mark.parametrize("passed", [0, 3])
    def test_is_the_solution_of_the_equation(self, make_env, passed):
        """Without a trial, saved states are not trusted, and episodes are played again."""
        assert self.check(make_env, passed).method == "replay"

    def test_with_restored_states(self, make_env, monkeypatch):
        monkeypatch.setenv("FMUGYM_PROBE", "on")
        method = self.check(make_env, 3).method
        has_states = make_env.fmu_version != "1"
        assert method == ("state" if has_states else "replay")

    def check(self, make_env, passed):
        """Compare the matrices with the solution; returns the snapshot where they begin."""
        actions = np.linspace(-0.5, 0.8, 7, dtype=np.float32)[:, None]
        with make_env() as env:
            env.reset(seed=0)
            for _ in range(passed):
                env.step(np.zeros(1, np.float32))
            snapshot = env.save_state()
        envs = vector_of(make_env, 4)
        try:
            envs.reset(seed=1)
            envs.step(np.zeros((4, 1), np.float32))
            here = envs.save_state()
            found = linearize_along(envs, snapshot, actions, states=["x"], method="differences")
            assert envs.save_state() == here
        finally:
            envs.close()
        times = 2.0 + 0.3 * (passed + np.arange(8))
        growth = np.exp(np.diff(np.sin(times)))
        for name, values in {"A": growth, "B": growth - 1, "C": growth, "D": growth - 1}.items():
            assert getattr(found, name).ravel() == pytest.approx(values, abs=1e-6), name
        x = [np.exp(np.sin(times[0]) - np.sin(2.0))]
        for rate, u in zip(growth, actions[:, 0].tolist(), strict=True):
            x.append(rate * (x[-1] + u) - u)
        assert found.x[:, 0] == pytest.approx(np.array(x), rel=1e-8)
        return snapshot


def test_wrong_derivatives_are_told(monkeypatch, caplog):
    along(exact)
    assert not caplog.records
    kept = NativePool.differentiate

    def wrong(self, unknowns, knowns):
        return 1.5 * kept(self, unknowns, knowns)

    monkeypatch.setattr(NativePool, "differentiate", wrong)
    along(exact)
    (record,) = caplog.records
    assert "Pendulum" in record.getMessage()
    assert "directional" in record.getMessage()


def test_present_episodes_go_on():
    envs, twin = vector_of(Precise, 4), vector_of(Precise, 4)
    for one in (envs, twin):
        one.reset(seed=3)
        one.step(np.full((4, 1), 0.01, np.float32))
    snapshot = envs.save_state([2])
    for method, states in (("directional", None), ("differences", STARTS)):
        linearize_along(envs, snapshot, TORQUES, states=states, method=method)
    for _ in range(5):
        mine, other = (one.step(np.full((4, 1), 0.01, np.float32)) for one in (envs, twin))
        assert mine[0].tobytes() == other[0].tobytes()
    envs.close()
    twin.close()


@pytest.mark.parametrize("hooks", ["arrays", "one by one"])
def test_in_the_middle_of_an_episode(hooks):
    """A step count, a previous action and drawn parameters are those of the snapshot."""

    class Drawn(Precise):
        def __init__(self):
            super().__init__(model_parameters=dict(Precise.plant, b=fmugym.Uniform(0.0, 2e-3)))

        def _get_inputs(self):
            return self.action + self.previous_action

    with Drawn() as env:
        env.reset(seed=4)
        env.step(np.full(1, 0.01, np.float32))
        env.step(np.full(1, 0.01, np.float32))
        snapshot, drawn = env.save_state(), env.parameters["b"]
    envs = vector_of(in_way(hooks, Drawn), 8)
    found = linearize_along(envs, snapshot, TORQUES, states=STARTS)
    envs.close()
    assert found.A[:, 1, 1] == pytest.approx(1 - DT * drawn / (M * L**2), abs=1e-8)
    assert found.x[0, 0] != pytest.approx(0.4, abs=1e-9)


class TestRefusals:
    @pytest.mark.parametrize(
        ("arguments", "reason"),
        [
            ({"method": "directoinal"}, "directional"),
            ({"states": "q"}, "states"),
            ({"states": []}, "states"),
            ({"states": ["q_dto"]}, "q_dot"),
            ({"states": ["q", "q_dot"]}, "start variable"),
            ({"states": ["q"], "method": "directional"}, "theta"),
            ({"states": STARTS, "step": 0.0, "method": "differences"}, "step"),
            ({"actions": np.zeros(3)}, "shape"),
            ({"actions": np.full((3, 1), np.nan)}, "step 0.*nan"),
            ({"actions": [[0.0], [0.5]]}, "step 1.*0.5"),
            ({"states": ["theta", 3]}, "3"),
        ],
    )
    def test_of_what_does_not_fit(self, arguments, reason):
        with pytest.raises(ConfigError, match=reason):
            along(**arguments)

    @pytest.mark.parametrize(
        ("states", "reason"),
        [
            ({"q": "q_0"}, "q_dot|determine"),
            ({"q": "theta_0", "q_dot": "q_dot_0"}, "'theta_0' does not set .*'q'"),
        ],
    )
    def test_of_states_that_are_none(self, states, reason):
        with pytest.raises(SimulationError, match=reason):
            along(states=states, method="differences")

    def test_of_an_end(self):
        for method, states in (("directional", None), ("differences", STARTS)):
            with pytest.raises(SimulationError, match="2"):
                along(lambda: Precise(max_episode_steps=2), states=states, method=method)
            found = along(lambda: Precise(max_episode_steps=HORIZON), states=states, method=method)
            assert len(found.A) == HORIZON

    def test_of_other_environments_and_snapshots(self):
        envs = vector_of(Precise, 2)
        envs.reset(seed=0)
        snapshot, zeros = envs.save_state(), np.zeros((3, 1))
        for function in (linearize_along, derivatives):
            with pytest.raises(ConfigError, match="FMUVectorEnv"):
                function(Precise, snapshot[0], zeros)
            with pytest.raises(ConfigError, match="2 environments"):
                function(envs, snapshot, zeros)
            with pytest.raises(ConfigError, match="save_state"):
                function(envs, None, zeros)
        with pytest.raises(ConfigError, match="step"):
            derivatives(envs, snapshot[0], zeros, step=-1.0)
        envs.close()
        for function in (linearize_along, derivatives):
            with pytest.raises(SimulationError, match="closed"):
                function(envs, snapshot[0], zeros)

    def test_of_discrete_actions(self):
        with pytest.raises(ConfigError, match="Box"):
            along(CartPoleEnv, np.zeros((3, 1)))

    def test_of_an_fmu_without_derivatives(self, tmp_path):
        path = zoo_fmu(tmp_path, 2)

        class Foreign(ZooEnv):
            def __init__(self):
                super().__init__(path, model_parameters=parameters())

        with pytest.raises(ConfigError):
            along(Foreign, np.zeros((3, 1)), method="directional")
