"""Many imagined worlds as one vectorized Gymnasium environment: one call imagines all of them.

``ImaginedVectorEnv`` behaves as several ``WorldModelEnv``: the same observations, rewards and
episodes for the same seeds. An environment whose episode is over starts a new one in the next step
(``AutoresetMode.NEXT_STEP``), or when ``reset`` is called with its entry of ``reset_mask``
(``AutoresetMode.DISABLED``). ``planning.stable_baselines`` turns it into the ``VecEnv`` of
Stable-Baselines3.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import worlds
from pewm_jax.config import Config, World
from pewm_jax.errors import require
from pewm_jax.nn import target
from pewm_jax.planning import imagined
from pewm_jax.planning.house_config import HouseConfig
from pewm_jax.planning.imagined_env import WorldModelEnv
from pewm_jax.planning.observations import gymnasium
from pewm_jax.types import Array, Params

AutoresetMode = gymnasium.vector.AutoresetMode
Observations = dict[str, np.ndarray]


class ImaginedVectorEnv(gymnasium.vector.VectorEnv):
    """``num_envs`` imagined worlds that are stepped together.

    Attributes:
        envs: the environments; each has the state of its own world.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}

    def __init__(
        self,
        model: Config | World,
        params: Params,
        num_envs: int,
        house: HouseConfig | Sequence[HouseConfig] | None = None,
        *,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        **settings: Any,
    ):
        """Wrap a trained world, as returned by ``pewm_jax.load``.

        Args:
            model: the experiment; or the model's settings.
            params: its parameters.
            num_envs: number of worlds.
            house: start and goal of episodes, for all environments or one for each.
            autoreset_mode: how episodes follow each other; see the module.
            settings: further arguments of ``WorldModelEnv``.

        Raises:
            UserError: as for ``WorldModelEnv``; the numbers of environments and houses differ; or
                the mode is ``SAME_STEP``.
        """
        require(num_envs >= 1, f"num_envs is {num_envs}: use 1 or more.")
        houses = list(house) if isinstance(house, Sequence) else [house] * num_envs
        require(
            len(houses) == num_envs,
            f"{len(houses)} houses are given for {num_envs} environments: give one for each.",
        )
        require(
            autoreset_mode != AutoresetMode.SAME_STEP,
            "autoreset_mode is SAME_STEP: use NEXT_STEP or DISABLED.",
        )
        # Gymnasium reads it from the environment, and declares it for the class.
        vars(self)["metadata"] = {**self.metadata, "autoreset_mode": autoreset_mode}
        self.num_envs = num_envs
        self.envs = [WorldModelEnv(model, params, one, **settings) for one in houses]
        self.single_observation_space = self.envs[0].observation_space
        self.single_action_space = self.envs[0].action_space
        self.observation_space = gymnasium.vector.utils.batch_space(
            self.single_observation_space, num_envs
        )
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        self.render_mode = settings.get("render_mode")
        self._over = np.ones(num_envs, bool)
        self._restarts = autoreset_mode == AutoresetMode.NEXT_STEP
        step = functools.partial(imagined.step, worlds.model_of(model))

        def imagine(params: Params, *each: Any) -> Any:
            if target.current().platform == "cpu":  # half the time of a batch there
                return jax.lax.map(lambda one: step(params, *one), each)
            return jax.vmap(step, in_axes=(None, 0, 0, 0))(params, *each)

        self._imagine: Callable[..., Any] = jax.jit(imagine, donate_argnums=1)
        self._params = jax.device_put(params)
        self._states: Any = None
        self._observed: list[Observations] = [{}] * num_envs

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Any = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode in each environment; environment i gets the seed + i.

        ``options`` may have ``reset_mask``, (num_envs,) bool: the environments to start, where the
        others keep their episodes; and the options of ``WorldModelEnv.reset``.
        """
        seeds = seed if isinstance(seed, Sequence) else [None] * self.num_envs
        if isinstance(seed, int):
            seeds = [seed + number for number in range(self.num_envs)]
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, bool)))
        infos: dict[str, Any] = {}
        started = {}
        for number in np.flatnonzero(mask).tolist():
            env = self.envs[number]
            self._observed[number], info = env.reset(seed=seeds[number], options=options or None)
            infos = self._add_info(infos, info, number)
            started[number] = self._taken(number)
        if mask.all():
            self._states = jax.tree.map(lambda *x: jnp.stack(x), *started.values())
        else:
            require(self._states is not None, "reset_mask is for environments that were reset.")
            for number, state in started.items():
                self._states = _placed(self._states, state, number)
        self._over[mask] = False
        return _stacked(self._observed), infos

    def step(
        self, actions: Any
    ) -> tuple[Observations, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Imagine one action in each environment; those whose episode is over start a new one.

        Raises:
            UserError: an action is not in the space, or ``reset`` was not called.
        """
        require(self._states is not None, "step() was called before reset(): call reset() first.")
        still = np.zeros(3, np.float32), jax.random.key(0)
        moves = [
            still if over and self._restarts else env.motion(action)
            for env, over, action in zip(self.envs, self._over, actions, strict=True)
        ]
        motions = np.stack([motion for motion, _ in moves])
        keys = jnp.stack([key for _, key in moves])
        self._states, seen = self._imagine(self._params, self._states, motions, keys)
        seen = jax.device_get(seen)
        found = [self._arrive(number, seen) for number in range(self.num_envs)]
        observed, rewards, ended, cut, infos = zip(*found, strict=True)
        self._observed = list(observed)
        self._over = np.array(ended) | np.array(cut)
        together: dict[str, Any] = {}
        for number, info in enumerate(infos):
            together = self._add_info(together, info, number)
        return (
            _stacked(observed),
            np.array(rewards, np.float64),
            np.array(ended),
            np.array(cut),
            together,
        )

    def render(self) -> Any:
        """Return the current images, if the render mode is "rgb_array"."""
        return tuple(env.render() for env in self.envs)

    def _arrive(self, number: int, seen: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Return one environment's results, or those of its new episode."""
        env = self.envs[number]
        if not self._over[number]:
            return env.arrive(jax.tree.map(lambda x: x[number], seen))
        observed, info = env.reset()
        self._states = _placed(self._states, self._taken(number), number)
        return observed, 0.0, False, False, info

    def _taken(self, number: int) -> imagined.ImaginedState:
        """Return the state of an environment's new episode, and let go of it there."""
        env = self.envs[number]
        assert env.state is not None
        state, env.state = env.state, None
        return state


@functools.partial(jax.jit, donate_argnums=0)
def _placed(states: Any, state: Any, number: Array) -> Any:
    """Return the states with another one at a number."""
    return jax.tree.map(lambda all_, one: all_.at[number].set(one), states, state)


def _stacked(observed: Sequence[Observations]) -> Observations:
    return {name: np.stack([each[name] for each in observed]) for name in observed[0]}
