"""Surrogates: recorded trajectories, the fit, the programs, and the pool that they step."""

from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from surrogate_tools import surrogate_of

from fmugym import FMUVectorEnv
from fmugym.control.surrogate.recorded_trajectories import EpisodeTrajectory, Trajectories
from fmugym.control.surrogate.surrogate import Surrogate
from fmugym.control.surrogate.surrogate_fit import fit, predicted
from fmugym.control.surrogate.terms import Start, SurrogateForm, Terms, regressors_of
from fmugym.envs import HouseEnv, PendulumEnv
from fmugym.errors import ConfigError, SimulationError
from fmugym.fmi.variable import Variable


class Given(Trajectories):
    """Trajectories that were computed, of outputs y and inputs u."""

    def __init__(self, outputs, inputs, trajectories):
        super().__init__()
        names = [f"y{i}" for i in range(outputs)], [f"u{i}" for i in range(inputs)]
        made = [
            [Variable(n, "Real", 0, "local", "continuous", "exact") for n in one] for one in names
        ]
        self.spec = SimpleNamespace(outputs=made[0], inputs=made[1])
        self.variables = (Variable("y_0", "Real", 0, "parameter", "fixed", "exact"),)
        self._given = trajectories

    def all(self):
        return self._given


def played(step, state, inputs, seen=slice(None)):
    """The trajectory of a difference equation."""
    states = [np.array(state, float)]
    for row in inputs:
        states.append(step(states[-1], row))
    return EpisodeTrajectory(states[0][:1], np.array(inputs), np.array(states)[:, seen])


def courses_of(step, width, outputs, inputs, seen=slice(None), count=8, steps=120):
    rng = np.random.default_rng(0)
    given = []
    for _ in range(count):
        held = np.repeat(rng.uniform(0, 1, (steps // 6, inputs)), 6, axis=0)
        given.append(played(step, rng.uniform(-1, 1, width), held, seen))
    return Given(outputs, inputs, given)


def simulated(surrogate, trajectory, begin):
    """The outputs of a surrogate on the inputs of a trajectory, by the definition of its rows."""
    now = EpisodeTrajectory(
        trajectory.starts, trajectory.inputs[:begin], trajectory.outputs[: begin + 1]
    )
    for place in range(begin, trajectory.steps):
        both = np.concatenate([now.outputs, now.outputs[-1:]])
        row = regressors_of(
            surrogate.terms.form,
            EpisodeTrajectory(now.starts, trajectory.inputs[: place + 1], both),
        )
        change = surrogate.weights @ surrogate.terms.values(row[:, -1:])[:, 0]
        after = np.clip(now.outputs[-1] + change, surrogate.low, surrogate.high)
        now = EpisodeTrajectory(
            now.starts, trajectory.inputs[: place + 1], np.vstack([now.outputs, after])
        )
    return now.outputs


def linear(state, action):
    return np.array([[0.9, 0.1], [-0.1, 0.8]]) @ state + np.array([0.1, 0.2]) * action


def dead_band(state, action):
    return 0.9 * state + np.where(action > 0.3, action, 0.0)


def hidden(state, action):
    """The second state is not seen."""
    return np.array([0.8 * state[0] + 0.2 * state[1], 0.95 * state[1] + 0.3 * action[0]])


def limited(state, action):
    return np.clip(state + action - 0.45, -1.0, 1.0)


class TestFit:
    @pytest.mark.parametrize(
        ("step", "width", "outputs", "form"),
        [
            (linear, 2, 2, SurrogateForm()),
            (hidden, 2, 1, SurrogateForm(lags=1)),
            (limited, 1, 1, SurrogateForm(limited=(0,))),
        ],
    )
    def test_the_form_is_that_of_the_equation(self, step, width, outputs, form):
        found = fit(courses_of(step, width, outputs, 1, slice(outputs)))
        assert found.terms.form == form
        unseen = courses_of(step, width, outputs, 1, slice(outputs), count=20, steps=60).all()[-1]
        begin = 5  # what is hidden has been seen then
        assert simulated(found, unseen, begin) == pytest.approx(unseen.outputs, abs=0.02)

    def test_a_dead_band_is_found(self):
        found = fit(courses_of(dead_band, 1, 1, 1))
        ((place, value),) = found.terms.form.thresholds
        assert (place, value) == (0, pytest.approx(0.3, abs=0.02))

    def test_there_must_be_steps(self):
        with pytest.raises(ConfigError, match="steps"):
            fit(Trajectories())


class TestPrograms:
    @pytest.mark.parametrize(
        "form",
        [
            SurrogateForm(),
            SurrogateForm(lags=2, quadratic=True),
            SurrogateForm(lags=4, tanhs=60, quadratic=True),
            SurrogateForm(angles=(1,), tanhs=5, thresholds=((0, 0.4), (1, 0.7))),
            SurrogateForm(
                starts=True, limited=(0,), lags=1, thresholds=((1, 0.5),), quadratic=True
            ),
        ],
    )
    def test_programs_are_what_numpy_computes(self, form):
        rng = np.random.default_rng(1)
        given = EpisodeTrajectory(
            rng.normal(size=1), rng.uniform(size=(40, 2)), rng.normal(size=(41, 2))
        )
        rows = regressors_of(form, given)
        terms = Terms.fitted_to(form, rows, (2, 2))
        rows = np.ascontiguousarray(1.5 * rows)  # some of them are outside of the range
        weights = rng.normal(size=(2, terms.count))
        low, high = np.array([-1.0, -2.0]), np.array([1.0, 2.0])
        start = Start.of((), [given])
        surrogate = Surrogate(terms, weights, low, high, start, 0.0, None, ())
        after = np.zeros((2, 40))
        surrogate.runs(rows, after)()
        expected = np.clip(rows[:2].T + terms.values(rows).T @ weights.T, low, high)
        assert np.allclose(after.T, expected, rtol=0, atol=1e-12)


def test_courses_are_what_the_fmu_does():
    trajectories = Trajectories()
    made = FMUVectorEnv(PendulumEnv, 3, backend=trajectories), FMUVectorEnv(PendulumEnv, 3)
    with closing(made[0]) as envs, closing(made[1]) as own:
        for one in (envs, own):
            one.reset(seed=5)
        expected = [own.pool.outputs.copy()]
        torques = np.random.default_rng(0).uniform(-2, 2, (7, 3, 1)).astype(np.float32)
        for action in torques:
            assert np.array_equal(envs.step(action)[0], own.step(action)[0])
            expected.append(own.pool.outputs.copy())
    assert trajectories.steps == 21
    for place, trajectory in enumerate(trajectories.all()):
        assert np.array_equal(trajectory.outputs, np.array(expected)[:, :, place])
        assert trajectory.inputs[:, 0] == pytest.approx(torques[:, place, 0], rel=1e-6)
        assert [one.name for one in trajectories.variables][:2] == ["theta_0", "theta_dot_0"]
        assert trajectory.starts[0] == pytest.approx(trajectory.outputs[0, 0])


@pytest.fixture(scope="module")
def pendulum():
    return surrogate_of(PendulumEnv, held=4, steps=100)


class TestPool:
    def test_an_environment_steps_it_in_the_place_of_the_fmu(self, pendulum):
        """Observations and rewards are those of the FMU for a while."""
        with (
            closing(FMUVectorEnv(PendulumEnv, 4, backend=pendulum)) as twin,
            closing(FMUVectorEnv(PendulumEnv, 4)) as envs,
        ):
            for seed in (3, 100):
                seen = [one.reset(seed=seed)[0] for one in (twin, envs)]
                assert seen[0] == pytest.approx(seen[1], abs=0.02)
                for step in range(10):
                    action = np.full((4, 1), 2 * np.sin(step / 3), np.float32)
                    results = [one.step(action) for one in (twin, envs)]
                    for part in range(2):
                        assert results[0][part] == pytest.approx(
                            results[1][part], rel=0.03, abs=0.1
                        )

    def test_environments_that_rest_stay_as_they_are(self, pendulum):
        with closing(FMUVectorEnv(PendulumEnv, 3, backend=pendulum)) as envs:
            before, _ = envs.reset(seed=0)
            pool = envs.pool
            kept = pool.outputs[:, 1].copy()
            envs.step_around(np.ones((3, 1), np.float32), np.array([False, True, False]))
            assert np.array_equal(pool.outputs[:, 1], kept)
            assert not np.array_equal(pool.outputs[:, 0], before[0])
            assert pool.health()["steps"].tolist() == [1, 0, 1]

    def test_other_variables_cannot_be_read(self, pendulum):
        with closing(FMUVectorEnv(PendulumEnv, 1, backend=pendulum)) as envs:
            envs.reset(seed=0)
            variable = Variable("m", "Real", 0, "parameter", "fixed", "exact")
            with pytest.raises(SimulationError, match="'m'"):
                envs.pool.read((variable,))

    def test_lags_begin_anew_with_each_episode(self):
        """Of a house, which has a threshold and a hidden state."""
        found = surrogate_of(HouseEnv, held=3, steps=180)
        assert found.terms.form.lags > 0
        with closing(FMUVectorEnv(HouseEnv, 2, backend=found)) as twin:
            rows = []
            for _ in range(2):
                twin.reset(seed=7)
                rows.append([twin.step(np.full((2, 1), 0.6, np.float32))[0] for _ in range(30)])
        assert np.array_equal(*rows)


def fit_with(terms, surrogate):
    """A surrogate of other terms, whose weights are 0."""
    width = (1 + terms.form.lags) * sum(terms.widths)
    rows = np.random.default_rng(0).normal(size=(width, 9))
    terms = Terms.fitted_to(terms.form, rows, terms.widths)
    return replace(surrogate, terms=terms, weights=np.zeros((terms.widths[0], terms.count)))


class TestStates:
    def test_an_episode_goes_on_in_another_environment(self, pendulum):
        """Also one that has not stepped, and with lags."""
        for make_env, found in ((PendulumEnv, pendulum), (HouseEnv, surrogate_of(HouseEnv, 3, 60))):
            with closing(FMUVectorEnv(make_env, 3, backend=found)) as envs:
                action = np.full((3, 1), 0.5, np.float32)
                for steps in (0, 5):
                    envs.reset(seed=1)
                    for _ in range(steps):
                        envs.step(action)
                    saved = envs.save_state([2])
                    expected = [envs.step(action)[:2] for _ in range(10)]
                    envs.reset(seed=7)
                    envs.restore_state(saved)
                    for seen, rewards in expected:
                        result = envs.step(action)
                        assert np.array_equal(result[0], seen[[2, 2, 2]])
                        assert np.array_equal(result[1], rewards[[2, 2, 2]])

    def test_states_of_the_fmu_and_of_the_surrogate_are_told_apart(self, pendulum):
        with (
            closing(FMUVectorEnv(PendulumEnv, 1, backend=pendulum)) as twin,
            closing(FMUVectorEnv(PendulumEnv, 1)) as envs,
        ):
            saved = []
            for one in (twin, envs):
                one.reset(seed=1)
                saved.append(one.save_state())
            with pytest.raises(SimulationError, match="of the FMU, not of its surrogate"):
                twin.restore_state(saved[1])
            with pytest.raises(SimulationError):
                envs.restore_state(saved[0])

    def test_a_state_of_another_surrogate_is_refused(self, pendulum):
        """And nothing has changed."""
        terms = replace(pendulum.terms, form=replace(pendulum.terms.form, lags=1))
        other = fit_with(terms, pendulum)
        with (
            closing(FMUVectorEnv(PendulumEnv, 2, backend=pendulum)) as envs,
            closing(FMUVectorEnv(PendulumEnv, 2, backend=other)) as others,
        ):
            envs.reset(seed=1)
            others.reset(seed=2)
            kept = envs.pool.outputs.copy()
            with pytest.raises(SimulationError, match="of another surrogate"):
                envs.restore_state(others.save_state())
            assert np.array_equal(envs.pool.outputs, kept)

    def test_what_was_not_set_in_its_courses_cannot_be_set(self, pendulum):
        with closing(FMUVectorEnv(PendulumEnv, 1, backend=pendulum)) as envs:
            envs.reset(seed=1)
            with pytest.raises(SimulationError, match="'tau'"):
                envs.reset(options={"model_parameters": {"tau": 1.0}})


class TestPrediction:
    def test_it_is_what_the_pool_does(self):
        """Of an episode from its beginning on; errors are those of the definition."""
        found = surrogate_of(PendulumEnv, held=4, steps=100)
        trajectories = Trajectories()
        rng = np.random.default_rng(3)
        actions = rng.uniform(-2, 2, (40, 2, 1)).astype(np.float32)
        outputs = []
        for backend in (trajectories, found):
            with closing(FMUVectorEnv(PendulumEnv, 2, backend=backend)) as envs:
                envs.reset(seed=5)
                pool = envs.pool
                rows = [pool.outputs.copy()]
                for action in actions:
                    envs.step(action)
                    rows.append(pool.outputs.copy())
                outputs.append(np.array(rows))
        one, other = trajectories.all()
        result = predicted(found, [one, other])
        begin = one.outputs[:1] - outputs[1][0, :, 0]  # starts are fitted, too
        assert np.abs(begin).max() < 0.02
        assert result.trajectory is one
        assert result.outputs == pytest.approx(outputs[1][:, :, 0], abs=0.3)
        assert result.errors.shape == (20, 2)
        last = [
            simulated(
                found, EpisodeTrajectory(c.starts, c.inputs[: b + 20], c.outputs[: b + 21]), b
            )[-1]
            - c.outputs[b + 20]
            for c in (one, other)
            for b in range(21)
        ]
        assert result.errors[-1] == pytest.approx(np.sqrt(np.square(last).mean(axis=0)))
        assert result.spread == pytest.approx(np.vstack([one.outputs, other.outputs]).std(axis=0))
