"""Start values stay in the ranges of the FMU, unless the task gives others."""

import logging
import re

import numpy as np
import pytest
from fmu_tools import PlainEnv, edited_fmu
from scipy import stats

import fmugym
from fmugym import Choice, ConfigError, LogUniform, Normal, Uniform
from fmugym.environment import fmu_variables
from fmugym.environment.env_checker import check_fmu_env

FMU = fmugym.bundled_fmu("Pendulum")
FRICTION = "'c'.*0.*inf N.m.*FMU's min and max"
"""The range of the parameter c; g is from 0 to 1000."""

TASK = """\
fmu = {bundled = "Pendulum"}
time_step = 0.05
reward = "-q"

[agent]
actions = ["tau"]
observations = ["q", "q_dot"]

[variables]
tau = {min = -0.01, max = 0.01}
q = {min = -7, max = 7}
q_dot = {min = -50, max = 50}
friction = {name = "c", unit = "N.mm"%s}

[parameters]
friction = %s
"""


class Ticking:
    """A distribution of the user's own, which draws -1, 0, 1, -1, ..."""

    def __init__(self):
        self._count = 0

    def sample(self, rng):
        self._count += 1
        return (self._count + 1) % 3 - 1.0


REFUSED = {
    "number": -1,
    "uniform": Uniform(-0.1, 1.0),
    "choice": Choice([0.5, -0.5]),
    "scipy": stats.uniform(-0.5, 1),
    "discrete": stats.randint(-2, 3),
    "with limits": Normal(0.1, 0.5, low=-1, high=1),
    "mean outside": Normal(-1, 0.5),
    "hardly inside": stats.norm(-5, 1),
}
UNBOUNDED = {
    "native": Normal(0.5, 0.4),
    "scipy": stats.norm(0.5, 0.4),
    "one-sided": stats.expon(-0.2, 0.5),
}


def config(bounds=None, **parameters):
    return {
        "model_input_names": "tau",
        "model_output_names": ["q", "q_dot"],
        "model_parameters": parameters,
        "bounds": {"q": (-7, 7), "q_dot": (-50, 50), "tau": (-0.01, 0.01)} | (bounds or {}),
        "time_step": 0.05,
    }


@pytest.fixture
def make(opened):
    """Make environments that are closed after the test."""

    def make(bounds=None, fmu=FMU, **parameters):
        return opened(PlainEnv(fmu, config(bounds, **parameters)))

    return make


@pytest.fixture
def text(tmp_path):
    """Write task files with a value of the friction in N.mm, and a range of their own."""

    def write(value, limits=""):
        path = tmp_path / "own.toml"
        path.write_text(TASK % (limits, value))
        return path

    return write


class TestRefused:
    @pytest.mark.parametrize("value", REFUSED.values(), ids=REFUSED)
    def test_in_a_config(self, value, make):
        with pytest.raises(ConfigError, match=FRICTION):
            make(c=value)

    def test_above_the_greatest_value(self, make):
        with pytest.raises(ConfigError, match=r"'g'.*1000.*LogUniform\(low=1.0, high=1001.0\)"):
            make(g=LogUniform(1, 1001))

    @pytest.mark.parametrize("value", ["-1", '{distribution = "uniform", low = -1, high = 1}'])
    def test_in_a_task_file_which_is_named_with_the_line(self, value, text):
        with pytest.raises(ConfigError, match=rf"own.toml.*16.*{FRICTION}"):
            fmugym.load(text(value))

    def test_at_a_reset(self, make):
        env = make(c=0.1)
        with pytest.raises(ConfigError, match=FRICTION):
            env.reset(options={"model_parameters": {"c": -0.1}})

    def test_in_one_of_many_environments(self, make_envs):
        envs = make_envs(lambda: PlainEnv(FMU, config(c=0.1)), 3)
        with pytest.raises(ConfigError, match=FRICTION):
            envs.set_attr("c", [0.1, 0.2, -0.1])
        envs.set_attr("c", [0.1, 0.2, 0.3])
        envs.reset(seed=0)
        assert list(envs.get_attr("c")) == [0.1, 0.2, 0.3]

    def test_by_the_range_that_the_config_gives(self, make):
        with pytest.raises(ConfigError, match=r"'c'.*0\.1 and 0\.2.*task gives.*0\.3"):
            make({"c": (0.1, 0.2)}, c=0.3)


class TestTaken:
    def test_in_another_range_of_the_config(self, make):
        env = make({"g": (-20, 20)}, g=Uniform(-12, -9))
        env.reset(seed=0)
        assert -12 <= env.parameters["g"] <= -9

    def test_in_another_range_of_the_task_file(self, text):
        for value, limits in (("-1", ", min = -2"), ("999", ", max = 1000")):
            env = fmugym.load(text(value, limits))
            assert env.config.model_parameters["c"] == pytest.approx(float(value) / 1000)
            env.close()
        with pytest.raises(ConfigError, match=r"'c'.*0\.0 and 1\.0 N.m.*task gives"):
            fmugym.load(text("1001", ", max = 1000"))

    def test_by_checks_that_change_parameters(self, make):
        check_fmu_env(make({"g": (9.8, 9.82)}, g=9.81))

    def test_limits_that_a_conversion_rounds(self, text):
        for value in (0.1 + 0.2, 0.3):
            fmugym.load(text(value * 1000, ", max = 300")).close()

    @pytest.mark.parametrize(
        "edit",
        ['min="0" max="0"', 'min="5" max="-5"', 'min="100"', 'max="1"', 'min="-1e60" max="1e60"'],
    )
    def test_in_spite_of_a_range_that_makes_no_sense(self, edit, make, tmp_path, caplog):
        own = '<Real unit="m/s2" min="0" max="1000" nominal="10" start="9.81"/>'
        fmu = edited_fmu(FMU, tmp_path, {own: f'<Real unit="m/s2" {edit} start="9.81"/>'})
        env = make(fmu=fmu, g=Normal(7.0, 2.0))
        env.reset(seed=0)
        assert "'g'" not in caplog.text
        make(fmu=fmu)  # the FMU's own start value is nobody's mistake


class TestTruncated:
    @pytest.mark.parametrize("kind", UNBOUNDED)
    def test_single_and_vector_environments_draw_the_same(self, kind, make, make_envs):
        distribution = UNBOUNDED[kind]
        envs = make_envs(lambda: PlainEnv(FMU, config(c=distribution, b=Uniform(0, 1))), 100)
        singles = [make(c=distribution, b=Uniform(0, 1)) for _ in range(4)]
        for seed in (7, None):
            envs.reset(seed=seed)
            for index, env in enumerate(singles):
                env.reset(seed=None if seed is None else seed + index)
                for name in ("c", "b"):
                    assert env.parameters[name] == envs.get_attr(name)[index]
            assert min(envs.get_attr("c")) >= 0

    @pytest.mark.parametrize("kind", UNBOUNDED)
    def test_distributed_as_in_scipy(self, kind, make):
        env, rng = make({"c": (0, 0.9)}, c=UNBOUNDED[kind]), np.random.default_rng(1)
        values = [env.episode_start.draw_values(rng)[0] for _ in range(2000)]
        whole = stats.expon(-0.2, 0.5) if kind == "one-sided" else stats.norm(0.5, 0.4)
        below, within = whole.cdf(0), whole.cdf(0.9) - whole.cdf(0)
        assert stats.kstest(values, lambda x: (whole.cdf(x) - below) / within).pvalue > 0.01
        assert min(values) >= 0
        assert max(values) <= 0.9

    def test_draws_in_the_range_stay_as_they_are(self, make):
        for distribution in (stats.norm(0.5, 0.4), Normal(0.5, 0.4)):
            free, bound = (
                make(theta_0=distribution),
                make({"theta_0": (0, 9)}, theta_0=distribution),
            )
            for seed in range(20):
                free.reset(seed=seed)
                bound.reset(seed=seed)
                first, second = (env.parameters["theta_0"] for env in (free, bound))
                assert first == second or first < 0 <= second

    def test_a_distribution_of_the_users_own(self, make):
        env = make(c=Ticking())
        seen = []
        for _ in range(4):
            env.reset()
            seen.append(env.parameters["c"])
        assert sorted(seen) == [0.0, 0.0, 1.0, 1.0]

    def test_what_never_draws_in_the_range_is_an_error(self, make):
        class Stuck:
            def sample(self, rng):
                return -1.0

        with pytest.raises(ConfigError, match="Stuck"):
            make(c=Stuck()).reset(seed=0)

    def test_the_log_says_so_once(self, make, text, caplog, tmp_path):
        """The FMU has limits of its own, of which no other test lets the log tell."""
        own = {'min="0" nominal="0.001"': 'min="0" max="77"', 'max="1000"': 'max="777"'}
        fmu = edited_fmu(FMU, tmp_path, own)
        task = text('{distribution = "normal", mean = 1, std = 1}')
        task.write_text(task.read_text().replace('{bundled = "Pendulum"}', f'"{fmu.as_posix()}"'))
        with caplog.at_level(logging.WARNING):
            for _ in range(2):
                make(fmu=fmu, c=stats.norm(0.5, 0.25)).reset(seed=0)
                fmugym.load(task).close()
            make(fmu=fmu, g=Normal(10, 1), m=Normal(0.5, 0.1, low=0.1))
        told = [one.getMessage() for one in caplog.records if one.name == fmu_variables.__name__]
        assert len(told) == 2
        assert re.search(r"'c'.*0\.0 and 77\.0 N\.m, the FMU's min and max", told[0])
        assert re.search(r"'g'.*0\.0 and 777\.0", told[1])
