"""A single environment of a declared task: compiled steps, and saved states."""

import numpy as np
import pytest
import test_declared
import test_declared_actions
import test_declared_features
import test_declared_seasons
import test_declared_sensors
import test_declared_warm_up

TASKS = {
    "units and costs": test_declared.TANK,
    "conditions in the memory": test_declared.TANK
    | {
        "memory": test_declared.TANK["memory"]
        | {"count": {"start": 0, "update": "count + 1 if rate > 0 else 0"}}
    },
    "data and histories": test_declared_features.EVERYTHING,
    "least times": test_declared_actions.task("least times"),
    "rate": test_declared_actions.task("rate"),
    "seasons": test_declared_seasons.TASK | {"clock": {"from": "10-01", "to": "04-15"}},
    "random steps": test_declared_sensors.RANDOM,
    "sensors": test_declared_sensors.task(noise=2.0, quantum=0.1, delay="0.1s"),
    "drop-outs": test_declared_sensors.task(drop_out=0.4, rate=40, bias=1.0, delay="0.1s"),
    "actuators": test_declared_sensors.task()
    | {
        "variables": {
            "angle": {"name": "q"},
            "tau": {"noise": 0.001, "drop_out": 0.3, "delay": "0.1s", "rate": 0.1},
        }
    },
    "warm-up": test_declared_warm_up.house(),
    "cart-pole": str(test_declared.EXAMPLES / "cart_pole.toml"),
    "pendulum": str(test_declared.EXAMPLES / "pendulum.toml"),
}

each_task = pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)


@each_task
def test_compiled_steps_are_those_of_python(task, load):
    compiled, python = (load(task, way=hooks) for hooks in ("expressions", "Python"))
    python.action_space.seed(4)
    for seed in (1, None):
        test_declared.same(compiled.reset(seed=seed), python.reset(seed=seed))
        for _ in range(30):
            action = python.action_space.sample()
            first, second = compiled.step(action), python.step(action)
            test_declared.same(first, second)
            if first[2] or first[3]:
                break


@each_task
def test_a_saved_state_goes_on_in_the_same_way(task, load):
    env = load(task)
    env.reset(seed=2)
    actions = [env.action_space.sample() for _ in range(6)]
    for action in actions[:3]:
        env.step(action)
    state = env.save_state()
    first = [env.step(action) for action in actions[3:]]
    env.restore_state(state)
    again = [env.step(action) for action in actions[3:]]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        test_declared.same(one[1:], other[1:])
