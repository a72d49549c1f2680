"""A vectorized Gymnasium environment as the ``VecEnv`` of Stable-Baselines3, for its PPO.

``pip install 'pewm-jax[rl]'`` installs Stable-Baselines3. ``examples/ppo.py`` trains a policy in
imagined worlds and tests it in the houses themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pewm_jax.errors import UserError, require
from pewm_jax.planning.observations import gymnasium

try:
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]
except ImportError:
    raise UserError(
        "this needs Stable-Baselines3, which is not installed: pip install 'pewm-jax[rl]'."
    ) from None


class GymnasiumVecEnv(VecEnv):
    """A ``gymnasium.vector.VectorEnv`` with the interface of Stable-Baselines3.

    Stable-Baselines3 expects the first observation of the next episode with the end of an episode,
    so the environments must not reset themselves (``AutoresetMode.DISABLED``): they are reset here.
    """

    def __init__(self, envs: gymnasium.vector.VectorEnv, look: Callable[[Any], Any] | None = None):
        """Wrap environments.

        Args:
            envs: environments with ``AutoresetMode.DISABLED``.
            look: function of batched observations: the policy's input; by default the observations.

        Raises:
            UserError: the environments reset themselves.
        """
        mode = envs.metadata.get("autoreset_mode")
        require(
            mode == gymnasium.vector.AutoresetMode.DISABLED,
            f"the environments' autoreset_mode is {mode}: use AutoresetMode.DISABLED.",
        )
        self.envs, self._look = envs, look or (lambda seen: seen)
        space = envs.single_observation_space
        if look is not None:
            example = np.asarray(look(envs.observation_space.sample()), np.float32)
            space = gymnasium.spaces.Box(-np.inf, np.inf, example.shape[1:], np.float32)
        super().__init__(envs.num_envs, space, envs.single_action_space)
        self._seed: int | None = None
        self._returns, self._lengths = np.zeros(envs.num_envs), np.zeros(envs.num_envs, int)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seed of the next reset."""
        self._seed = seed
        return [None if seed is None else seed + number for number in range(self.num_envs)]

    def reset(self) -> Any:
        """Start an episode in every environment and return the observations."""
        seen, _ = self.envs.reset(seed=self._seed)
        self._seed = None
        self._returns[:], self._lengths[:] = 0, 0
        return self._look(seen)

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Do the step; environments whose episode ends are reset."""
        seen, rewards, ended, cut, _ = self.envs.step(self._actions)
        done = ended | cut
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in done]
        looked = self._look(seen)
        for number in np.flatnonzero(done).tolist():
            infos[number] = {
                "terminal_observation": _row(looked, number),
                "TimeLimit.truncated": bool(cut[number] and not ended[number]),
                "episode": {"r": self._returns[number], "l": self._lengths[number], "t": 0.0},
            }
        if done.any():
            looked = self._look(self.envs.reset(options={"reset_mask": done})[0])
            self._returns[done], self._lengths[done] = 0, 0
        return looked, rewards.astype(np.float32), done, infos

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environments."""
        return [getattr(self.envs, attr_name, None) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: environments are set up when they are made."""
        del value, indices
        raise UserError(f"{attr_name} of the environments cannot be set: make them with it.")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        """Call a method of the environments."""
        return [
            getattr(self.envs, method_name)(*args, **kwargs) for _ in self._get_indices(indices)
        ]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return False for every environment."""
        del wrapper_class
        return [False for _ in self._get_indices(indices)]


def _row(seen: Any, number: int) -> Any:
    if isinstance(seen, dict):
        return {name: value[number] for name, value in seen.items()}
    return seen[number]
