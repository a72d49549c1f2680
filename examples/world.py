"""A world in one file: a convolutional next-frame predictor with a memory of its own kind.

The memory keeps the last frames and poses, and shows the network the one nearest to the camera. ::

    pewm-jax train keyframes --plugin world.py --data.path data/demo --train.run runs/mine
    pewm-jax evaluate runs/mine --plugin world.py
"""

import dataclasses

import jax
import jax.numpy as jnp

from pewm_jax.codecs.signals import as_signal, depth_from_signal, signal_from_depth
from pewm_jax.config import Capabilities, ClipConfig, StageConfig, TrainSettings, World, register
from pewm_jax.geometry.actions import actions_between
from pewm_jax.nn.convolution import convolve
from pewm_jax.types import Frames, WorldState
from pewm_jax.worlds.control import control_of
from pewm_jax.worlds.stages import TRAIN, Stage


@dataclasses.dataclass(frozen=True)
class KeyframesTrain(TrainSettings):
    fit: StageConfig = StageConfig(steps=1000, batch=8)


@register("world", "keyframes")
@dataclasses.dataclass(frozen=True)
class Keyframes(World):
    TRAIN = KeyframesTrain
    capabilities = Capabilities(memory=True)
    clip: ClipConfig = ClipConfig(frames=5)
    width: int = 32
    slots: int = 16

    def init(self, key):
        shapes = {"first": (7, self.width), "recalled": (4, self.width), "last": (self.width, 4)}
        return {name: jax.random.normal(key, (5, 5, *n)) / 50 for name, n in shapes.items()}

    def stages(self):
        return (Stage("fit", 1, ((".*", TRAIN),), Keyframes.init, Keyframes.loss, memory=True),)

    def image(self, frames):  # (..., H, W, 4): colour, and depth in [-1, 1]
        depth = signal_from_depth(self.clip, frames.depth_THW)[..., None]
        return jnp.concatenate([as_signal(frames).rgb_THWC, depth], -1)

    def insert(self, memory, *new):  # images and poses; unused slots are far away
        empty = jnp.zeros((self.slots, *new[0].shape[1:])), jnp.full((self.slots, 4, 4), 1e9)
        return [jnp.concatenate(x)[-self.slots :] for x in zip(memory or empty, new, strict=True)]

    def next(self, params, memory, image, move, pose):
        x = jnp.concatenate([image, jnp.broadcast_to(move, (*image.shape[:2], 3))], -1)
        x = convolve(x[None], params["first"])
        if memory is not None:
            nearest = jnp.square(memory[1] - pose).sum((1, 2)).argmin()
            x += convolve(memory[0][nearest][None], params["recalled"])
        return image + convolve(jax.nn.gelu(x), params["last"])[0]

    def loss(self, train, params, clip, key):
        def one(frames, context, valid):
            past = jnp.where(valid[:, None, None], context.camera.world_from_camera, 1e9)
            memory = self.insert(None, self.image(context), past)
            image, poses = self.image(frames), frames.camera.world_from_camera
            to = actions_between(poses), poses[1:]
            made = jax.vmap(self.next, (None, None, 0, 0, 0))(params, memory, image[:-1], *to)
            return jnp.square(made - image[1:])

        loss = jax.vmap(one)(clip.frames, clip.context, clip.context_valid_S).mean()
        return loss, {"psnr": -10 * jnp.log10(loss / 4)}

    def observe(self, params, state, frames):
        last = jax.tree.map(lambda x: jnp.asarray(x)[-1:], as_signal(frames))
        poses = frames.camera.world_from_camera
        return WorldState(last, self.insert(state.map, self.image(frames), poses))

    def imagine(self, params, state, control, key, *, remember=True, memory=True):
        camera = control_of(self, state.frame.camera, control).camera
        poses = jnp.concatenate([state.frame.camera.world_from_camera, camera.world_from_camera])

        def step(carry, to):
            image = self.next(params, carry[1] if memory else None, carry[0], *to)
            return (image, self.insert(carry[1], image[None], to[1][None])), image

        begin, moves = (self.image(state.frame)[0], state.map), actions_between(poses)
        (_, kept), images = jax.lax.scan(step, begin, (moves, poses[1:]))
        depth = depth_from_signal(self.clip, images[..., 3])
        frames = Frames(jnp.clip(images[..., :3], -1, 1), depth, camera)
        last = jax.tree.map(lambda x: x[-1:], frames)
        return WorldState(last, kept if remember else state.map), frames
