"""Several agents on one system, checked by PettingZoo's own tests."""

import warnings

import numpy as np
import pytest
from letters import wide
from test_systems_faces import ONE_REWARD, TASK, TWO_REWARDS, TwoHouses, two_houses

import fmugym
from fmugym import ConfigError, SimulationError, bundled_fmu
from fmugym.training.pettingzoo import Agent, FMUParallelEnv

with warnings.catch_warnings():  # its own tests import games in a way that it calls outdated
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import parallel_api_test, parallel_seed_test

AGENTS = {"e": Agent(["u"], ["T"], "warm"), "w": Agent(["u2"], ["T2", "T"], "cool")}


@pytest.fixture
def load(tmp_path):
    def make(**parts):
        path = tmp_path / "houses.toml"
        path.write_text(TASK.format(**parts or TWO_REWARDS))
        return fmugym.load(path)

    return make


class TestTheirTests:
    def test_of_the_interface(self, load):
        parallel_api_test(FMUParallelEnv(load()), num_cycles=100)
        parallel_api_test(FMUParallelEnv(load(), AGENTS), num_cycles=100)

    def test_of_seeds(self, load):
        parallel_seed_test(lambda: FMUParallelEnv(load(), AGENTS), num_cycles=30)


class TestAgents:
    def test_by_default_there_is_one_for_each_component(self, load):
        env = FMUParallelEnv(load())
        assert env.possible_agents == ["east", "west"]
        assert env.observation_space("east").shape == (1,)
        assert env.action_space("west").shape == (1,)
        assert env.agents == []

    def test_together_they_do_what_one_agent_does(self, load):
        together, alone = FMUParallelEnv(load(), AGENTS), load()
        seen, _ = together.reset(seed=1)
        expected, _ = alone.reset(seed=1)
        for step in range(24):
            assert seen["e"].tolist() == expected[[0]].tolist()
            assert seen["w"].tolist() == expected[[1, 0]].tolist()
            u, u2 = step % 2, (step % 5) / 4
            seen, rewards, ended, cut, _ = together.step({"w": [u2], "e": [u]})
            expected, reward, _, truncated, info = alone.step(np.array([u, u2], np.float32))
            assert rewards == {
                "e": info["reward_terms"]["warm"],
                "w": info["reward_terms"]["cool"],
            }
            assert sum(rewards.values()) == pytest.approx(reward)
            assert cut == {"e": truncated, "w": truncated}
            assert ended == {"e": False, "w": False}
        assert truncated
        assert together.agents == []
        with pytest.raises(SimulationError):
            together.step({})

    def test_without_rewards_of_their_own_they_share_one(self, load):
        env = FMUParallelEnv(load(**ONE_REWARD))
        env.reset(seed=0)
        _, rewards, *_ = env.step({"east": [1.0], "west": [0.0]})
        assert rewards["east"] == rewards["west"] < 0

    def test_a_group_of_inputs_of_any_environment(self):
        env = TwoHouses(two_houses())
        agents = {"both": Agent(["east.u", "outside"], ["warmth", "west.T_air"])}
        parallel = FMUParallelEnv(env, agents)
        seen, _ = parallel.reset(seed=0)
        assert seen["both"][0] == pytest.approx(parallel.state()[2], rel=1e-6)
        assert parallel.action_space("both").high[0] == 1.0

    def test_names_are_found_by_letters_that_look_the_same(self, load):
        agents = {
            name: Agent([*map(wide, one.actions)], [*map(wide, one.observations)], wide(one.reward))
            for name, one in AGENTS.items()
        }
        plain, other = FMUParallelEnv(load(), AGENTS), FMUParallelEnv(load(), agents)
        for env in (plain, other):
            env.reset(seed=0)
        assert repr(plain.step({"e": [1.0], "w": [0.0]})) == repr(
            other.step({"e": [1.0], "w": [0.0]})
        )

    @pytest.mark.parametrize(
        ("agents", "facts"),
        [
            ({"e": Agent(["u"], ["T"])}, ["'u2'", "no agent"]),
            (AGENTS | {"x": Agent(["u"], ["T"])}, ["'u'", "e, x"]),
            (AGENTS | {"w": Agent(["u2"], ["T3"])}, ["T3", "did you mean"]),
            (AGENTS | {"w": Agent(["u2", "u3"], ["T"])}, ["u3"]),
            (AGENTS | {"w": Agent(["u2"], ["T"], "hot")}, ["hot"]),
            (AGENTS | {"x": Agent([], ["T"])}, ["'x'"]),
            (AGENTS | {"w": "west"}, ["'w'", "Agent"]),
            ({}, ["at least one"]),
        ],
    )
    def test_mistakes(self, load, agents, facts):
        with pytest.raises(ConfigError) as error:
            FMUParallelEnv(load(), agents)
        assert all(fact in str(error.value) for fact in facts), error.value

    def test_mistakes_in_a_step(self, load):
        env = FMUParallelEnv(load(), AGENTS)
        env.reset(seed=0)
        for actions, fact in (
            ({"e": [0.0]}, "'w'"),
            ({"e": [0.0], "w": [0.0, 1.0]}, "'w'"),
            ({"e": [0.0], "w": [0.0], "x": [0.0]}, "'x'"),
        ):
            with pytest.raises(ConfigError, match=fact):
                env.step(actions)
        with pytest.raises(ConfigError, match="agent"):
            env.action_space("x")

    def test_an_fmu_alone_needs_agents(self):
        class Alone(fmugym.FMUEnv):
            def __init__(self):
                config = {"model_input_names": "u", "model_output_names": "T_air"}
                super().__init__(bundled_fmu("House"), config)

            def _is_done(self):
                return False

        with pytest.raises(ConfigError, match="no system"):
            FMUParallelEnv(Alone())
        own = FMUParallelEnv(Alone(), {"heating": Agent(["u"], ["T_air"])})
        assert own.reset(seed=0)[0]["heating"].shape == (1,)

    def test_an_action_that_acts_on_several_components(self):
        with pytest.raises(ConfigError, match="'outside'"):
            FMUParallelEnv(TwoHouses(two_houses()))
