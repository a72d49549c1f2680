"""Many imagined worlds in one call are the single worlds; Stable-Baselines3 can train in them."""

import dataclasses

import jax
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from pewm_jax.config import UserError
from pewm_jax.planning.house_config import HouseConfig
from pewm_jax.planning.imagined_env import WorldModelEnv
from pewm_jax.planning.imagined_vector import ImaginedVectorEnv
from tests.helpers import random_world
from tests.planning.test_imagined import CONFIG

GOALS = HouseConfig(max_distance_m=4.0, max_steps=3)
HOUSES = [dataclasses.replace(GOALS, house=house) for house in (0, 3)]


@pytest.fixture(scope="module")
def params():
    return jax.device_put(random_world(CONFIG, scale=0.1))


def make(params, **settings):
    return ImaginedVectorEnv(CONFIG, params, 2, HOUSES, **settings)


@pytest.mark.slow
def test_each_environment_is_the_single_one(params):
    together = make(params)
    singles = [WorldModelEnv(CONFIG, params, house) for house in HOUSES]
    seen, _ = together.reset(seed=5)
    alone = [env.reset(seed=5 + number)[0] for number, env in enumerate(singles)]
    for step in range(5):
        for number, one in enumerate(alone):
            assert set(seen) == set(one)
            np.testing.assert_allclose(seen["goal"][number], one["goal"], atol=1e-5)
            np.testing.assert_allclose(seen["pose"][number], one["pose"], atol=1e-5)
            np.testing.assert_allclose(seen["depth"][number], one["depth"], atol=1e-3)
            away = seen["rgb"][number].astype(int) - one["rgb"]
            assert np.abs(away).max() <= 1
        actions = np.array([step % 3, (step + 1) % 3])
        seen, rewards, ended, cut, infos = together.step(actions)
        if step == 3:  # the step after the end starts new episodes
            alone = [env.reset()[0] for env in singles]
            assert not np.concatenate([rewards, ended, cut]).any()
            continue
        results = [env.step(action) for env, action in zip(singles, actions, strict=True)]
        alone = [result[0] for result in results]
        np.testing.assert_allclose(rewards, [result[1] for result in results], atol=1e-5)
        assert cut.tolist() == [result[3] for result in results]
        assert cut.all() == cut.any() == (step == 2)
        assert infos["steps"].tolist() == [result[4]["steps"] for result in results]


@pytest.mark.slow
def test_masked_environments_start_again_and_others_go_on(params):
    envs = make(params, autoreset_mode=AutoresetMode.DISABLED, blocks=True)
    envs.reset(seed=0)
    seen, *_ = envs.step(np.array([1, 1]))
    after, _ = envs.reset(options={"reset_mask": np.array([True, False])})
    np.testing.assert_array_equal(after["rgb"][1], seen["rgb"][1])
    assert np.abs(after["pose"][0] - seen["pose"][0]).max() > 0
    assert [env._steps for env in envs.envs] == [0, 1]
    for _ in range(2):
        envs.step(np.array([1, 1]))
    with pytest.raises(UserError, match="outside of an episode"):
        envs.step(np.array([1, 1]))


@pytest.mark.slow
def test_ppo_trains_in_imagined_worlds(params):
    pytest.importorskip("stable_baselines3", reason="the extra rl is not installed")
    from stable_baselines3 import PPO

    from pewm_jax.planning.stable_baselines import GymnasiumVecEnv

    with pytest.raises(UserError, match=r"AutoresetMode\.DISABLED"):
        GymnasiumVecEnv(make(params))
    envs = GymnasiumVecEnv(
        make(params, autoreset_mode=AutoresetMode.DISABLED), lambda seen: seen["goal"]
    )
    assert envs.observation_space.shape == (2,)
    policy = PPO("MlpPolicy", envs, n_steps=4, batch_size=8, n_epochs=1, seed=0)
    policy.learn(8)
    assert policy.num_timesteps == 8
    assert len(policy.ep_info_buffer) == 2  # episodes of three steps
    assert all(episode["l"] == 3 for episode in policy.ep_info_buffer)


def test_wrong_numbers_and_modes_are_refused(params):
    with pytest.raises(UserError, match="3 houses are given for 2"):
        ImaginedVectorEnv(CONFIG, params, 2, [GOALS] * 3)
    with pytest.raises(UserError, match="use NEXT_STEP or DISABLED"):
        make(params, autoreset_mode=AutoresetMode.SAME_STEP)
    with pytest.raises(UserError, match="call reset"):
        make(params).step(np.zeros(2, int))
