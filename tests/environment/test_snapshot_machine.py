"""Environments that are saved, restored, stepped and reset in any order, against plain re-runs."""

import pickle
from functools import partial

import hypothesis.strategies as st
import numpy as np
from combinations import in_turn
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test
from test_snapshots import Track
from ways import in_way

import fmugym

N = 3
ACTIONS = np.linspace(-0.01, 0.01, 5, dtype=np.float32)
actions_of_all = st.lists(st.integers(0, 4), min_size=N, max_size=N)
masks = st.lists(st.booleans(), min_size=N, max_size=N).filter(any)


def rerun(env, history):
    """What a single environment returns after each of its resets and steps."""
    results = []
    for kind, value in history:
        if kind == "reset":
            observation, info = env.reset(seed=value)
            results.append((observation.tolist(), tuple(info["drawn"].values())))
        else:
            observation, reward, *ends, _ = env.step(ACTIONS[[value]])
            results.append((observation.tolist(), float(reward), *map(bool, ends)))
    return results


class Machine(RuleBasedStateMachine):
    """Each environment has a history of its own; a snapshot carries that of its environments."""

    options: dict = {}  # noqa: RUF012  (of subclasses)
    make = make_many = Track

    @initialize(seed=st.integers(0, 5))
    def start(self, seed):
        self.envs = fmugym.FMUVectorEnv(
            self.make_many,
            N,
            autoreset_mode="Disabled",
            **self.options,
        )
        self.single = self.make()
        self.histories = [[] for _ in range(N)]
        self.results = [[] for _ in range(N)]
        self.saved = []
        self.ended = np.zeros(N, bool)
        self.restart(np.ones(N, bool), seed)

    def restart(self, mask, seed):
        options = {"reset_mask": mask}
        observations, infos = self.envs.reset(seed=seed, options=options)
        drawn = [values for name, values in infos["drawn"].items() if name[0] != "_"]
        for index in np.flatnonzero(mask):
            own = None if seed is None else seed + int(index)
            result = observations[index].tolist(), tuple(values[index] for values in drawn)
            self.note(index, ("reset", own), result)
        self.ended[mask] = False

    def note(self, index, event, result):
        self.histories[index] = [*self.histories[index], event]
        self.results[index] = [*self.results[index], result]

    @rule(mask=masks, seed=st.none() | st.integers(0, 5))
    def reset(self, mask, seed):
        self.restart(np.array(mask), seed)

    @rule(actions=actions_of_all)
    def step(self, actions):
        if self.ended.any():
            self.restart(self.ended.copy(), None)
        batch = ACTIONS[actions][:, None]
        observations, rewards, terminated, truncated, _ = self.envs.step(batch)
        for index, action in enumerate(actions):
            ends = bool(terminated[index]), bool(truncated[index])
            result = (observations[index].tolist(), float(rewards[index]), *ends)
            self.note(index, ("step", action), result)
        self.ended = terminated | truncated

    @rule(mask=masks, pickled=st.booleans())
    def save(self, mask, pickled):
        chosen = np.flatnonzero(mask)
        parts = [(self.histories[i], self.results[i], self.ended[i]) for i in chosen]
        snapshot = self.envs.save_state(np.array(mask))
        self.saved.append((pickle.loads(pickle.dumps(snapshot)) if pickled else snapshot, parts))

    @rule(mask=masks, number=st.integers(0, 99), place=st.integers(0, N - 1))
    def restore(self, mask, number, place):
        if not self.saved:
            return
        snapshot, parts = self.saved[number % len(self.saved)]
        place %= len(parts)
        self.envs.restore_state(snapshot[place], np.array(mask))
        for index in np.flatnonzero(mask):
            self.histories[index], self.results[index], self.ended[index] = parts[place]

    @rule(index=st.integers(0, N - 1), action=st.integers(0, 4))
    def borrow(self, index, action):
        """A single environment goes on from one of many, and gives its episode back."""
        if self.ended[index]:
            return
        self.single.restore_state(self.envs.save_state(index))
        (result,) = rerun(self.single, [("step", action)])
        self.envs.restore_state(self.single.save_state(), index)
        self.note(index, ("step", action), result)
        self.ended[index] = any(result[2:])

    @rule(actions=actions_of_all)
    def think(self, actions):
        """A rollout leaves no traces."""
        if not self.ended.any():
            self.envs.rollout(None, ACTIONS[actions][:, None, None].repeat(3, axis=1))

    def teardown(self):
        if not hasattr(self, "envs"):
            return
        for actions in ([0, 4, 2], [1, 1, 3]):  # in the present episodes, and in the next ones
            self.step(actions)
            self.restart(np.ones(N, bool), None)
        for history, results in zip(self.histories, self.results, strict=True):
            assert rerun(self.single, history) == results
        self.envs.close()
        self.single.close()


WAYS = {
    "arrays": {"threads": 1},
    "one by one": {"threads": 2},
    "processes": {"isolation": "process", "workers": 2},
}


CHANGES = ({"substeps": 3, "warm_up": 0.06, "start_time": 0.3}, {})


@in_turn({"way": list(WAYS), "version": ["2.0", "3.0", "1.0"], "changes": CHANGES})
def test_any_order(version, way, changes):
    make = staticmethod(partial(Track, version, **changes))
    hooks = way if way in ("arrays", "one by one") else None
    body = {"options": WAYS[way], "make": make, "make_many": staticmethod(in_way(hooks, make))}
    machine = type("Own", (Machine,), body)
    examples = 4 if way == "processes" else 25
    limits = settings(max_examples=examples, stateful_step_count=25, deadline=None)
    run_state_machine_as_test(machine, settings=limits)
