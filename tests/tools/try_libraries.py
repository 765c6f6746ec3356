"""Try libraries of reinforcement learning with FMU environments, and write the table of the docs.

Each library gets an environment of its own, in which it chooses the versions of everything. So this
takes some minutes and downloads several gigabytes; it is run before a release::

    python tests/tools/try_libraries.py                    # all
    python tests/tools/try_libraries.py TorchRL skrl       # some

It prints the table. ``--write`` puts it into ``docs/libraries.md``.
"""

import argparse
import re
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "libraries.md"
TORCH = ("torch==2.13.0",)
HEAD = (
    "| library | version | Gymnasium | the line that makes it run | result |\n|---|---|---|---|---|"
)


class Library(NamedTuple):
    """A library and a short program.

    Attributes:
        package: Its name among Python packages.
        line: What a user writes; the table shows it.
        use: What the program then does.
        before: Imports that ``line`` needs, beside those of fmugym and Gymnasium.
        extra: The extra of fmugym for it.
        more: What must be installed besides.
        over: What is installed over the versions that it asks for.
        note: What the table adds.
    """

    package: str
    line: str
    use: str
    before: str = ""
    extra: str = ""
    more: tuple[str, ...] = ()
    over: tuple[str, ...] = ()
    note: str = ""


LIBRARIES = {
    "Stable-Baselines3": Library(
        "stable-baselines3",
        'env = make_sb3_env("fmugym/CartPole-v0", num_envs=8)',
        'PPO("MlpPolicy", env, n_steps=64, batch_size=128, device="cpu").learn(1024)',
        "from stable_baselines3 import PPO\nfrom fmugym.training.sb3 import make_sb3_env",
        extra="sb3",
    ),
    "TorchRL": Library(
        "torchrl",
        'env = GymWrapper(make_vec("fmugym/CartPole-v0", num_envs=8, autoreset_mode="disabled"))',
        "assert env.rollout(50, break_when_any_done=False).batch_size == (8, 50)",
        "from gymnasium import make_vec\nfrom torchrl.envs import GymWrapper",
    ),
    "RLlib": Library(
        "ray",
        'register_task("cart-pole", "fmugym/CartPole-v0")',
        """
        config = PPOConfig().environment("cart-pole").env_runners(
            num_env_runners=0, num_envs_per_env_runner=8,
            gym_env_vectorize_mode="vector_entry_point",
        ).training(train_batch_size_per_learner=256, minibatch_size=128, num_epochs=1)
        config.build_algo().train()
        """,
        "from ray.rllib.algorithms.ppo import PPOConfig\n"
        "from fmugym.training.rllib import register_task",
        extra="rllib",
    ),
    "skrl": Library(
        "skrl",
        'env = wrap_env(gymnasium.make_vec("fmugym/CartPole-v0", num_envs=8))',
        """
        env.reset()
        for _ in range(50):
            observations, *_ = env.step(torch.randint(0, 2, (8, 1)))
        assert observations.shape == (8, 4)
        """,
        "import torch\nfrom skrl.envs.wrappers.torch import wrap_env",
    ),
    "AgileRL": Library(
        "agilerl",
        'env = gymnasium.make_vec("fmugym/CartPole-v0", num_envs=8)',
        """
        agent = PPO(env.single_observation_space, env.single_action_space, num_envs=8)
        train_on_policy(env, "cart-pole", "PPO", [agent], max_steps=512, evo_steps=512,
                        eval_loop=1, verbose=False)
        """,
        "from agilerl.algorithms import PPO\n"
        "from agilerl.training.train_on_policy import train_on_policy",
        more=("peft",),
        note="imports `peft`, which it does not install",
    ),
    "Tianshou": Library(
        "tianshou",
        'env = DummyVectorEnv([lambda: gymnasium.make("fmugym/CartPole-v0")] * 8)',
        """
        env.reset()
        for _ in range(50):
            observations, *_, terminated, truncated, _ = env.step(numpy.ones(8, int))
            ended = numpy.flatnonzero(terminated | truncated)
            if len(ended):
                env.reset(ended)
        assert observations.shape == (8, 4)
        """,
        "import numpy\nfrom tianshou.env import DummyVectorEnv",
        note="single environments: its vector environments are its own classes",
    ),
    "d3rlpy": Library(
        "d3rlpy",
        'env = gymnasium.make("fmugym/CartPole-v0")',
        """
        algorithm = d3rlpy.algos.DQNConfig().create(device="cpu:0")
        buffer = d3rlpy.dataset.create_fifo_replay_buffer(limit=1000, env=env)
        algorithm.fit_online(env, buffer, n_steps=60, n_steps_per_epoch=60, update_start_step=40,
                             logger_adapter=d3rlpy.logging.NoopAdapterFactory())
        """,
        "import d3rlpy",
        over=("gymnasium>=1.2",),
        note="asks for Gymnasium 1.0.0; newer ones work once installed over it",
    ),
}


def program(library: Library) -> str:
    """The program that is run."""
    imports = f"import gymnasium\nimport fmugym\n{library.before}\n"
    return f"{imports}{library.line}\n{textwrap.dedent(library.use).strip()}\n"


def versions(python: Path, *packages: str) -> list[str]:
    """The versions of installed packages."""
    code = "import sys; from importlib.metadata import version as v; print(*map(v, sys.argv[1:]))"
    return run([python, "-c", code, *packages]).stdout.split()


def run(command: list[object], **options: object) -> subprocess.CompletedProcess[str]:
    """Run a program, which must end within 20 minutes."""
    return subprocess.run(
        list(map(str, command)), capture_output=True, text=True, timeout=1200, **options
    )


def install(folder: Path, library: Library) -> Path:
    """Make an environment with the library and fmugym."""
    run([sys.executable, "-m", "venv", folder], check=True)
    python = folder / "bin" / "python"
    pip = [python, "-m", "pip", "install", "--quiet"]
    toolbox = f"{ROOT}[{library.extra}]" if library.extra else str(ROOT)
    run([*pip, *TORCH], check=True)
    run([*pip, library.package, *library.more], check=True)
    if library.over:
        run([*pip, "--no-deps", *library.over], check=True)
        run([*pip, "fmpy", "pint", "pygame", "tomlkit"], check=True)
    run([*pip, *(["--no-deps"] if library.over else []), toolbox], check=True)
    return python


def tried(name: str) -> str:
    """Try a library; a row of the table."""
    library = LIBRARIES[name]
    with tempfile.TemporaryDirectory() as folder:
        try:
            python = install(Path(folder) / "env", library)
            version, gymnasium = versions(python, library.package, "gymnasium")
        except subprocess.CalledProcessError as error:
            return (
                f"| {name} | - | - | `{library.line}` | not installed: {last_line(error.stderr)} |"
            )
        script = Path(folder) / "program.py"
        script.write_text(program(library))
        done = run([python, "-W", "ignore", script], cwd=folder)
    result = "runs" if done.returncode == 0 else f"fails: {last_line(done.stderr)}"
    note = f"; {library.note}" if library.note else ""
    return f"| {name} | {version} | {gymnasium} | `{library.line}` | {result}{note} |"


def last_line(text: str) -> str:
    """The last line of an output, which tells the error."""
    return (text.strip().splitlines() or ["no output"])[-1].replace("|", "/")[:100]


def main() -> int:
    """Try the libraries that the arguments name."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("libraries", nargs="*", metavar="LIBRARY")
    parser.add_argument("--write", action="store_true", help="into docs/libraries.md")
    arguments = parser.parse_args()
    names = arguments.libraries or list(LIBRARIES)
    if unknown := set(names) - set(LIBRARIES):
        parser.error(f"unknown: {', '.join(unknown)}; known are {', '.join(LIBRARIES)}")
    rows = []
    for name in names:
        rows.append(tried(name))
        print(rows[-1], flush=True)
    if arguments.write:
        table = "\n".join([HEAD, *rows])
        parts = re.split(r"(?<=<!-- table -->\n).*?(?=<!-- end -->)", PAGE.read_text(), flags=re.S)
        PAGE.write_text(f"\n{table}\n\n".join(parts))
    return any("| runs" not in row for row in rows)


if __name__ == "__main__":
    sys.exit(main())
