"""Compare every FMU of a folder with FMPy: ``python tests/tools/held_out.py FOLDER [--timeout S]``.

Each FMU for co-simulation plays three episodes with inputs that move: in a single environment, in
vector environments with one and with two threads, and in worker processes. FMPy makes the same
calls on a fresh instance of a fresh copy of the library for each episode. Each of these runs in a
process of its own. There is a line for each FMU, and the share of right ones among those that FMPy
can step at the end.

"same" means equal to the last bit, "close" within ten solver tolerances.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import fresh
import gymnasium as gym
import numpy as np

import fmugym
from fmugym.cli.class_skeleton import Skeleton

SETTINGS = ("single", "vector", "threads", "isolated")
LENGTHS = (20, 40, 20)
NUM_ENVS = 3
MOST_OUTPUTS = 50
SLACK = 10.0
TOLERANCE = 1e-4
"""Where the FMU has none."""


class HeldOutEnv(fmugym.FMUEnv):
    """Takes the inputs as action, and reads outputs."""

    def __init__(self, path, config, **options):
        self._count = len(config["model_input_names"])
        super().__init__(path, config, **options)

    def _get_action_space(self):
        if not self._count:
            return gym.spaces.Discrete(1)
        return gym.spaces.Box(-np.inf, np.inf, (self._count,), np.float64)

    def _get_inputs(self):
        return tuple(self.action) if self._count else ()

    def _is_done(self):
        return False


def config_of(path):
    """The names, limits and times of the FMU's skeleton, without parameters."""
    found = {}
    text = Skeleton(fmugym.FMU(path)).text()
    text = text.replace("super().__init__(FMU_PATH, config, log_level)", "found.update(config)")
    names = {"__name__": "made", "found": found}
    exec(compile(text, "made.py", "exec"), names)
    next(value for name, value in names.items() if name.endswith("Env"))()
    found["model_output_names"] = found["model_output_names"][:MOST_OUTPUTS]
    return found | {"model_parameters": {}, "max_episode_steps": None, "on_fault": "raise"}


def inputs_of(path, config, length, index):
    """Inputs of one environment that move within their limits, shape (steps, inputs)."""
    fmu = fmugym.FMU(path)
    rows = np.empty((length, len(config["model_input_names"])))
    for column, name in enumerate(config["model_input_names"]):
        fraction = 0.5 + 0.45 * np.sin((0.7 + 0.3 * column) * np.arange(length) + index)
        rows[:, column] = _values(fmu.variable(name), config.get("bounds", {}), fraction)
    return rows


def _values(variable, bounds, fraction):
    if variable.kind == "boolean":
        return fraction > 0.5
    if variable.items:
        values = np.array(sorted(value for _, value in variable.items))
        return values[(fraction * len(values)).astype(int)]
    low, high = bounds.get(variable.name, (variable.minimum, variable.maximum))
    values = low + fraction * (high - low)
    return np.rint(values) if variable.kind == "integer" else values


def play_fmpy(path, config):
    """All episodes of all environments; the first environment's come first."""
    description = fmugym.FMU(path, interface="co_simulation").description
    times = {"start_time": description.start_time, "tolerance": description.tolerance}
    names = config["model_input_names"]

    def play(length, index):
        rows = inputs_of(path, config, length, index).tolist()
        rows = [dict(zip(names, row, strict=True)) for row in rows]
        return fresh.play(path, config["model_output_names"], rows, config["time_step"], **times)

    return [[play(length, index) for length in LENGTHS] for index in range(NUM_ENVS)]


def play_single(path, config):
    """The episodes of the first environment."""
    env = HeldOutEnv(path, config)
    episodes = []
    for length in LENGTHS:
        env.reset()
        rows = inputs_of(path, config, length, 0)
        episodes.append(fresh.episode(env, rows if rows.size else [0] * length))
    env.close()
    return [episodes]


def play_vector(path, config, **options):
    """The episodes of all environments, which end together."""
    options = {"threads": 1} | options
    envs = fmugym.FMUVectorEnv(
        lambda: HeldOutEnv(path, config), NUM_ENVS, autoreset_mode="Disabled", **options
    )
    episodes = []
    for length in LENGTHS:
        envs.reset()
        rows = np.stack([inputs_of(path, config, length, i) for i in range(NUM_ENVS)], axis=1)
        actions = rows if rows.size else np.zeros((length, NUM_ENVS), np.int64)
        episodes.append(fresh.episodes(envs, actions))
    envs.close()
    return [list(episode) for episode in zip(*episodes, strict=True)]


def play_threads(path, config):
    """The same with two threads."""
    return play_vector(path, config, threads=2)


def play_isolated(path, config):
    """The same in worker processes."""
    return play_vector(path, config, isolation="process")


PLAYERS = {
    "fmpy": play_fmpy,
    "single": play_single,
    "vector": play_vector,
    "threads": play_threads,
    "isolated": play_isolated,
}


def run(path, player, timeout):
    """Play in a process of its own; returns the episodes, or why there are none."""
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder) / "answer"
        command = [sys.executable, __file__, str(path), "--player", player, "--answer", str(answer)]
        try:
            done = subprocess.run(
                command, cwd=folder, capture_output=True, timeout=timeout, check=False
            )
        except subprocess.TimeoutExpired:
            return f"hangs for {timeout:g} s"
        if answer.exists():
            return json.loads(answer.read_text())
        lines = done.stderr.decode(errors="replace").strip().splitlines() or [""]
        return f"exit status {done.returncode}: {lines[-1]}"


def judge(episodes, reference, tolerance):
    """Compare episodes with those of FMPy; a text is why there are none."""
    if isinstance(episodes, str):
        return episodes
    worst = 0.0
    for ours, theirs in zip(episodes, reference, strict=False):
        for mine, right in zip(ours, theirs, strict=True):
            if len(mine) != len(right):
                return f"WRONG: an episode has {len(mine) - 1} steps, not {len(right) - 1}"
            worst = max(worst, difference(np.array(mine), np.array(right)))
    if worst == 0.0:
        return "same"
    return f"close: {worst:.1e}" if worst <= SLACK * tolerance else f"WRONG: {worst:.1e}"


def difference(one, other):
    """The largest difference of an output, as a fraction of its largest magnitude."""
    scale = np.maximum(np.abs(other).max(axis=0), 1e-300)
    return float(np.nan_to_num(np.abs(one - other).max(axis=0) / scale, nan=np.inf).max())


def compare(path, timeout):
    """The verdicts on one FMU by setting, that of FMPy first."""
    reference = run(path, "fmpy", timeout)
    if isinstance(reference, str):
        return {"fmpy": reference}
    tolerance = fmugym.FMU(path).description.tolerance or TOLERANCE
    verdicts = {s: judge(run(path, s, timeout), reference, tolerance) for s in SETTINGS}
    return {"fmpy": "steps"} | verdicts


def report(folder, timeout):
    """Print a line for each FMU, and the shares."""
    right = steppable = 0
    for path in sorted(folder.rglob("*.fmu")):
        verdicts = compare(path.resolve(), timeout)
        if verdicts["fmpy"] == "steps":
            steppable += 1
            right += all(verdicts[s].startswith(("same", "close")) for s in SETTINGS)
        texts = " | ".join(f"{name}: {text}" for name, text in verdicts.items())
        sys.stdout.write(f"{path.relative_to(folder)} | {texts}\n")
        sys.stdout.flush()
    sys.stdout.write(f"FMPy steps {steppable}; right in all settings: {right}\n")


def main():
    """Compare a folder, or play one FMU for the process that compares."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", type=Path)
    parser.add_argument("--timeout", type=float, default=120.0)
    parser.add_argument("--player", choices=PLAYERS, help=argparse.SUPPRESS)
    parser.add_argument("--answer", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.player is None:
        report(given.path, given.timeout)
        return
    episodes = PLAYERS[given.player](given.path, config_of(given.path))
    given.answer.write_text(json.dumps(episodes))


if __name__ == "__main__":
    main()
