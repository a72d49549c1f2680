"""A linear world without depth and memory: parameters in a list, clips of two frames."""

import dataclasses

import jax
import jax.numpy as jnp

from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import (
    ActionConfig,
    BatchSpec,
    Capabilities,
    ClipConfig,
    StageConfig,
    TrainSettings,
    World,
    register,
)
from pewm_jax.types import Frames, WorldState
from pewm_jax.worlds.control import control_of
from pewm_jax.worlds.stages import FREEZE, TRAIN, Stage


@dataclasses.dataclass(frozen=True)
class OddTrain(TrainSettings):
    first_of_all: StageConfig = StageConfig(steps=6, batch=4)
    then_2: StageConfig = StageConfig(steps=4, batch=4)


@register("world", "odd-1")
@dataclasses.dataclass(frozen=True)
class Odd(World):
    TRAIN = OddTrain
    capabilities = Capabilities(memory=False, depth=False, cameras=False)
    batch_spec = BatchSpec(context=False, actions=3)
    clip: ClipConfig = ClipConfig(frames=2, height=16, width=16, depth=False)
    actions: ActionConfig = ActionConfig()
    no_bias: bool = False
    kind_: str = "x"
    steps: int = 3
    Lambda: float = 0.5

    def init(self, key):
        return [jnp.eye(3) * 0.9, (jnp.zeros((3, 3)), jnp.zeros(3))]

    def stages(self):
        return (
            Stage("first_of_all", 1, (("0", TRAIN), (".*", FREEZE)), Odd.init, Odd.loss),
            Stage("then_2", 2, (("1/.*", TRAIN), (".*", FREEZE)), Odd.init, Odd.loss),
        )

    def step(self, params, rgb, action):
        matrix, (by_action, bias) = params
        return rgb @ matrix + action @ by_action + (0 if self.no_bias else bias)

    def loss(self, train, params, clip, key):
        rgb = as_signal(clip.frames).rgb_THWC
        made = jax.vmap(self.step, (None, 0, 0))(params, rgb[:, 0], clip.actions_TA[:, 0])
        return jnp.square(made - rgb[:, 1]).mean(), {}

    def observe(self, params, state, frames):
        return WorldState(jax.tree.map(lambda x: jnp.asarray(x)[-1:], as_signal(frames)), ())

    def imagine(self, params, state, control, key, *, remember=True, memory=True):
        asked = control_of(self, state.frame.camera, control)

        def one(rgb, action):
            rgb = self.step(params, rgb, action)
            return rgb, rgb

        _, rgb = jax.lax.scan(one, state.frame.rgb_THWC[0], asked.actions_TA)
        frames = Frames(jnp.clip(rgb, -1, 1), jnp.zeros(rgb.shape[:3]), asked.camera)
        return WorldState(jax.tree.map(lambda x: x[-1:], frames), state.map), frames
