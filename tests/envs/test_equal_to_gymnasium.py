"""CartPole-v0 and Pendulum-v0 are Gymnasium's CartPole-v1 and Pendulum-v1."""

import math
import warnings

import gymnasium as gym
import numpy as np
import pytest
from combinations import in_turn
from gymnasium.utils.env_checker import check_env

import fmugym
from fmugym.fmi.bundled import FMI_VERSIONS

_angles = np.random.default_rng(0).uniform(-10, 10, 100_000)
SINES_AGREE = all(
    np.array_equal(ufunc(_angles), np.vectorize(function)(_angles))
    for ufunc, function in ((np.sin, math.sin), (np.cos, math.cos))
)
needs_one_sine = pytest.mark.skipif(
    not SINES_AGREE, reason="numpy's sine differs from the C library's on this processor"
)
PAIRS = {"CartPole": "CartPole-v1", "Pendulum": "Pendulum-v1"}


def make_pair(model, fmi_version, **kwargs):
    """The FMU's environment and Gymnasium's, without any wrapper."""
    ours = gym.make(f"fmugym/{model}-v0", fmi_version=fmi_version, **kwargs).unwrapped
    theirs = gym.make(PAIRS[model], **kwargs).unwrapped
    return ours, theirs


def balance(observation, _):
    x, x_dot, theta, theta_dot = observation
    return int(0.1 * x + 0.1 * x_dot + theta + 0.3 * theta_dot > 0)


def push_at_random(_, rng):
    return int(rng.integers(2))


def swing_up(observation, _):
    cos, sin, velocity = map(float, observation)
    energy = velocity**2 / 6 + 5 * (cos - 1)
    angle = math.atan2(sin, cos)
    torque = -10 * angle - 2 * velocity if cos > 0.9 else -velocity * energy
    return np.array([torque], np.float32)


def twist_at_random(_, rng):
    return rng.uniform(-2.5, 2.5, 1).astype(np.float32)


POLICIES = [
    ("CartPole", push_at_random),
    ("CartPole", balance),
    ("Pendulum", twist_at_random),
    ("Pendulum", swing_up),
]


def assert_same(ours, theirs):
    assert ours[0].dtype == theirs[0].dtype
    assert ours[0].tolist() == theirs[0].tolist()
    assert ours[1:4] == theirs[1:4]


@needs_one_sine
@pytest.mark.parametrize("fmi_version", FMI_VERSIONS)
@pytest.mark.parametrize(("model", "policy"), POLICIES)
def test_episodes_are_identical(model, policy, fmi_version):
    ours, theirs = make_pair(model, fmi_version)
    rng = np.random.default_rng(1)
    for seed in range(10):
        observation, _ = ours.reset(seed=seed)
        assert observation.tolist() == theirs.reset(seed=seed)[0].tolist()
        for _ in range(500 if model == "CartPole" else 200):
            action = policy(observation, rng)
            result = ours.step(action)
            assert_same(result, theirs.step(action))
            observation = result[0]
            if result[2]:
                break
    ours.close()


@needs_one_sine
@pytest.mark.parametrize(("model", "policy"), [POLICIES[1], POLICIES[3]])
def test_policies_reach_what_they_are_for(model, policy):
    """The episodes compared above are long ones: balanced for 500 steps, swung up to the top."""
    env = gym.make(f"fmugym/{model}-v0")
    last = []
    for seed in range(10):
        observation, _ = env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        terminated = truncated = False
        while not (terminated or truncated):
            observation, _, terminated, truncated, _ = env.step(policy(observation, rng))
        last.append((observation[0], truncated))
    if policy is balance:
        assert all(truncated for _, truncated in last)
    if policy is swing_up:
        assert np.median([cos for cos, _ in last]) > 0.99
    env.close()


@pytest.mark.parametrize("fmi_version", FMI_VERSIONS)
@pytest.mark.parametrize("model", PAIRS)
def test_one_step_from_the_same_state(model, fmi_version):
    """Holds on every processor, whatever the last bit of its sine."""
    ours, theirs = make_pair(model, fmi_version)
    for seed in range(20):
        ours.reset(seed=seed)
        theirs.reset(seed=seed)
        action = 1 if model == "CartPole" else np.array([1.3], np.float32)
        ours.step(action)
        theirs.step(action)
        assert ours.state == pytest.approx(theirs.state.tolist(), rel=0, abs=1e-12)
    ours.close()


@pytest.mark.parametrize("model", PAIRS)
def test_spaces_and_limits(model):
    ours, theirs = gym.make(f"fmugym/{model}-v0"), gym.make(PAIRS[model])
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.spec.max_episode_steps == theirs.spec.max_episode_steps
    assert ours.spec.reward_threshold == theirs.spec.reward_threshold
    assert ours.metadata["render_modes"] == theirs.metadata["render_modes"]
    ours.close()


@pytest.mark.parametrize(
    ("model", "options"),
    [
        ("CartPole", {"low": -0.2, "high": 0.1}),
        ("CartPole", {"low": -0.01}),
        ("Pendulum", {"x_init": math.pi / 2, "y_init": 0.5}),
        ("Pendulum", {"y_init": 2}),
    ],
)
def test_reset_options(model, options):
    ours, theirs = make_pair(model, "2.0")
    for seed in range(5):
        first = ours.reset(seed=seed, options=options)[0]
        assert first.tolist() == theirs.reset(seed=seed, options=options)[0].tolist()
        first = ours.reset()[0]  # the options hold for one episode, the stream goes on
        assert first.tolist() == theirs.reset()[0].tolist()
    ours.close()


@needs_one_sine
def test_sutton_barto_reward_and_steps_after_the_end():
    for sutton_barto in (False, True):
        ours, theirs = make_pair("CartPole", "2.0", sutton_barto_reward=sutton_barto)
        ours.reset(seed=0)
        theirs.reset(seed=0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # both warn of steps after the end
            for _ in range(40):
                assert_same(ours.step(1), theirs.step(1))
        ours.close()


def test_steps_after_the_end_warn():
    env = gym.make("fmugym/CartPole-v0").unwrapped
    env.reset(seed=0)
    while not env.step(1)[2]:
        pass
    with pytest.warns(UserWarning, match="after the end of the episode"):
        env.step(1)
    env.close()


@needs_one_sine
def test_gravity_argument():
    ours, theirs = make_pair("Pendulum", "2.0", g=9.81)
    ours.reset(seed=3)
    theirs.reset(seed=3)
    for _ in range(100):
        action = np.array([0.7], np.float32)
        assert_same(ours.step(action), theirs.step(action))
    ours.close()


@in_turn({"env_id": ["CartPole", "Pendulum", "ModelicaCartPole"], "fmi_version": FMI_VERSIONS})
def test_gymnasiums_own_checker(env_id, fmi_version):
    """What it warns of is part of Gymnasium's own environments, or of the published task."""
    env = gym.make(f"fmugym/{env_id}-v0", fmi_version=fmi_version)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Box observation space (min|max)imum value")
        if env_id == "Pendulum":
            warnings.filterwarnings("ignore", message=".*symmetric and normalized")
        check_env(env.unwrapped)
    env.close()


def test_the_checker_has_nothing_more_to_say_than_on_gymnasiums_own():
    for model, original in PAIRS.items():
        texts = []
        for env_id in (f"fmugym/{model}-v0", original):
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                check_env(gym.make(env_id).unwrapped)
            texts.append({str(w.message) for w in caught if "WARN" in str(w.message)})
        assert texts[0] <= texts[1]


def test_version_argument_is_checked():
    with pytest.raises(fmugym.ConfigError, match=r"FMI version '2.1'; did you mean '2.0'"):
        gym.make("fmugym/CartPole-v0", fmi_version="2.1")
