"""Train a policy by PPO in imagined houses; test it in real ones (pip install 'pewm-jax[rl]')."""

import dataclasses
import sys

import numpy as np
from gymnasium.vector import AutoresetMode
from scipy.stats import binomtest
from stable_baselines3 import PPO

import pewm_jax
from pewm_jax.planning.house import HouseEnv
from pewm_jax.planning.house_config import HouseConfig
from pewm_jax.planning.imagined_vector import ImaginedVectorEnv
from pewm_jax.planning.stable_baselines import GymnasiumVecEnv

STEPS, TASKS, WORLDS = int(sys.argv[1]) if len(sys.argv) > 1 else 8192, 96, 8
GOALS = HouseConfig(max_distance_m=4.0, max_steps=48)
PRACTISED = [dataclasses.replace(GOALS, house=3 * n, houses=4) for n in range(WORLDS)]
TESTED = [dataclasses.replace(GOALS, house=2 + 3 * n) for n in range(12)]  # held out


def look(seen):
    """Return the policy's input: the goal, and the depth of nine columns; of a batch."""
    middle = seen["depth"][:, seen["depth"].shape[1] // 2 :]
    columns = np.array_split(np.where(middle > 0, middle, 10.0), 9, axis=2)
    near = [column.min((1, 2)) / 4 for column in columns]
    return np.concatenate([seen["goal"] / 4, np.stack(near, 1)], 1).astype(np.float32)


def successes(act):
    """Return which tasks in the real houses are solved by ``act(observation) -> action``."""
    solved = []
    for house in map(HouseEnv, TESTED):
        for task in range(TASKS // len(TESTED)):
            (seen, info), over = house.reset(seed=task), False
            while not over:
                seen, _, *ends, info = house.step(act(seen))
                over = any(ends)
            solved.append(info["success"])
    return np.array(solved)


config, params = pewm_jax.load("small")
clip = dataclasses.replace(config.model.clip, frames=2)  # one action
model = dataclasses.replace(config.model.with_sample_steps(1), clip=clip)
worlds = ImaginedVectorEnv(
    model, params, WORLDS, PRACTISED, autoreset_mode=AutoresetMode.DISABLED, blocks=True
)
policy = PPO("MlpPolicy", GymnasiumVecEnv(worlds, look), 1e-3, 64, 128, gamma=0.95, seed=0)
policy.learn(STEPS)
trained = successes(lambda s: policy.predict(look({k: v[None] for k, v in s.items()}))[0][0])
rng = np.random.default_rng(0)
chance = successes(lambda _: rng.integers(3))
turn = lambda seen: np.arctan2(seen["goal"][1], seen["goal"][0])  # noqa: E731 - to the goal
greedy = successes(lambda s: 0 if abs(turn(s)) < 0.28 else 1 + int(turn(s) < 0))
better, worse = (trained & ~chance).sum(), (chance & ~trained).sum()
p = binomtest(better, better + worse, alternative="greater").pvalue if better + worse else 1.0
print(f"solved {trained.sum()}, greedy {greedy.sum()}, chance {chance.sum()} of {TASKS}: p {p:.1e}")
