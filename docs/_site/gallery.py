"""The gallery: each environment that comes with the package, with an animation and its docstring.

The same planner moves them all. In each step it tries many sequences of actions in one rollout,
and takes the first action of the best one.
"""

# The README's animation: python docs/_site/gallery.py fmugym/Pendulum-v0 docs/images/pendulum.gif

import io
import os
import sys
from pathlib import Path
from typing import Any, Final

import gymnasium
import numpy as np
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from PIL import Image, ImageOps

import fmugym  # noqa: F401  (registers the ids)

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")

ENVIRONMENTS: Final = {
    "fmugym/CartPole-v0": {},
    "fmugym/Pendulum-v0": {},
    "fmugym/CloudPendulum-v0": {},
    "fmugym/ModelicaCartPole-v0": {},
    "fmugym/House-v0": None,  # has no scene
}
CANDIDATES: Final = 512
HORIZON: Final = 30
PICTURES: Final = 70
SIZE: Final = (330, 240)  # at most


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the page and its animations."""
    text = ["# Environments", (__doc__ or "").split("\n\n", 1)[1]]
    for env_id, arguments in ENVIRONMENTS.items():
        name = env_id.removeprefix("fmugym/")
        text.append(f"## {name}")
        if arguments is not None:
            picture = f"gallery/{name}.gif"
            content = _animation(env_id, arguments)
            files.append(File.generated(config, picture, content=content))
            text.append(f"![{name}, moved by a planner]({picture})")
        text.append(_text(env_id))
    files.append(File.generated(config, "gallery.md", content="\n\n".join(text)))
    return files


def _text(env_id: str) -> str:
    kind = gymnasium.spec(env_id).entry_point
    kind = kind if isinstance(kind, str) else f"{kind.__module__}:{kind.__qualname__}"
    options = {"show_root_heading": "false", "show_root_toc_entry": "false", "members": "false"}
    lines = [f"      {key}: {value}" for key, value in (options | {"heading_level": "3"}).items()]
    return "\n".join([f"::: {kind.replace(':', '.')}", "    options:", *lines])


def _animation(env_id: str, arguments: dict[str, Any]) -> bytes:
    env = gymnasium.make(env_id, render_mode="rgb_array", **arguments)
    planner = gymnasium.make_vec(env_id, 64, **arguments)
    pictures = []
    try:
        env.reset(seed=4)
        for action in _actions(env, planner):
            _, _, terminated, truncated, _ = env.step(action)
            pictures.append(ImageOps.contain(Image.fromarray(env.render()), SIZE))
            if terminated or truncated or len(pictures) == PICTURES:
                return _gif(pictures, env.metadata["render_fps"])
    finally:
        planner.close()
        env.close()
    raise AssertionError("the planner never stops")


def _actions(env: Any, planner: Any) -> Any:
    """Yield the action of the best of many futures, which the next step starts from again."""
    rng = np.random.default_rng(0)
    space = env.action_space
    space.seed(0)
    best = np.stack([space.sample() for _ in range(HORIZON)])
    while True:
        futures = _futures(rng, space, best)
        rewards = planner.rollout(env.unwrapped.save_state(), futures).rewards
        best = futures[rewards.sum(axis=1).argmax()]
        yield best[0]
        best = np.concatenate([best[1:], best[-1:]])


def _futures(rng: np.random.Generator, space: Any, best: Any) -> Any:
    """Sequences of actions near the best one so far, and quite others."""
    shape = (CANDIDATES, HORIZON)
    if isinstance(space, gymnasium.spaces.Discrete):
        change = rng.random(shape) < rng.uniform(0, 0.5, (CANDIDATES, 1))
        return np.where(change, rng.integers(space.n, size=shape), best).astype(space.dtype)
    reach = (space.high - space.low) / 2 * rng.uniform(0, 1, (CANDIDATES, 1, 1))
    futures = best + rng.normal(size=(*shape, *space.shape)) * reach
    futures[0] = best
    return np.clip(futures, space.low, space.high).astype(space.dtype)


def _gif(pictures: list[Any], fps: float) -> bytes:
    file = io.BytesIO()
    first, *rest = (one.quantize(16, dither=Image.Dither.NONE) for one in pictures)
    delay = max(int(1000 / fps), 20)  # viewers slow down what is faster
    first.save(file, "gif", save_all=True, append_images=rest, duration=delay, loop=0)
    return file.getvalue()


if __name__ == "__main__":
    Path(sys.argv[2]).write_bytes(_animation(sys.argv[1], {}))
