"""Model predictive control: plans, what they assume of the future, and where they begin."""

import json
import logging
import re
from functools import partial

import gymnasium
import makers
import numpy as np
import pytest
from test_assumed_rollouts import DT, HOUR, WHEEL

import fmugym
from fmugym import ConfigError
from fmugym.control import MPC, PID, controller_of
from fmugym.control.mpc import _Foresight
from fmugym.control.observer import parameters_of_copies
from fmugym.environment.forecasts import Future, Lookup, Span
from fmugym.envs import CartPoleEnv
from fmugym.fmi.status import WARNING_CODE
from fmugym.records.players import policy_of, simulate

CALM = np.zeros(24)


def wheel(wind=CALM, forecast="2h", observed=True, limits=(-1, 1), **changes):
    """A wheel without friction, whose speed shall be 1: reaching it takes four steps."""
    seen = ["q_dot", "wind"] if observed else ["q_dot"]
    ahead = {"forecast": {"of": ["wind"], "horizon": forecast, "step": "1h"}} if forecast else {}
    return {
        **WHEEL,
        "episode_length": "10h",
        "variables": {"push": dict(zip(("min", "max"), limits, strict=True)) if limits else {}},
        "data": {"wind": {"values": np.array(wind).tolist(), "step": HOUR}},
        "inputs": {"tau": "0.25 / 600 * push + wind"},
        "agent": {"actions": ["push"], "observations": seen, **ahead},
        "reward": "-(q_dot - 1)**2",
    } | changes


def play(env, controller, steps, seed=0):
    """The actions and the rewards of an episode."""
    controller.bind(env)
    observation, info = env.reset(seed=seed)
    actions, rewards = [], []
    for _ in range(steps):
        actions.append(np.array(controller.act(observation, info)))
        observation, reward, terminated, truncated, info = env.step(actions[-1])
        rewards.append(reward)
        if terminated or truncated:
            break
    return np.array(actions), np.array(rewards)


def telling(task):
    """A maker of the task's environment, whose log tells what there is to know."""
    return partial(fmugym.load, task, log_level=logging.INFO)


def lookup(period, times, values):
    """That of a series of its own."""
    table = np.array([*times, *values, 0.0, values[-1]])
    return Lookup({"wind": table}, "wind", (Span(0.0, period),), False)


def mpc(horizon="1h 40min", **arguments):
    return MPC(horizon, **{"candidates": 128} | arguments)


@pytest.fixture
def env_of(opened):
    def make(task, **changes):
        return opened(fmugym.load(task) if isinstance(task, dict) else task(**changes)).unwrapped

    return make


@pytest.fixture
def bound(opened):
    return lambda *arguments, **options: opened(mpc(*arguments, **options))


class TestPlans:
    def test_are_nearly_the_best(self, env_of, bound):
        """The best is full push for four steps, and none afterwards."""
        best = [-((1 - 0.25 * step) ** 2) for step in (1, 2, 3, 4)]
        for arguments in ({}, {"perfect": True}):
            actions, rewards = play(env_of(wheel()), bound(**arguments), 12)
            assert rewards[:4] == pytest.approx(best, abs=0.02)
            assert np.abs(rewards[4:]).max() < 0.01
            assert actions[:3] == pytest.approx(np.ones((3, 1)), abs=0.05)

    def test_are_the_same_again(self, env_of, bound):
        first, second, other = (
            play(env_of(wheel()), bound(seed=seed), 6)[0].tolist() for seed in (1, 1, 2)
        )
        assert first == second != other

    def test_go_on_with_that_of_the_step_before(self, env_of, bound):
        """Searches that find little add up: plans that began anew would cost 5 on the average."""
        few = {"candidates": 9, "rounds": 1, "perfect": True}
        lost = [-play(env_of(wheel()), bound(**few, seed=n), 12)[1].sum() for n in range(6)]
        assert np.mean(lost) < 3.0

    def test_are_not_worse_than_those_of_the_controller_they_begin_with(self, env_of, bound):
        """A search of two candidates a round finds little itself."""
        pid = {"of": "q_dot", "setpoint": 1.0, "kp": 2.0}
        few = {"candidates": 16, "rounds": 2}
        _, alone = play(env_of(wheel()), PID(**pid), 10)
        _, rewards = play(env_of(wheel()), bound(warm=PID(**pid), **few), 10)
        assert rewards.sum() > alone.sum() - 0.01

    def test_begin_with_what_the_task_file_declares(self, env_of, bound):
        """Ranges have their middle, which is the best here; other plans are none."""
        own = wheel()["parameters"] | {"q_dot_0": 0.1}
        returns = {}
        for kp in ("-5..13", "-5", "13"):
            given = {
                "pi": f"pid of=q_dot setpoint=1 kp={kp}",
                "off": "hysteresis of=q_dot setpoint=1 band=0.1",
                "ahead": "mpc horizon=1h",
                "still": 0.0,
            }
            env = env_of(wheel(parameters=own, controllers=given))
            few = [bound(candidates=9, rounds=1, seed=seed) for seed in range(3)]
            returns[kp] = [play(env, controller, 10)[1].sum() for controller in few]
        _, rewards = play(env_of(wheel(parameters=own)), PID("q_dot", 1.0, kp=4.0), 10)
        assert returns.pop("-5..13") == pytest.approx([rewards.sum()] * 3, abs=1e-3)
        assert all(min(found) < rewards.sum() - 0.01 for found in returns.values()), returns

    def test_of_several_environments_are_those_of_single_ones(self, env_of, bound):
        task = wheel(parameters=wheel()["parameters"] | {"q_dot_0": fmugym.Uniform(0, 0.5)})
        envs = fmugym.FMUVectorEnv(partial(fmugym.load, task), 2, autoreset_mode="Disabled")
        controller = bound().bind(envs)
        observations, infos = envs.reset(seed=3)
        rows = []
        for _ in range(4):
            rows.append(controller.act(observations, infos))
            observations, *_, infos = envs.step(rows[-1])
        envs.close()
        for index in range(2):
            alone, _ = play(env_of(task), bound(), 4, seed=3 + index)
            assert np.array(rows)[:, index].tolist() == alone.tolist()

    def test_balance_a_cart_pole(self, env_of, bound):
        _, rewards = play(env_of(CartPoleEnv), bound("0.4s", perfect=True), 60)
        assert len(rewards) == 60


class TestCosts:
    @pytest.mark.parametrize(("limit", "length"), [(2.0, "10h"), (1.0, None)])
    def test_stay_within_their_limits(self, env_of, bound, limit, length):
        """Four full pushes would be best."""
        costs = {"effort": {"expr": "abs(push)", "limit": limit}}
        env = env_of(wheel(costs=costs, episode_length=length))
        actions, _ = play(env, bound("3h 20min"), 20)
        spent = np.abs(actions).sum()
        assert 0.03 * limit < spent <= limit
        free, _ = play(env_of(wheel()), bound("3h 20min"), 20)
        assert np.abs(free).sum() > 3.9


class TestFuture:
    def test_is_not_known_beyond_the_forecast(self, env_of, bound):
        later = CALM.copy()
        later[8:] = 1e-3
        same = [play(env_of(wheel(wind)), bound("4h"), 12)[0].tolist() for wind in (CALM, later)]
        assert same[0] == same[1]
        known = [
            play(env_of(wheel(wind)), bound("8h", perfect=True), 4)[0].tolist()
            for wind in (CALM, later)
        ]
        assert known[0] != known[1]

    def test_is_known_as_far_as_the_forecast_goes(self, env_of, bound):
        """Wind comes in half an hour; who knows brakes before it."""
        gust = CALM.copy()
        gust[3] = 1.5e-3
        rewards = {
            forecast: play(env_of(wheel(gust, forecast)), bound(), 18)[1].sum()
            for forecast in ("2h", None)
        }
        assert rewards["2h"] > rewards[None] + 0.05

    def test_of_a_forecast(self):
        future = Future({"wind": lookup(365 * 86400.0, [0.0, 1.0], [0.0, 0.0])}, (), float)
        names = ("x", "wind", "wind[+10800 s]", "wind[+7200 s]")
        foresight = _Foresight(names, future, HOUR, 30)
        now, told = np.array([0.0, 5.0, 8.0, 6.0]), {}
        foresight.note(told, now, 0)
        times, values = foresight.ahead(told, 0, 1e6)["wind"]
        assert (times - 1e6).tolist() == [HOUR * k for k in range(32)]
        assert values[:4].tolist() == [5.0, 5.5, 6.0, 8.0]
        assert values[4:24].tolist() == [8.0] * 20  # nothing is known of the day before
        assert values[24:].tolist() == [5.0, 5.5, 6.0] + [8.0] * 5
        for hour in range(23):
            foresight.note(told, np.array([0.0, 100.0 + hour, 200.0 + hour, 300.0 + hour]), hour)
        foresight.note(told, now, 23)
        times, values = foresight.ahead(told, 23, 1e6)["wind"]
        assert values[:4].tolist() == [5.0, 322.0, 6.0, 8.0]  # the second was forecast an hour ago
        assert values[4:24].tolist() == [103.0 + k for k in range(20)]  # of a day before
        assert values[24:28].tolist() == [5.0, 322.0, 6.0, 8.0]
        assert foresight.is_present.tolist() == [True, True, False, False]

    def test_of_data_that_are_not_observed_is_their_mean(self):
        rows = [0.0, 1.0, 3.0, 4.0], [0.0, 2.0, 2.0, 0.0]
        future = Future({"wind": lookup(4.0, *rows)}, (), float)
        foresight = _Foresight(("x",), future, 1.0, 3)
        told = {}
        foresight.note(told, np.zeros(1), 0)
        assert foresight.ahead(told, 0, 9.0) == {"wind": ([9.0], [1.5])}
        assert foresight.observed(np.zeros(1), np.zeros(1), 9.0)["wind"] == ([8.0, 9.0], [1.5, 1.5])

    @pytest.mark.parametrize("interpolation", ["linear", "previous"])
    def test_mean_leaves_scenarios_out(self, env_of, interpolation):
        """Values of 1 from 10 to 12 January and on 30 December, which are held out; else 3."""
        days = np.full(365, 3.0)
        days[[9, 10, 11, 363]] = 1.0
        rows = {"values": days.repeat(24).tolist(), "step": HOUR, "interpolation": interpolation}
        scenarios = {
            "frost": {"start": "01-09", "length": "4d"},
            "turn": {"start": "12-29", "length": "2d"},
        }
        task = wheel(observed=False, forecast=None, data={"wind": rows}, scenarios=scenarios)
        for scenario in (None, "frost"):
            env = env_of(partial(fmugym.load, task, scenario=scenario))
            future = env.resolved.future
            assert future.lookups["wind"].mean() < 2.99
            foresight = _Foresight(("q_dot",), future, DT, 3)
            _, values = foresight.ahead({"wind": {}}, 0, 0.0)["wind"]
            assert values == pytest.approx([3.0], abs=1e-12)

    @pytest.mark.parametrize("scenario", [None, "autumn"])
    def test_mean_is_that_of_the_season(self, env_of, scenario):
        """Values of 1 from November to March, with a week that begins on 1 March; else 5."""
        days = np.full(365, 5.0)
        days[304:], days[:66] = 1.0, 1.0
        task = wheel(
            observed=False,
            forecast=None,
            episode_length="7d",
            clock={"from": "11-01", "to": "03-01"},
            data={"wind": {"values": days.repeat(24).tolist(), "step": HOUR}},
            scenarios={"autumn": {"start": "09-01", "length": "2d"}},
        )
        future = env_of(partial(fmugym.load, task, scenario=scenario)).resolved.future
        assert future.lookups["wind"].mean(future.held_out) == pytest.approx(1.0, abs=0.01)

    def test_mean_of_a_day_that_repeats_is_that_of_the_day(self):
        daily = lookup(86400.0, [0.0, 43200.0, 86400.0], [1.0, 5.0, 1.0])
        assert daily.mean([(0.0, 1e6, {})]) == 3.0


class TestModel:
    def test_is_corrected_by_offsets(self, env_of, bound):
        """The wheel begins by 0.24 faster than the copies, and so it stays."""
        env = env_of(wheel(parameters=wheel()["parameters"] | {"q_dot_0": 0.24}))
        errors = {}
        for correction in (0.0, 0.5):
            controller = bound(correction=correction, model=partial(fmugym.load, wheel()))
            _, rewards = play(env, controller, 25)
            errors[correction] = np.sqrt(-rewards[12:].mean())
        assert errors[0.0] == pytest.approx(0.24, abs=0.03)
        assert errors[0.5] < 0.08

    def test_begins_in_the_nominal_state(self, env_of, bound):
        """Speeds are drawn around 0.9; whatever they are, the first push is from there to 1."""
        task = wheel(parameters=wheel()["parameters"] | {"q_dot_0": fmugym.Uniform(0.8, 1.0)})
        env = env_of(task)
        for seed in range(3):
            actions, _ = play(env, bound(correction=0.0), 1, seed)
            assert actions.item() == pytest.approx(0.4, abs=0.04)

    def test_is_the_copy_that_fits_best(self, env_of, bound):
        """The wheel is lighter than the median, which would push it far beyond the goal."""
        own = wheel()["parameters"] | {"m": fmugym.Uniform(0.5, 1.5)}
        env = env_of(wheel(parameters=own))
        seed = next(s for s in range(99) if env.reset(seed=s)[1]["drawn"]["m"] < 0.6)
        play(env, bound(seed=1, correction=0.0), 12, seed)
        assert env.state[0] == pytest.approx(1.0, abs=0.1)
        median = partial(fmugym.load, wheel())
        play(env, bound(seed=1, correction=0.0, model=median), 12, seed)
        assert env.state[0] > 1.5

    def test_copies_of_a_fitted_task_have_whole_rows(self, env_of, bound, tmp_path):
        mass = np.random.default_rng(0).uniform(0.5, 1.5, 50)
        rows = np.stack([mass, 2.0 - mass], axis=1)
        np.savez(tmp_path / "rows.npz", names=np.array(["m", "l"]), rows=rows)
        env = env_of(wheel() | {"fitted": str(tmp_path / "rows.npz")})
        values = parameters_of_copies(env, 0)
        np.testing.assert_allclose(values["m"] + values["l"], 2.0)
        assert abs(values["m"][0] - np.median(mass)) < 0.05
        assert np.ptp(values["m"]) > 0.5
        play(env, bound(), 2)

    def test_may_be_another_environment(self, env_of, bound):
        """That of the planner is twice as heavy: it pushes too hard."""
        heavy = wheel(parameters=wheel()["parameters"] | {"m": 2.0})
        env = env_of(wheel())
        play(env, bound(model=partial(fmugym.load, heavy), correction=0.0), 12)
        assert env.state[0] == pytest.approx(2.0, abs=0.05)

    def test_may_be_a_surrogate(self, env_of, bound, caplog):
        """The wheel reaches its speed in four steps, as with copies of the FMU."""
        controller = bound(model="surrogate", steps=200)
        actions, rewards = play(env_of(telling(wheel())), controller, 12)
        assert actions[:3] == pytest.approx(np.ones((3, 1)), abs=0.05)
        assert np.abs(rewards[4:]).max() < 0.01
        assert "MPC plans on a surrogate of 200 steps" in caplog.text

    def test_a_surrogate_is_fitted_once_for_an_fmu_and_a_config(self, env_of, bound, caplog):
        controller = bound(model="surrogate", steps=200)
        fitted = []
        for time_step in (None, None, 1200.0):
            changes = {} if time_step is None else {"time_step": time_step}
            controller.bind(env_of(telling(wheel(**changes))))
            fitted.append(caplog.text.count("plans on a surrogate"))
        assert fitted == [1, 1, 2]

    def test_may_begin_in_the_observed_state(self, env_of, bound):
        """A pendulum swings up that is too heavy to be lifted; its sensors are noisy."""
        task = {
            "fmu": {"bundled": "Pendulum"},
            "time_step": 0.05,
            "episode_length": "10s",
            "parameters": {
                "theta_0": {"distribution": "uniform", "low": 2.9, "high": 3.1},
                "m": 1.0,
                "l": 1.0,
                "g": 10.0,
                "b": 0.05,
                "body": "uniform_rod",
                "tau_max": 2.0,
                "solver": "rk4",
                "max_step": 0.025,
            },
            "variables": {
                "theta": {"noise": 0.02},
                "theta_dot": {"noise": 0.05},
                "tau": {"min": -2, "max": 2},
            },
            "agent": {"actions": ["tau"], "observations": ["theta", "theta_dot"]},
            "reward": "-(4 * (1 - cos(theta)) + 0.1 * theta_dot**2)",
        }
        states = "theta:theta_0,theta_dot:theta_dot_0"
        controller = bound("1.5s", candidates=512, states=states)
        _, rewards = play(env_of(task), controller, 200, seed=2)
        assert rewards[:10].max() < -7.0
        assert rewards[-60:].min() > -4 * (1 - np.cos(np.radians(15))) - 0.1  # upright


class TestText:
    def test_names_the_arguments(self):
        controller = controller_of(
            "mpc horizon=24h candidates=64 perfect=true warm='pid of=q_dot setpoint=1 kp=2'"
        )
        assert (controller.horizon, controller.candidates, controller.perfect) == (86400, 64, True)
        assert isinstance(controller.warm, PID)

    def test_stands_in_task_files(self, env_of):
        text = "mpc horizon=1h candidates=32"
        env = env_of(wheel(controllers={"ahead": text}))
        summary = simulate(env, policy_of(env, "ahead"), 0, 6)
        assert summary.total_reward > -2.0


class TestRefusals:
    @pytest.mark.parametrize(
        ("arguments", "reason"),
        [
            ({"horizon": "soon"}, "horizon must be"),
            ({"horizon": 0}, "horizon"),
            ({"rounds": 2.5}, "rounds must be an integer"),
            ({"candidates": 3}, "candidates"),
            ({"correction": 2.0}, "correction"),
            ({"perfect": "maybe"}, "perfect must be True or False"),
            ({"budget": 0}, "budget"),
            ({"states": "theta"}, "states must be as in"),
            ({"model": "house.toml"}, "model must be a function or 'surrogate'"),
            ({"model": "surrogate", "perfect": True}, "leave out 'model' or 'perfect'"),
            ({"model": "surrogate", "steps": 0}, "steps must be"),
        ],
    )
    def test_of_arguments(self, arguments, reason):
        with pytest.raises(ConfigError, match=reason):
            MPC(**{"horizon": "1h"} | arguments)

    @pytest.mark.parametrize(
        ("task", "arguments", "reason"),
        [
            (wheel(limits=None), {}, "'min' and 'max'"),
            (wheel(), {"horizon": 60.0}, "shorter than the step"),
            (wheel(), {"horizon": "25h"}, "'wind', which repeat after 86400 s; take horizon=86400"),
            (wheel(), {"states": {"q_dt": "q_dot_0"}}, "'q_dot'"),
            (wheel(), {"states": {"q_dot": "q_dot_0"}}, "without data"),
            (wheel(), {"model": CartPoleEnv}, "the model observes x, x_dot"),
        ],
    )
    def test_of_tasks(self, env_of, bound, task, arguments, reason):
        with pytest.raises(ConfigError, match=reason):
            bound(**arguments).bind(env_of(task))

    def test_of_actions_that_are_several_choices(self, env_of, bound):
        class Several(fmugym.FMI2CSEnv):
            def __init__(self, **options):
                config = {
                    "model_input_names": "f",
                    "model_output_names": ["x", "x_dot", "phi", "phi_dot"],
                    "time_step": 0.02,
                    "inputs": {"f": "10 * action[0]"},
                    "terminated": False,
                }
                super().__init__(fmugym.bundled_fmu("CartPole"), config, **options)

            def _get_action_space(self):
                return gymnasium.spaces.MultiDiscrete([2, 2])

        with pytest.raises(
            ConfigError, match="gives one number, but the action space is MultiDiscrete"
        ):
            bound().bind(env_of(Several))

    def test_of_plants(self, env_of, bound):
        plant = env_of(partial(CartPoleEnv, backend="fmpy"))
        with pytest.raises(ConfigError, match="a backend stands in for this one: give 'model'"):
            bound().bind(plant)
        _, rewards = play(plant, bound("0.4s", model=CartPoleEnv), 15)
        assert len(rewards) == 15

    def test_of_slow_replays(self, env_of, bound):
        env = env_of(partial(CartPoleEnv, fmi_version="1.0"))
        controller = bound("0.4s", budget=1e-6).bind(env)
        observation, info = env.reset(seed=0)
        with pytest.raises(ConfigError, match="cannot save its state"):
            controller.act(observation, info)


class TestCommandLine:
    @pytest.fixture
    def everyone(self, tmp_path, monkeypatch, ran):
        """Who is compared, and the options for it; starts are drawn."""
        start = {"distribution": "uniform", "low": -0.5, "high": 0.5}
        ahead = "mpc horizon=1h candidates=64"
        given = {"pi": "pid of=q_dot setpoint=1 kp=1", "ahead": ahead}
        task = wheel(controllers=given, parameters=WHEEL["parameters"] | {"q_dot_0": start})
        monkeypatch.chdir(tmp_path)
        fmugym.Task.of(task).write(tmp_path / "drawn.toml")
        trained = ["--output", "agent", "--rounds", "9", "--episodes", "1"]
        ran("train", "drawn.toml", *trained)
        names = ["pi", "ahead", f"{ahead} perfect=true"]
        asked = [word for name in names for word in ("--controller", name)]
        played = ["--agent", "agent", "--steps", "8", "--episodes", "3"]
        return [*names, "agent"], ["drawn.toml", *asked, *played]

    def test_compares_it_with_others(self, everyone, tmp_path, ran):
        pytest.importorskip("matplotlib", reason="needs Matplotlib: the extra plot")
        names, options = everyone
        picture = tmp_path / "scores.svg"
        scores = json.loads(ran("evaluate", *options, "--plot", picture, "--json"))["scores"]
        pid, ahead, perfect, agent = (next(s for s in scores if s["name"] == n) for n in names)
        assert pid["gains"] == []
        for one in (ahead, perfect, agent):
            gains = np.subtract(one["rewards"], pid["rewards"])
            assert one["gains"] == gains.tolist()
            low, high = one["gain_interval_95"]
            assert 0 < low < one["mean_gain"] == gains.mean() < high
            assert high - low < 0.5 * np.ptp(one["interval_95"])
        assert perfect["mean_reward"] == pytest.approx(ahead["mean_reward"], abs=0.02)
        drawn = re.findall("<!-- (.*?) -->", picture.read_text(), re.DOTALL)
        assert "gain beside" in "".join(drawn)
        assert [text for text in drawn if text in names] == [*names, names[0]]

    def test_a_report_shows_it_beside_others(self, everyone, tmp_path, ran):
        pytest.importorskip("matplotlib", reason="needs Matplotlib: the extra plot")
        names, options = everyone
        page = tmp_path / "report.html"
        ran("simulate", *options, "--output", page)
        means = page.read_text().split("<table>")[1].replace("\u2212", "-")
        head, *rows = (re.findall("<t[dh].*?>(.*?)</t", row) for row in means.split("<tr>")[1:])
        assert head == ["", "episodes", "reward", "± (95 %)", "gain", "± (95 %)"]
        assert [row[0] for row in rows] == names
        assert rows[0][4:] == ["", ""]
        for row in rows[1:]:
            gain = float(row[2]) - float(rows[0][2])
            assert float(row[4]) == pytest.approx(gain, abs=2e-3)
            assert 0 < float(row[5]) < 0.5 * float(row[3])

    def test_thinking_ahead_costs_least_in_a_house(self, ran):
        pid, ahead = "pid of=T setpoint=21 kp=1.3 ti=2000", "mpc horizon=24h candidates=64"
        asked = [word for name in (pid, ahead) for word in ("--controller", name)]
        played = ["--scenario", "frost", "--steps", "192", "--episodes", "1", "--json"]
        out = ran("evaluate", "fmugym/House-v0", *asked, *played)
        _, tuned, planned = json.loads(out)["scores"]
        assert planned["mean_reward"] > 0.98 * tuned["mean_reward"]

    def test_training_compares_it_where_there_is_time(self, tmp_path, cli):
        given = {
            "pi": "pid of=q_dot setpoint=1 kp=0.1..4",
            "ahead": "mpc horizon=1h candidates=64",
            "slow": "mpc horizon=10h candidates=500000 rounds=100",
        }
        path = tmp_path / "wheel.toml"
        fmugym.Task.of(wheel(controllers=given)).write(path)
        options = ["--output", str(tmp_path / "agent"), "--rounds", "9", "--envs", "8"]
        code, out, err = cli("train", path, *options, "--episodes", "2", "--json")
        assert code == 0
        found = json.loads(out)
        test, baseline = found["test"], found["baseline"]
        assert test["ahead"]["total_reward"] > test[baseline]["total_reward"] - 0.01
        assert "slow" not in test
        assert "left out: slow, whose test would take about" in err

    def test_its_numbers_are_not_tuned(self, refused):
        err = refused("tune", "fmugym/Pendulum-v0", "mpc horizon=3600..7200")
        assert "'mpc' cannot be tuned; known are: hysteresis, pid" in err

    def test_it_does_not_act_in_a_warm_up(self, env_of):
        table = {"period": "1h", "controller": "mpc horizon=1h"}
        with pytest.raises(ConfigError, match="none of in a warm-up"):
            env_of(wheel(warm_up=table))


@pytest.fixture(scope="module")
def fragile(tmp_path_factory):
    return makers.by_python("pythonfmu", "foreign_fragile.py")(tmp_path_factory.mktemp("fmu"))


class TestFailures:
    """Beyond a limit, the FMU fails and each step up to it is paid for."""

    def env(self, fragile, limit, on_fault):
        facts = {
            "fmu": str(fragile),
            "time_step": 0.1,
            "episode_length": "1s",
            "agent": {"actions": ["u"], "observations": ["y"]},
            "variables": {"u": {"min": -1, "max": 1}},
            "parameters": {"limit": limit},
            "config": {"on_fault": on_fault},
            "reward": "-abs(y - 1)",
        }
        return fmugym.load(fmugym.Task.from_dict(facts))

    @pytest.mark.parametrize("on_fault", ["truncate", "raise"])
    @pytest.mark.parametrize(
        "limit",
        [0.55, {"distribution": "uniform", "low": 0.2, "high": 0.9}],
        ids=["known", "drawn"],
    )
    def test_no_plan_fails_and_no_copy_that_has_is_planned_on(self, fragile, limit, on_fault):
        env, copies = self.env(fragile, limit, on_fault), []

        def model():
            copies.append(self.env(fragile, limit, on_fault))
            return copies[-1]

        mpc = MPC("0.8s", candidates=36, budget=None, model=model).bind(env)
        true = 0.9 if isinstance(limit, dict) else limit
        observation, _ = env.reset(seed=0, options={"model_parameters": {"limit": true}})
        for step in range(10):
            action = mpc.act(observation)
            statuses = copies[0].pool.statuses
            assert statuses.size == 9
            assert (statuses <= WARNING_CODE).all()
            observation, _, _, truncated, info = env.step(action)
            assert "fault" not in info
            assert truncated == (step == 9)
        assert 0.4 < observation.item() <= true
        mpc.close()
        env.close()

    def test_a_rollout_tells_which_candidates_fail(self, fragile):
        envs = fmugym.FMUVectorEnv(lambda: self.env(fragile, 0.55, "truncate"), 3)
        envs.reset(seed=0)
        speeds = np.array([1.0, -1.0, 0.5, 0.9, 0.0, 0.8, 1.0])
        actions = np.repeat(speeds[:, np.newaxis, np.newaxis], 10, axis=1)
        found = envs.rollout(envs.save_state([0]), actions)
        assert found.has_failed.tolist() == (speeds > 0.55).tolist()
        assert (found.lengths < 10).tolist() == found.has_failed.tolist()
        envs.close()
