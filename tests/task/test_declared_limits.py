"""Task files that are damaged, hostile or far too long: one error with the place, and soon."""

import os
import socket
import textwrap

import pytest

import fmugym
from fmugym import ConfigError, TaskError
from fmugym.checks import require_regular

TASK = """
fmu = {{ bundled = "Pendulum" }}
{more}
time_step = {step}
reward = {reward}
[variables]
tau = {{ min = -1, max = 1 }}
[agent]
actions = "tau"
observations = "q"
"""


def text_of(step="0.1", reward='"-abs(q)"', more="", end=""):
    return TASK.format(step=step, reward=reward, more=more) + end


QUOTED = ".".join(['"a"'] * 60)
DIGITS = "1" * 100_000
TEXTS = {
    "an integer of many digits": (text_of(DIGITS), "line 4: a number has 1000 digits at most"),
    "a hexadecimal one": (text_of(reward="0x" + "f" * 100_000), "line 5, reward: .*a finite num"),
    "a number beyond all floats": (text_of("1e999"), "line 4, time_step: .*finite.*inf"),
    "such an integer": (
        text_of("1" + 400 * "0"),
        "line 4, time_step: .*must be a number, got 1000",
    ),
    "such a reward": (text_of(reward="1e999"), "line 5, reward: .*finite number, got inf"),
    "such an expression": (
        text_of(reward='"10.0**400"'),
        "line 5, reward: '10.0.*no finite number",
    ),
    "such a controller": (
        text_of(more=f"warm_up = {{ period = 1, controller = 1{400 * '0'} }}"),
        "line 3, warm_up.controller: .*must be a number",
    ),
    "a table in thousands": (text_of(end=f"[{'.'.join(20_000 * 'a')}]"), "line 11: .* 50 times"),
    "a key of thousands": (text_of(end=f"{'.'.join(20_000 * 'a')} = 1"), "line 11: .* 50 times"),
    "quoted ones": (text_of(end=f"[{QUOTED}]\nx = 1"), "line 11: .* 50 times"),
    "inline ones": (text_of(end=f"x = {'{a=' * 60}1{'}' * 60}"), "50 times"),
    "a list in thousands": (text_of(end=f"x = {20_000 * '['}{20_000 * ']'}"), "50 times"),
    "a link to itself": (
        text_of(more='extends = "loop"'),
        "line 3, extends: .*loop.*symbolic links",
    ),
    "links in a circle": (
        text_of(more='extends = "one"'),
        "line 3, extends: .*one.*symbolic links",
    ),
    **{
        f"a NUL in {key}": (text_of(more=f'{key} = "a\\u0000b"'), rf"line 3, {key}: .*NUL.*a\\x00b")
        for key in ("extends", "fitted")
    },
    "a NUL in a home": (text_of(more='extends = "~\\u0000/b"'), "line 3, extends: .*NUL"),
    "a NUL in fmu": (
        text_of().replace('{ bundled = "Pendulum" }', '"a\\u0000.fmu"'),
        "line 2, fmu: .*NUL",
    ),
    "a NUL in data": (
        text_of(end='[data]\nx = { file = "a\\u0000.csv", column = 1 }'),
        "line 12, data.x.file: .*NUL",
    ),
    "terms": (
        text_of(reward="{" + ", ".join(f'r{n} = "-q"' for n in range(20_000)) + "}"),
        "line 5, reward: .*at most 5000 names, got 20000",
    ),
    "levels": (
        text_of().replace("min = -1, max = 1", f"levels = {[*range(100_000)]}"),
        "line 7, variables.tau.levels: .*at most 10000 levels, got 100000",
    ),
    "observations": (
        text_of().replace('observations = "q"', f"observations = {['q'] * 100_000}"),
        "line 10, agent.observations: .*at most 5000 names, got 100000",
    ),
    "bytes": ("#" * (16 * 2**20 + 1), "has more than 16777216 bytes"),
}


@pytest.mark.parametrize(("text", "told"), TEXTS.values(), ids=TEXTS)
def test_is_told_with_its_place(text, told, tmp_path):
    for name, target in {"loop": "loop", "one": "two", "two": "one"}.items():
        (tmp_path / name).symlink_to(tmp_path / target)
    file = tmp_path / "wrong.toml"
    file.write_text(text)
    with pytest.raises(
        ConfigError, match=rf"wrong\.toml'?,? ?{told}|wrong\.toml.*{told}"
    ) as caught:
        fmugym.load(file)
    assert len(str(caught.value)) < 500


def task(**changes):
    return {
        "fmu": {"bundled": "Pendulum"},
        "time_step": 0.1,
        "reward": "-abs(q)",
        "variables": {"tau": {"min": -1, "max": 1}},
        "agent": {"actions": "tau", "observations": "q"},
        **changes,
    }


def test_a_dict_that_holds_itself_is_refused():
    own = task()
    own["arguments"] = {"own": own, "others": [own, own]}
    with pytest.raises(ConfigError, match="50 times"):
        fmugym.load(own)


@pytest.mark.parametrize(
    "changes",
    [
        {"start_time": 10**5000},
        {"time_step": 10**5000},
        {"clock": {"from": 10**5000, "to": "04-15"}},
        {"reward": 10**5000},
        {"variables": {"tau": {"min": -(10**5000), "max": 1}}},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_an_integer_of_thousands_of_digits_is_refused_in_a_dict_too(changes):
    with pytest.raises(TaskError, match=next(iter(changes))):
        fmugym.load(task(**changes))


def test_thousands_of_expressions_may_read_each_other():
    count = 1500
    chain = {f"e{n}": f"e{n - 1} + 1" for n in range(1, count)}
    env = fmugym.load(task(expressions={"e0": "q", **chain}, reward=f"e{count - 1}"))
    env.reset(seed=0)
    observation, reward, *_ = env.step(env.action_space.sample())
    assert reward == pytest.approx(observation[0] + count - 1, rel=1e-6)
    env.close()


def test_a_circle_of_thousands_is_told_once():
    count = 1500
    chain = {f"e{n}": f"e{(n - 1) % count} + 1" for n in range(count)}
    with pytest.raises(TaskError, match=r"^expressions.e0: 'e0' depends on itself$"):
        fmugym.load(task(expressions=chain))


def test_the_first_hundred_mistakes_are_told():
    with pytest.raises(TaskError) as caught:
        fmugym.load(task(reward={f"r{n}": f"-nowhere_{n}" for n in range(5000)}))
    lines = str(caught.value).splitlines()
    assert len(lines) == 101
    assert "first 100 mistakes" in lines[-1]


@pytest.mark.parametrize("name", ["a pipe", "a socket", "a folder"])
def test_what_is_no_file_is_refused(name, tmp_path):
    path = tmp_path / "odd"
    if name == "a pipe":
        os.mkfifo(path)
    elif name == "a folder":
        path.mkdir()
    else:
        with socket.socket(socket.AF_UNIX) as one:
            one.bind(str(path))
    with pytest.raises(OSError, match="no regular file"):
        require_regular(path)


PATHS = ("/dev/zero", "/proc/self/environ", "/sys/kernel/notes")


@pytest.mark.parametrize("path", [one for one in PATHS if os.path.exists(one)])
def test_devices_and_files_of_the_kernel_are_refused(path, tmp_path, refused):
    file = tmp_path / "task.toml"
    uses = {
        "extends": text_of(more=f'extends = "{path}"'),
        "fitted": text_of(more=f'fitted = "{path}"'),
        "data.x.file": text_of(end=f'[data]\nx = {{ file = "{path}", column = 1 }}'),
        "fmu": text_of().replace('{ bundled = "Pendulum" }', f'"{path}"'),
    }
    for key, text in uses.items():
        file.write_text(text)
        with pytest.raises(fmugym.errors.FMUGymError, match=f"{key}.*{path.rpartition('/')[2]}"):
            fmugym.load(file)
    file.write_text(textwrap.dedent(text_of()))
    (tmp_path / "agent").mkdir()
    (tmp_path / "agent" / "policy.json").symlink_to(path)
    assert "agent" in refused("evaluate", file, "--agent", tmp_path / "agent")
    assert "cannot be read" in refused("evaluate", file, "--log", path)
    refused("validate", path)
    refused("info", path)
