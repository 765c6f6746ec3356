"""The bundled house against other forms of its balances, its year, and its environment."""

import csv
import math
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from scipy.integrate import solve_ivp
from vector_tools import require_same_alone

import fmugym
from fmugym.control import PID, Hysteresis
from fmugym.envs.house import HOUSE_TASK, HouseEnv

VERSIONS = ["2.0", "3.0"]
OUTPUTS = ["T_m", "T_w", "E", "T_air", "T_op", "P", "Q_hp", "Q_em", "COP"]
INPUTS = ["T_out", "I_sol", "Q_int", "u"]
KELVIN = 273.15


class House(fmugym.FMUEnv):
    """The FMU as it is."""

    def _is_done(self):
        return False


def simulate(inputs, parameters=None, time_step=900.0, fmi_version="2.0"):
    """The outputs at the start and after each step: arrays of shape (len(inputs) + 1,) by name."""
    config = {
        "model_input_names": INPUTS,
        "model_output_names": OUTPUTS,
        "model_parameters": parameters or {},
        "time_step": time_step,
        "bounds": {},
    }
    env = House(fmugym.bundled_fmu("House", fmi_version), config)
    env.reset()
    rows = [env.state]
    for row in inputs:
        env.step(np.array(row))
        rows.append(env.state)
    env.close()
    return dict(zip(OUTPUTS, np.array(rows).T, strict=True))


def network(mass, water, outside, solar, internal):
    """Temperatures of air and surface, and the heat flows to mass and water but the heat pump's.

    Kirchhoff's law for the conductances between five nodes, with the default parameters.
    """
    total, effective = 4.5 * 150, 2.5 * 150
    ms = 9.1 * effective
    wires = {
        ("outside", "mass"): 1 / (1 / 100 - 1 / ms),
        ("mass", "surface"): ms,
        ("outside", "surface"): 40.0,
        ("surface", "air"): 3.45 * total,
        ("outside", "air"): 60.0,
        ("water", "air"): 400.0,
    }
    nodes = ["outside", "mass", "water", "air", "surface"]
    laplacian = np.zeros((5, 5))
    for (a, b), conductance in wires.items():
        i, j = nodes.index(a), nodes.index(b)
        laplacian[[i, j], [i, j]] += conductance
        laplacian[[i, j], [j, i]] -= conductance
    gains = internal / 2 + 8 * solar
    share = effective / total
    sources = np.array([share * gains, 0, internal / 2, (1 - share - 40 / (9.1 * total)) * gains])
    known = np.array([outside, mass, water])
    unknown = np.linalg.solve(laplacian[3:, 3:], sources[2:] - laplacian[3:, :3] @ known)
    flows = sources[:2] - laplacian[1:3] @ [*known, *unknown]
    return *unknown, *flows


def heat_pump(load, water, outside):
    lift = water - outside
    assert 15 < lift < 90
    return 3000 * load, 0.85 * (6.08 - 0.09 * lift + 0.0005 * lift**2)


def winter_day(steps):
    """Rows of inputs: frost, some sun, people in the evening, a heat pump at part load."""
    hours = np.arange(steps) / 4
    outside = KELVIN - 2 - 4 * np.cos(2 * np.pi * hours / 24)
    solar = 300 * np.clip(np.sin(2 * np.pi * (hours - 8) / 16), 0, None)
    internal = np.where(hours % 24 > 17, 900.0, 200.0)
    return np.array([outside, solar, internal, 0.5 + 0.3 * np.cos(hours)]).T


@pytest.mark.parametrize("fmi_version", VERSIONS)
def test_a_winter_day_agrees_with_scipy(fmi_version):
    inputs = winter_day(96)
    ours = simulate(inputs, fmi_version=fmi_version)
    state = np.array([293.15, 303.15, 0.0])
    for number, (outside, solar, internal, load) in enumerate(inputs, 1):

        def derivative(_, state, outside=outside, solar=solar, internal=internal, load=load):
            *_, to_mass, to_water = network(state[0], state[1], outside, solar, internal)
            power, cop = heat_pump(load, state[1], outside)
            return to_mass / (165000 * 150), (to_water + cop * power) / 2.5e6, power

        state = solve_ivp(derivative, (0, 900), state, "DOP853", rtol=1e-11, atol=1e-9).y[:, -1]
        air, surface, _, to_water = network(state[0], state[1], outside, solar, internal)
        power, cop = heat_pump(load, state[1], outside)
        theirs = [*state, air, 0.3 * air + 0.7 * surface, power, cop * power, -to_water, cop]
        mine = [ours[name][number] for name in OUTPUTS]
        assert mine == pytest.approx(theirs, rel=1e-9), number


def test_rest_without_heat_is_the_temperature_outside():
    ours = simulate([[268.15, 0, 0, 0]] * 60, time_step=86400.0)
    for name in ("T_m", "T_w", "T_air", "T_op"):
        assert ours[name][-1] == pytest.approx(268.15, abs=1e-4)
    assert ours["E"][-1] == 0


def test_a_steady_state_loses_what_the_heat_pump_gives():
    """Without gains, in a house of its parameters: Q_hp = sum of conductance * difference."""
    ours = simulate([[273.15, 0, 0, 0.5]] * 60, time_step=86400.0)
    surface = (ours["T_op"][-1] - 0.3 * ours["T_air"][-1]) / 0.7
    to_outside = 1 / (1 / 100 - 1 / (9.1 * 375))
    loss = (
        60 * ours["T_air"][-1]
        + 40 * surface
        + to_outside * ours["T_m"][-1]
        - 273.15 * (60 + 40 + to_outside)
    )
    assert loss > 3000
    assert ours["Q_hp"][-1] == pytest.approx(loss, rel=1e-6)


@pytest.mark.parametrize(
    ("load", "share"), [(0.0, 0), (0.19, 0), (0.2, 0.2), (0.7, 0.7), (1.0, 1.0)]
)
def test_part_load(load, share):
    ours = simulate([[278.15, 0, 300, load]])
    assert ours["P"][-1] == 3000 * share


def test_the_water_stays_below_its_largest_temperature():
    ours = simulate([[278.15, 0, 300, 1.0]] * 96, {"T_w_max": 308.15})
    assert 307.0 < ours["T_w"].max() < 308.15
    assert 0 < ours["P"][-1] < 3000


@pytest.mark.parametrize(("outside", "lift"), [(295.15, 15), (243.15, 60), (203.15, 90)])
def test_the_cop_at_its_limits(outside, lift):
    ours = simulate([[outside, 0, 300, 0]], {"T_w_0": 303.15, "max_step": 1e-3}, time_step=1e-3)
    assert ours["COP"][-1] == pytest.approx(0.85 * (6.08 - 0.09 * lift + 5e-4 * lift**2), rel=1e-6)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"A_f": 0.0}, "must lie between 1.0"),
        ({"a_m": 4.5}, "a_m must lie between"),
        ({"H_w": -1.0}, "H_w.* must lie between 0.0 and inf"),
        ({"u_min": 1.5}, "u_min.* must lie between"),
        ({"H_op": 1e5}, "H_op must be positive and less than"),
    ],
)
def test_parameters_without_sense_are_refused(parameters, message):
    with pytest.raises(fmugym.FMUGymError, match=message):
        simulate([], parameters)


@pytest.fixture
def year(monkeypatch):
    """The module that makes the synthetic year."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "resources" / "House"))
    import year

    return year


def test_the_year_is_made_anew(year):
    with year.FILE.open(newline="") as file:
        committed = list(csv.reader(file))
    assert committed[0] == list(year.COLUMNS)
    assert committed[1:] == [list(map(str, row)) for row in year.year()]
    assert len(committed) == 1 + 8760


@pytest.mark.parametrize(("day", "elevation"), [(171, 38 + 23.45), (354, 38 - 23.45), (80, 38)])
def test_the_sun_at_noon(year, day, elevation):
    """90 degrees minus the latitude, plus the declination: solstices and equinox."""
    sun = year.sun_at(day, 12.0)
    assert math.degrees(math.asin(sun.height)) == pytest.approx(elevation, abs=0.5)
    assert sun.on_south == pytest.approx(math.cos(math.asin(sun.height)))


def test_the_sun_over_the_day(year):
    assert year.sun_at(80, 6.0).height == pytest.approx(0, abs=0.02)  # it rises at the equinox
    assert year.sun_at(80, 9.0) == pytest.approx(year.sun_at(80, 15.0))
    assert year.global_irradiance(0.0, 0.0) == 0
    assert year.global_irradiance(1.0, 0.0) == pytest.approx(1098 * math.exp(-0.057))
    assert year.global_irradiance(0.5, 1.0) == pytest.approx(
        0.25 * year.global_irradiance(0.5, 0.0)
    )


@pytest.mark.parametrize("clearness", [0.22, 0.8])
def test_the_diffuse_share_is_continuous(year, clearness):
    shares = [year.diffuse_share(1367.0 * k, 1.0) for k in (clearness - 1e-9, clearness + 1e-9)]
    assert shares[0] == pytest.approx(shares[1], abs=5e-3)


def test_beam_and_wall(year):
    """All light on the ground and half of the sky's on the wall, where the sun is behind it."""
    behind = year.Sun(height=0.5, on_south=-0.3)
    ground = year.global_irradiance(0.5, 0.0)
    diffuse = ground * year.diffuse_share(ground, 0.5)
    assert year.irradiance_on_south(behind, 0.0) == pytest.approx(0.5 * diffuse + 0.1 * ground)
    low = year.Sun(height=0.5, on_south=math.sqrt(0.75))
    beam = (ground - diffuse) * math.sqrt(3)
    assert year.irradiance_on_south(low, 0.0) == pytest.approx(beam + 0.5 * diffuse + 0.1 * ground)


class TestEnvironment:
    def test_is_declared_in_few_lines(self):
        lines = HOUSE_TASK.read_text().splitlines()
        assert len(lines) <= 45
        assert max(map(len, lines)) <= 140

    def test_keeps_the_contract_of_gymnasium(self):
        env = gym.make("fmugym/House-v0")
        check_env(env.unwrapped, skip_render_check=True)
        env.close()

    @pytest.mark.parametrize("scenario", [None, "frost", "spring"])
    def test_observations_stay_in_their_space(self, scenario):
        env = gym.make("fmugym/House-v0", scenario=scenario)
        rng = np.random.default_rng(3)
        observation, _ = env.reset(seed=3)
        ended = False
        while not ended:
            assert env.observation_space.contains(observation)
            action = np.array([rng.random() * (observation[0] < 22)], np.float32)
            observation, _, terminated, ended, _ = env.step(action)
            assert not terminated
        env.close()

    def test_the_reward_is_money(self):
        """Electricity at the price of the hour, and 0.50 EUR for each hour and kelvin too cold."""
        metered = {"extends": str(HOUSE_TASK), "costs": {"energy": "E"}}
        with fmugym.load(metered, scenario="frost") as env:
            place = env.observation_names.index
            observation, _ = env.reset(seed=0)
            total = bill = meter = 0.0
            for number in range(200):
                price, before = observation[place("price")], meter
                load = np.array([1.0 if number > 100 else 0.0], np.float32)
                observation, reward, _, _, info = env.step(load)
                meter = info["costs"]["energy"]
                hour = (number + 1) % 96 / 4  # in the step that ends then, 22:00 is still day
                least = 21 if 6 < hour <= 22 else 19
                cold = max(least - observation[place("T")], 0)
                hot = max(observation[place("T")] - 24, 0)
                total += reward
                bill -= price * (meter - before) / 3.6e6 + 0.5 * (cold + hot) / 4
            assert total == pytest.approx(bill, rel=1e-3)
            assert total < -20

    def test_many_houses_are_compiled_and_equal_single_ones(self):
        require_same_alone(HouseEnv, 40, way="expressions")

    def test_a_better_controller_costs_less(self):
        """On weeks that training leaves out: no heating, a thermostat, a PI controller."""
        costs = {}
        controllers = {
            "none": PID("T", 0.0, kp=1.0),
            "thermostat": Hysteresis("T", 21.0, band=0.3),
            "PI": PID("T", 21.0, kp=0.5, ti=4 * 3600.0),
        }
        for scenario in ("autumn", "frost", "spring"):
            with HouseEnv(scenario) as env:
                for name, controller in controllers.items():
                    costs[name] = cost_of_a_week(env, controller.bind(env))
            assert costs["none"] > 1.5 * costs["thermostat"], scenario
            assert costs["thermostat"] > 1.03 * costs["PI"], scenario

    def test_an_unknown_scenario(self):
        with pytest.raises(fmugym.ConfigError, match=r"'forst'.*'frost'"):
            HouseEnv("forst")


def cost_of_a_week(env, controller):
    observation, info = env.reset(seed=0)
    cost = 0.0
    for _ in range(672):
        observation, reward, _, _, info = env.step(controller.act(observation, info))
        cost -= reward
    return cost
