"""Identification: what was simulated is found again, and what was measured is predicted."""

import os
import sys
from contextlib import closing
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import values_tools
from fmu_tools import PlainEnv
from letters import wide
from scipy.integrate import solve_ivp

import fmugym
from fmugym import ConfigError
from fmugym.control.identification import Trajectory, fit_parameters, plot_comparison

PENDULUM = fmugym.bundled_fmu("Pendulum")
DOUBLE_PENDULUM = fmugym.bundled_fmu("DoublePendulum")
TRUE = {"m": 0.06, "l": 0.1, "b": 4e-4, "c": 2e-3}
START = {"q_0": "q", "q_dot_0": "q_dot"}
PUBLISHED_P4 = 0.09642

DATA = os.environ.get("FMUGYM_MEASURED_DATA")
measured = pytest.mark.skipif(
    not DATA, reason="FMUGYM_MEASURED_DATA does not name the folder of the measured data"
)


def swing(q_0, c=0.0, end=5.0, step=0.002, tau=0.0):
    """A free swing by SciPy's integrator: time, angle, velocity."""
    m, length, b = TRUE["m"], TRUE["l"], TRUE["b"]

    def derivative(_, state):
        q, v = state
        moment = tau - b * v - c * np.tanh(v / 0.05) - m * 9.81 * length * np.sin(q)
        return v, moment / (m * length**2)

    time = np.arange(round(end / step) + 1) * step
    solution = solve_ivp(derivative, (0, time[-1]), [q_0, 0.0], "LSODA", time, rtol=1e-8, atol=1e-9)
    return time, *solution.y


def noisy(seed, *angles, c=2e-3, end=2.0, tau=0.0, step=0.004):
    """Swings as trajectories, with noise of 0.01 rad and 0.1 rad/s."""
    rng = np.random.default_rng(seed)
    made = []
    for angle in angles:
        time, q, q_dot = swing(angle, c, end, step, tau)
        q = q + rng.normal(0, 0.01, len(q))
        q_dot = q_dot + rng.normal(0, 0.1, len(q))
        made.append(Trajectory(time, {"q": q, "q_dot": q_dot}, {"tau": tau}))
    return made


@pytest.fixture(scope="module", name="fit")
def fixture_fit():
    """Three parameters, fitted to three swings with noise."""
    return fit_parameters(
        PENDULUM,
        {"l": (0.05, 0.2), "b": 1e-3, "c": (1e-3, 0.0, 0.01)},
        noisy(1, 2.0, -1.0, 2.8),
        initial_states=START,
        scales={"q": 0.01, "q_dot": 0.1},
    )


class TestOutputError:
    def test_known_parameters_lie_in_the_confidence_intervals(self, fit):
        assert fit.converged
        for name, (low, high) in fit.confidence_intervals(0.999).items():
            assert low < TRUE[name] < high
            assert high - low < 0.2 * TRUE[name]
        assert fit.rms("q") == pytest.approx(0.01, rel=0.1)
        assert fit.rms("q_dot") == pytest.approx(0.1, rel=0.1)

    def test_intervals_cover_in_about_as_many_cases_as_they_say(self):
        """80 %: of 60 cases between 39 and 57, all but once in a thousand."""
        count = 0
        for seed in range(30):
            fit = fit_parameters(
                PENDULUM,
                {"l": 0.12, "b": 1e-3},
                noisy(seed, 2.0, end=1.0, step=0.01),
                initial_states=START,
                fixed={"c": 2e-3},
                scales={"q": 0.01, "q_dot": 0.1},
            )
            intervals = fit.confidence_intervals(0.8)
            count += sum(low <= TRUE[name] <= high for name, (low, high) in intervals.items())
        assert 39 <= count <= 57

    def test_names_are_found_by_letters_that_look_the_same(self):
        first, second = noisy(2, 2.0, -1.0, end=1.0, step=0.01)
        first, third = (
            Trajectory(one.time, {wide(n): one.outputs[n] for n in one.outputs}, {wide("tau"): 0.0})
            for one in (first, second)
        )
        fit = fit_parameters(
            PENDULUM,
            {wide("l"): 0.12, wide("tau"): (0.0, -0.1, 0.1)},
            [first, second],
            initial_states={wide(name): wide(output) for name, output in START.items()},
            fixed={wide("c"): 2e-3},
            scales={wide("q"): 0.01, wide("q_dot"): 0.1},
        )
        assert fit.values["l"] == pytest.approx(TRUE["l"], rel=0.01)
        assert [*fit.values] == ["l", "tau"]
        assert [*fit.comparison.initial_values[0]] == [*START]
        predicted = fit.predict([third])
        assert predicted.rms(wide("q")) == predicted.rms("q") == pytest.approx(0.01, rel=0.3)
        assert predicted.explained(wide("q")) == predicted.explained("q")
        axes = plot_comparison(predicted, {wide("q"): "angle"}).axes
        assert axes[0].get_ylabel() == "angle"
        with pytest.raises(ConfigError, match="unknown measured output"):
            predicted.rms(wide("qq"))

    @pytest.mark.parametrize("what", ["parameters", "fixed", "initial_states", "scales"])
    def test_names_that_look_the_same_are_refused(self, what):
        name = "q" if what == "scales" else "l"
        arguments = {"parameters": {"b": 1e-3}, what: dict.fromkeys((name, wide(name)), 1.0)}
        with pytest.raises(ConfigError, match=f"^{what}: '{name}' and .* one name"):
            fit_parameters(PENDULUM, trajectories=noisy(2, 2.0, end=0.1), **arguments)

    def test_signals_that_look_the_same_are_refused(self):
        (one,) = noisy(2, 2.0, end=0.1)
        odd = Trajectory(one.time, {"q": one.outputs["q"], wide("q"): one.outputs["q"]})
        with pytest.raises(ConfigError, match=r"outputs of a trajectory: 'q' and .* one name"):
            fit_parameters(PENDULUM, {"l": 0.12}, [odd])

    def test_sampling_times_may_be_any(self):
        (full,) = noisy(3, 2.0, step=0.001)
        rng = np.random.default_rng(0)
        chosen = np.sort(rng.choice(len(full), 400, replace=False))
        fit = fit_parameters(
            PENDULUM,
            {"l": 0.12, "b": 1e-3, "c": 1e-3},
            [full.select(chosen)],
            initial_states=START,
            scales={"q": 0.01, "q_dot": 0.1},
            time_step=0.003,
        )
        for name, (low, high) in fit.confidence_intervals(0.999).items():
            assert low < TRUE[name] < high

    def test_interpolation_adds_next_to_nothing(self):
        time, q, q_dot = swing(2.0, step=0.0017)
        fit = fit_parameters(
            PENDULUM,
            {"l": 0.11, "b": 1e-3},
            [Trajectory(time, {"q": q, "q_dot": q_dot})],
            fixed={"q_0": 2.0, "max_step": 1e-3},
            time_step=0.005,
        )
        assert fit.values == pytest.approx({"l": 0.1, "b": 4e-4}, rel=1e-5)
        assert fit.rms("q") < 1e-5

    def test_an_input_is_held_between_its_samples(self):
        rng = np.random.default_rng(5)
        torque = np.repeat(rng.uniform(-0.02, 0.02, 50), 10)
        env_time = np.arange(501) * 0.01
        q = simulate(torque)
        logged = Trajectory(env_time, {"q": q}, {"tau": [*torque, 0.0]})
        fit = fit_parameters(PENDULUM, {"m": 0.05, "b": 1e-3}, [logged], fixed={"q_0": 0.0})
        assert fit.values == pytest.approx({"m": 0.06, "b": 4e-4}, rel=1e-6)

    def test_an_input_can_be_fitted_as_an_offset(self):
        """A torque of 0.02 N m that the log does not know, here and in the prediction."""
        data = noisy(2, 2.0, tau=0.02)
        blind = [Trajectory(t.time, t.outputs, {"tau": 0.005}) for t in data]
        options = {"initial_states": START, "fixed": {"c": 2e-3}}
        fit = fit_parameters(PENDULUM, {"tau": (-0.1, 0.1)}, blind, **options)
        assert fit.values["tau"] == pytest.approx(0.015, abs=2e-4)
        assert fit.predict(blind).rms("q") == pytest.approx(fit.rms("q"), rel=1e-3)

    def test_an_fmu_with_arguments_of_its_own(self):
        with closing(fmugym.FMU(PENDULUM)) as fmu:
            folder = fmu.extract()
            fit = fit_parameters(fmu, {"b": 1e-3}, noisy(0, 1.0), fixed={"c": 2e-3})
            assert folder.exists()  # it is still the caller's
        assert fit.predict(noisy(0, 1.0)).rms("q") == pytest.approx(fit.rms("q"))
        preloading = fmugym.FMU(PENDULUM, preload=["/nowhere/libgave.so"])
        with pytest.raises(fmugym.FMULoadError, match="libgave"):
            fit_parameters(preloading, {"b": 1e-3}, noisy(0, 1.0))

    def test_parameters_that_the_data_do_not_tell(self):
        """A free swing without friction tells the length but not the mass."""
        time, q, _ = swing(2.0)
        options = {"initial_states": {"q_0": "q"}, "fixed": {"b": 0.0, "q_dot_0": 0.0}}
        fit = fit_parameters(
            PENDULUM, {"l": 0.11, "m": 0.05}, [Trajectory(time, {"q": q})], **options
        )
        assert fit.standard_errors["m"] == np.inf
        assert np.isfinite(fit.standard_errors["l"])
        with pytest.raises(fmugym.ConfigError, match="'m' has no distribution: give it bounds"):
            fit.rows(10)

    def test_what_the_data_tell_only_together_is_drawn_together(self):
        """Without friction a swing under gravity tells g / l, and neither of both."""
        time, q, _ = swing(2.0)
        q = q + np.random.default_rng(0).normal(0, 0.01, len(q))
        fit = fit_parameters(
            PENDULUM,
            {"l": (0.12, 0.05, 0.2), "g": (9.0, 5.0, 20.0)},
            [Trajectory(time, {"q": q})],
            fixed={"b": 0.0, "c": 0.0, "q_0": 2.0},
        )
        (direction,) = fit.untold()
        assert set(direction) == {"l", "g"}
        assert direction["l"] * direction["g"] > 0
        length, gravity = fit.rows(500, seed=1).T
        assert np.std(gravity / length) / 98.1 < 0.02
        assert np.std(gravity) > 1.5
        assert (length.min() >= 0.05) & (length.max() <= 0.2)
        assert np.array_equal(fit.rows(500, seed=1)[:, 0], length)

    def test_bounds_hold_and_truncate_the_distribution(self):
        options = {"initial_states": START, "fixed": {"c": 2e-3}}
        fit = fit_parameters(PENDULUM, {"l": (0.11, 0.2)}, noisy(1, 2.0), **options)
        assert fit.values["l"] == pytest.approx(0.11)
        found = fit.distributions()["l"].values
        assert 0.11 <= min(found) < max(found) <= 0.2

    def test_the_result_goes_into_an_environment(self, fit):
        config = {"model_input_names": "tau", "model_output_names": "q", "time_step": 0.02}
        env = PlainEnv(PENDULUM, config | {"model_parameters": fit.values})
        env.reset()
        assert dict(env.parameters) == fit.values
        env.close()
        env = PlainEnv(PENDULUM, config | {"model_parameters": fit.distributions()})
        env.reset(seed=1)
        assert env.parameters["l"] == pytest.approx(fit.values["l"], rel=0.05)
        assert env.parameters["l"] != fit.values["l"]
        env.close()

    def test_predictions_fit_initial_states_anew(self, fit):
        held = windows(noisy(9, 1.5)[0], 0.5)
        assert len(held) == 4
        predicted = fit.predict(held)
        assert predicted.rms("q") == pytest.approx(fit.rms("q"), rel=0.3)
        measured = np.array([one.outputs["q"][0] for one in held])
        found = np.array([one["q_0"] for one in predicted.initial_values])
        assert (found != measured).all()
        np.testing.assert_allclose(found, measured, atol=0.05)

    def test_a_wrong_model_says_so_by_its_residuals(self):
        """The friction is Coulomb's, the model only knows the viscous one."""
        options = {"initial_states": START, "scales": {"q": 0.01, "q_dot": 0.1}}
        swings = noisy(4, 2.5, -2.0, end=3.0)
        wrong = fit_parameters(PENDULUM, {"l": 0.11, "b": 1e-3}, swings, **options)
        right = fit_parameters(
            PENDULUM, {"l": 0.11, "b": 1e-3, "c": (1e-3, 0.0, 0.01)}, swings, **options
        )
        assert wrong.correlations["q"].first > 0.8
        assert not wrong.correlations["q"].is_noise
        assert all(one.is_noise and abs(one.first) < 0.1 for one in right.correlations.values())
        assert wrong.standard_errors["l"] > 3 * right.standard_errors["l"]
        assert wrong.degrees_of_freedom < 0.1 * right.degrees_of_freedom

    def test_errors_stay_honest_where_noise_is_correlated(self):
        """Of 60 intervals of 95 %, independent residuals would let about half cover."""
        count = 0
        for seed in range(30):
            (made,) = noisy(seed, 2.0, end=4.0, step=0.01)
            rng, drift = np.random.default_rng(seed), np.zeros(len(made))
            for k in range(1, len(drift)):
                drift[k] = 0.95 * drift[k - 1] + rng.normal(0, 0.01)
            logged = Trajectory(made.time, {"q": made.outputs["q"] + drift})
            fit = fit_parameters(
                PENDULUM,
                {"l": 0.12, "b": 1e-3},
                [logged],
                fixed={"c": 2e-3, "q_0": 2.0},
            )
            assert not fit.correlations["q"].is_noise
            intervals = fit.confidence_intervals(0.95)
            count += sum(low <= TRUE[name] <= high for name, (low, high) in intervals.items())
        assert count >= 52

    def test_outputs_are_weighted_by_their_noise(self):
        """With the angle as noisy as the velocity, which has ten times its range."""
        made = noisy(3, 2.0, -1.0, 2.5)
        fits = [
            fit_parameters(PENDULUM, {"l": 0.12}, made, fixed={"b": 4e-4, "c": 2e-3}, **options)
            for options in (
                {"initial_states": START},
                {"initial_states": START, "scales": {"q": 0.01, "q_dot": 0.1}},
                {"initial_states": START, "scales": {"q": 1.0, "q_dot": 0.01}},
            )
        ]
        own, right, wrong = (fit.values["l"] for fit in fits)
        assert own == pytest.approx(right, rel=2e-5)
        assert abs(own - wrong) > 5 * abs(own - right)

    def test_an_output_without_noise_makes_others_no_surer(self):
        made = noisy(3, 2.0, -1.0)
        exact = [
            Trajectory(t.time, {**t.outputs, "tau_max": np.full(len(t), 0.15)}, t.inputs)
            for t in made
        ]
        options = {"initial_states": START, "fixed": {"b": 4e-4, "c": 2e-3}}
        plain = fit_parameters(PENDULUM, {"l": 0.12}, made, **options)
        more = fit_parameters(PENDULUM, {"l": 0.12}, exact, **options)
        assert more.standard_errors["l"] == pytest.approx(plain.standard_errors["l"], rel=0.01)

    def test_a_wash_in_is_not_counted(self):
        """The first half second of the log is of another pendulum."""
        (made,) = noisy(1, 2.0)
        odd = made.time < 0.5
        logged = Trajectory(made.time, {"q": made.outputs["q"] + np.where(odd, 0.5, 0.0)})
        options = {"fixed": {"b": 4e-4, "c": 2e-3, "q_0": 2.0}}
        early, late = (
            fit_parameters(PENDULUM, {"l": 0.12}, [logged], wash_in=wash_in, **options)
            for wash_in in (None, 0.5)
        )
        assert late.values["l"] == pytest.approx(0.1, rel=1e-3)
        assert abs(early.values["l"] - 0.1) > 20 * abs(late.values["l"] - 0.1)
        with pytest.raises(fmugym.ConfigError, match="no samples after a wash-in of 9 s"):
            fit_parameters(PENDULUM, {"l": 0.12}, [logged], wash_in=Fraction(9), **options)

    def test_candidates_find_what_one_start_misses(self):
        """A length that is wrong by a half puts the swings out of phase."""
        made = noisy(1, 2.0, end=5.0, step=0.01)
        options = {"fixed": {"b": 4e-4, "c": 2e-3, "q_0": 2.0}}
        one, many = (
            fit_parameters(
                PENDULUM, {"l": (0.05, 0.02, 0.5)}, made, candidates=candidates, **options
            )
            for candidates in (1, 40)
        )
        assert abs(one.values["l"] - 0.1) > 0.02
        assert many.values["l"] == pytest.approx(0.1, rel=1e-3)
        assert len(many.costs) == 3
        with pytest.raises(fmugym.ConfigError, match="'l' needs a lowest and a highest value"):
            fit_parameters(PENDULUM, {"l": 0.12}, made, candidates=5, **options)

    def test_plot(self, fit, tmp_path):
        figure = plot_comparison(fit.comparison, {"q": "angle [rad]"})
        assert [ax.get_ylabel() for ax in figure.axes] == ["angle [rad]", "q_dot"]
        assert len(figure.axes[0].lines) == 2 * len(fit.comparison.trajectories)
        figure.savefig(tmp_path / "fit.png")
        assert (tmp_path / "fit.png").stat().st_size > 5000

    @pytest.mark.parametrize(
        ("arguments", "match"),
        [
            ({"parameters": {}}, "no parameter"),
            ({"parameters": {"bb": 1.0}}, "unknown variable of Pendulum 'bb'"),
            ({"parameters": {"q": 1.0}}, "'q' cannot be set: it is a continuous output"),
            ({"parameters": {"b": (1.0, 0.5, 2.0, 3.0)}}, "low <= start <= high"),
            ({"parameters": {"b": -1.0}}, "low <= start <= high"),
            ({"fixed": {"b": 1e-4}}, "both fixed and to be fitted"),
            ({"scales": {"q": 0.0}}, "scale of 'q'"),
            ({"scales": {"p": 1.0}}, "unknown measured output 'p'"),
            ({"trajectories": []}, "at least one trajectory"),
            ({"time_step": 0.0}, "time_step"),
        ],
    )
    def test_mistakes(self, arguments, match):
        with pytest.raises(fmugym.ConfigError, match=match):
            fit_parameters(
                PENDULUM, **{"parameters": {"b": 1e-3}, "trajectories": noisy(0, 1.0), **arguments}
            )

    def test_structural_parameters_are_refused(self, tmp_path):
        path = values_tools.state_space_fmu(tmp_path / "S.fmu")
        logged = Trajectory([0.0, 1.0, 2.0], {"y[1]": [0.0, 1.0, 0.0]})
        with pytest.raises(fmugym.ConfigError, match="it is a structural parameter"):
            fit_parameters(path, {"n": (1.0, 4.0)}, [logged])

    def test_what_the_fmu_refuses_is_told(self):
        fixed = {"v_c": -1.0}
        with pytest.raises(fmugym.SimulationError, match="v_c must be positive"):
            fit_parameters(PENDULUM, {"b": 1e-3}, noisy(0, 1.0), fixed=fixed)


class TestTrajectory:
    def test_repeats_are_left_out_but_for_a_plant_at_rest(self):
        q = np.array([1.0, 1.0, 2.0, 3.0, 3.0, 3.0, 4.0, *[0.0] * 20])
        kept = Trajectory(np.arange(27.0), {"q": q}).without_repeats()
        assert kept.time.tolist() == [0.0, 2.0, 3.0, 6.0, *range(7, 27)]

    def test_one_signal_that_changes_makes_a_new_sample(self):
        outputs = {"q": [1.0, 1.0, 1.0], "v": [1.0, 2.0, 2.0]}
        assert len(Trajectory([0, 1, 2], outputs).without_repeats()) == 2

    @pytest.mark.parametrize(
        ("time", "outputs", "match"),
        [
            ([0.0, 0.0], {"q": [1.0, 2.0]}, "increase"),
            ([0.0, 1.0], {"q": [1.0]}, r"shape \(2,\)"),
            ([0.0, 1.0], {"q": [1.0, np.nan]}, "finite"),
            ([0.0, 1.0], {"q": ["a", "b"]}, "numbers"),
            ([0.0, 1.0], {}, "at least one measured output"),
        ],
    )
    def test_mistakes(self, time, outputs, match):
        with pytest.raises(fmugym.ConfigError, match=match):
            Trajectory(time, outputs)


def between(made, start, end):
    return made.select((made.time >= start) & (made.time < end))


def windows(made, length):
    """Consecutive ones, without an incomplete one at the end."""
    start, count = made.time[0], int((np.ptp(made.time) + np.diff(made.time)[0]) / length + 1e-9)
    return [between(made, start + k * length, start + (k + 1) * length) for k in range(count)]


def simulate(torques):
    """The angle of the pendulum FMU at the start and after each step of 0.01 s."""
    config = {"model_input_names": "tau", "model_output_names": "q", "time_step": 0.01}
    env = PlainEnv(PENDULUM, config | {"model_parameters": {"q_0": 0.0}})
    env.reset()
    angles = [env.state[0]]
    for torque in torques:
        env.step(np.array([torque]))
        angles.append(env.state[0])
    env.close()
    return np.array(angles)


def test_scipy_is_named_with_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.optimize", None)
    with pytest.raises(fmugym.ConfigError, match="'identification'"):
        fit_parameters(PENDULUM, {"b": 1e-3}, noisy(0, 1.0))


@measured
class TestMeasured:
    """On real swings; the readmes in ``resources`` tell where they come from."""

    def test_single_pendulum(self):
        name = "dfki_simple_pendulum_damped_swing_segment.csv"
        rows = np.genfromtxt(Path(DATA) / name, delimiter=",", names=True)
        full = Trajectory(rows["time"], {"q": rows["position"]}, {"tau": 0.89})
        fit = fit_parameters(
            PENDULUM,
            {"m": (0.6, 0.1, 2.0), "l": (0.5, 0.2, 1.0), "b": (0.01, 0, 1), "c": (0.05, 0, 1)},
            [between(full, 12.5, 14.5)],
            initial_states={"q_0": "q", "q_dot_0": -1.0},
            fixed={"tau_max": 10.0},
        )
        assert fit.rms("q") <= 0.003
        assert fit.predict([between(full, 14.5, 17.4)]).rms("q") <= 0.02

    def test_double_pendulum(self):
        fit = fit_parameters(
            DOUBLE_PENDULUM,
            {
                "P1": (7e-4, 2e-4, 2e-3),
                "P2": (1.5e-4, 2e-5, 1e-3),
                "P3": (2e-4, 2e-5, 1e-3),
                "P6": (2e-4, 2e-5, 1e-3),
                "P5": (0.03, 1e-3, 0.2),
                "b1": (1e-4, 0, 0.01),
                "b2": (1e-4, 0, 0.01),
                "cf1": (1e-3, 0, 0.02),
                "cf2": (1e-3, 0, 0.02),
            },
            [w for index in (0, 1) for w in windows(between(free_fall(index), 0, 3), 0.2)],
            initial_states={f"{name}_0": name for name in ("q1", "q2", "q1_dot", "q2_dot")},
            fixed={"q_dot_max": 1e3, "P4": PUBLISHED_P4},  # a free fall tells ratios only
            scales={"q1": 0.01, "q2": 0.02, "q1_dot": 1.0, "q2_dot": 2.0},
            time_step=0.002,
        )
        held = windows(between(free_fall(2), 0, 3), 0.2)
        predicted = fit.predict(held)
        assert np.degrees(predicted.rms("q1")) <= 3
        assert np.degrees(predicted.rms("q2")) <= 8


def free_fall(index):
    with np.load(Path(DATA) / "cloudpendulum_dp_freefall.npz") as data:
        time, q, q_dot = (data[f"ff{index}_{name}"] for name in ("t", "q", "dq"))
    outputs = {"q1": q[:, 0], "q2": q[:, 1], "q1_dot": q_dot[:, 0], "q2_dot": q_dot[:, 1]}
    return Trajectory(time, outputs)
