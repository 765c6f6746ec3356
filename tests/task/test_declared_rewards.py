"""What is said of a declared reward that is not finite, and of tasks that are too large."""

import os
import time

import pytest
from ways import in_way

import fmugym
from fmugym.expressions.language import Expression

TASK = """
fmu = {{ bundled = "Pendulum" }}
time_step = "20ms"
{reward}
[variables]
tau = {{ min = -0.01, max = 0.01 }}
[expressions]
shift = "theta - theta_0"
[agent]
actions = ["tau"]
observations = ["theta", "theta_dot"]
[parameters]
theta_0 = 0.5
"""
TERMS = """
[reward]
near = "-theta**2"
rate = { expr = "tau / (step - step)", weight = 2.0 }
"""


@pytest.fixture
def task(tmp_path):
    def write(reward):
        path = tmp_path / "swing.toml"
        path.write_text(TASK.format(reward=reward))
        return path

    return write


def fault_of(env):
    env.reset(seed=0)
    return env.step(env.action_space.sample())[-1]["fault"]


@pytest.mark.parametrize("hooks", ["expressions", "arrays", "one by one"])
def test_the_term_its_line_and_the_values_are_named(task, hooks):
    path = task(TERMS)
    with fmugym.load(path) as env:
        single = fault_of(env)
    envs = fmugym.FMUVectorEnv(in_way(hooks, lambda: fmugym.load(path)), 2)
    several = fault_of(envs)
    envs.close()
    for text in (single, *several):
        for fact in ("swing.toml, line 7, reward.rate", "tau / (step - step)", "step = 1", "inf"):
            assert fact in text
        assert "near" not in text


def test_a_reward_without_a_name_and_previous_values(task):
    with fmugym.load(task('reward = "1 / (theta - previous(theta_dot) - theta)"')) as env:
        text = fault_of(env)
    for fact in ("swing.toml, line 4, reward", "previous(theta_dot) = 0", "theta = 0.5"):
        assert fact in text


def test_a_sum_of_finite_terms(task):
    with fmugym.load(task('[reward]\nmuch = "1e308"\nmore = "theta_0 * 0 + 1e308"')) as env:
        assert "much" in (text := fault_of(env))
        assert "more" in text


def in_a_row(text, count):
    """Expressions, each of which reads the one before, in the place of the task's own."""
    lines = ['e0 = "theta"']
    lines += [f'e{i} = "{text}"'.replace("E", f"e{i - 1}") for i in range(1, count)]
    return 'shift = "theta - theta_0"', "\n".join([*lines, f'shift = "e{count - 1}"'])


REWARD = 'reward = "shift"'
KPIS = "\n".join(["", "[kpis]", *(f'k{i} = {{ last = "shift * {i}" }}' for i in range(50))])
LARGE = {
    "many terms": (
        'shift = "theta - theta_0"\n[agent]',
        'shift = "sin(time) + cos(time) + exp(-time) + abs(time) + sqrt(time) + log(time + 1)"\n'
        + "".join(f's{i} = "shift * {i} + (shift - {i}) / {i + 1}"\n' for i in range(90))
        + "[agent]\n"
        + f"forecast = {{ of = {[f's{i}' for i in range(90)]}, horizon = 20 }}",
    ),
    "power of powers": ("tau = {", 'theta = { unit = "deg**9**9**9" }\ntau = {'),
    "power of numbers": ("tau = {", 'theta = { unit = "(9**99)**99 deg" }\ntau = {'),
    "device": (REWARD, f'{REWARD}\nextends = "/dev/zero"'),
    "pipe": (REWARD, f'{REWARD}\nextends = "pipe"'),
    "data": ("[agent]", '[data.x]\nfile = "pipe"\ncolumn = "a"\nstep = "1s"\n[agent]'),
}


@pytest.mark.skipif(os.name != "posix", reason="Windows has no such pipes and devices")
@pytest.mark.parametrize("case", LARGE)
def test_what_is_too_large_is_refused_at_once(task, case):
    path = task(REWARD)
    fmugym.load(path).close()  # what is imported and read only once
    os.mkfifo(path.parent / "pipe")
    path.write_text(path.read_text().replace(*LARGE[case]))
    begin = time.process_time()
    with pytest.raises(fmugym.ConfigError, match=r"swing\.toml"):
        fmugym.load(path)
    assert time.process_time() - begin < 40.0  # with coverage, on a busy machine; else 5


def test_a_row_that_users_write_is_taken_at_once(task):
    """Seven names, each of which is the largest of eight operands."""
    path = task(REWARD)
    fmugym.load(path).close()
    row = in_a_row("max(E, -1, -2, E / 2, -3, -4, theta_dot - 5, tau)", 8)
    path.write_text(path.read_text().replace(*row))
    begin = time.process_time()
    with fmugym.load(path) as env:
        env.reset(seed=0)
        (theta, _), reward, *_ = env.step(env.action_space.low)
        assert theta > 0
        assert reward == pytest.approx(theta)
    assert time.process_time() - begin < 1.0


COMPUTED_ONCE = {
    "doubled": ("E + E", 61, lambda theta: theta * 2.0**60),
    "many operands": ("max(E, 1, E, 2, E, 3, E, 4, E, E, E, E)", 9, lambda theta: 4.0),
}


@pytest.mark.parametrize("case", COMPUTED_ONCE)
@pytest.mark.parametrize("hooks", ["expressions", "Python"])
def test_what_many_terms_read_is_computed_once(task, case, hooks, load):
    text, count, value = COMPUTED_ONCE[case]
    path = task(REWARD)
    path.write_text(path.read_text().replace(*in_a_row(text, count)) + KPIS)
    env = load(path, way=hooks)
    env.reset(seed=0)
    _, reward, *_, info = env.step(env.action_space.sample())
    assert reward == value(env.unwrapped.out["theta"])
    assert info["kpis"]["k49"] == 49 * reward


@pytest.mark.parametrize(("text", "count"), [("E + E", 12), ("E if E > 0 else -E", 7)])
def test_what_many_expressions_read_is_written_once(task, monkeypatch, text, count):
    path = task(REWARD)
    path.write_text(path.read_text().replace(*in_a_row(text, count)))
    value, written = Expression.value, []

    def write(self, names):
        written.append(self.text)
        return value(self, names)

    monkeypatch.setattr(Expression, "value", write)
    fmugym.load(path).close()
    assert (
        max(map(written.count, written)) <= 5
    )  # once for each moment that evaluates it, and to check
