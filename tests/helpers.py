"""What several test files share: a tiny world model, random weights, random posed frames."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import ClipConfig, Config
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.geometry import cameras
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.types import Camera, Frames
from pewm_jax.worlds import world_model
from pewm_jax.worlds.pewm.world import PEWM

TINY = PEWM(
    clip=ClipConfig(frames=9, height=16, width=24),
    codec=PixelConfig(spatial=4),
    backbone=DiTBackbone(
        layers=2, heads=2, head_dim=16, patch=2, text_length=3, text_dim=8, time_dim=16
    ),
    memory=VoxelConfig(
        cell_m=(0.5, 0.5, 0.5),
        cells=(24, 24, 8),
        capacity=2048,
        tokens=32,
        imagined_edge=0.0,  # untrained models imagine nothing but edges
        reader=AttentionConfig(heads=4, head_dim=8),
    ),
    noise=DDPMConfig(sample_steps=3),
)
"""A model of two blocks, for 9 frames of 16 × 24 pixels."""


def tiny_config(**sections) -> Config:
    """Return a tiny experiment; sections are the model's, or data, train and evaluate."""
    of_model = {field.name for field in dataclasses.fields(PEWM)} & sections.keys()
    model = tiny_model(**{name: sections.pop(name) for name in of_model})
    return Config(model=model, **sections)


def tiny_model(**sections) -> PEWM:
    """Return a tiny model with other sections: ``tiny_model(noise=…)``."""
    return dataclasses.replace(TINY, **sections)


def shrink(model, frames=3, side=16):
    """Return a world model of one tiny block, on pixels, with one sampling step.

    It has a gate if the model has one.
    """
    return dataclasses.replace(
        model,
        clip=dataclasses.replace(model.clip, frames=frames, height=side, width=side),
        codec=PixelConfig(temporal=1, gate=8 if getattr(model.codec, "gate", 0) else 0),
        backbone=DiTBackbone(
            layers=1, heads=1, head_dim=16, text_length=1, text_dim=8, time_dim=16
        ),
        noise=dataclasses.replace(model.noise, sample_steps=1),
    )


def with_reader(model: PEWM, **changes) -> PEWM:
    """Return a model whose reader of the memory has other settings."""
    reader = dataclasses.replace(model.memory.reader, **changes)
    return dataclasses.replace(model, memory=dataclasses.replace(model.memory, reader=reader))


@functools.partial(jax.jit, static_argnums=0, static_argnames="memory")
def _init(model, key, *, memory):
    return world_model.init(model, key, memory=memory)


def init_world(config, key=None, *, memory=True):
    """Initialise as the library does, compiled: several times faster than step by step.

    Takes a model or an experiment.
    """
    model = config.model if isinstance(config, Config) else config
    return _init(model, jax.random.key(0) if key is None else key, memory=memory)


def randomise(params, seed=0, scale=0.2):
    """Replace every leaf, norms and zero-initialised gates included, by random numbers."""
    leaves, tree = jax.tree.flatten(params)
    rng = np.random.default_rng(seed)
    half = np.float32(0.5)  # in NumPy: to add arrays of many shapes in JAX compiles for each shape
    drawn = [
        np.asarray(rng.normal(0, scale, x.shape), np.float32) + half * np.asarray(x, np.float32)
        for x in leaves
    ]
    return jax.tree.unflatten(tree, [jnp.asarray(x) for x in drawn])


def randomised(init, *args, seed=0, scale=0.2):
    """Return ``randomise`` of what ``init`` returns, without compiling it.

    Norms start at 1, matrices at random numbers by how many they add up, and all else at 0.
    """
    rng = np.random.default_rng(seed + 1)

    def start(path, leaf):
        if "scale" in jax.tree_util.keystr(path[-1:]):
            return np.ones(leaf.shape, np.float32)
        wide = leaf.ndim > 1
        return rng.normal(0, np.prod(leaf.shape[:-1]) ** -0.5 if wide else 0, leaf.shape)

    shapes = jax.eval_shape(functools.partial(init, *args))
    return randomise(jax.tree_util.tree_map_with_path(start, shapes), seed, scale)


def random_world(config, *, memory=True, seed=0, scale=0.2):
    """Return random weights of a model or an experiment."""
    model = config.model if isinstance(config, Config) else config
    init = functools.partial(world_model.init, memory=memory)
    return randomised(init, model, jax.random.key(0), seed=seed, scale=scale)


def random_camera(rng, frames, height=16, width=24, upright=False) -> Camera:
    poses = []
    for _ in range(frames):
        pitch = 0.0 if upright else rng.uniform(-0.4, 0.4)
        poses.append(cameras.pose_from_yaw(rng.uniform(-1, 1, 3), rng.uniform(-3, 3), pitch))
    intrinsics = cameras.intrinsics_from_fov(height, width, 90.0)
    return Camera(np.tile(intrinsics, (frames, 1)), np.stack(poses))


def random_frames(rng, frames, height=16, width=24) -> Frames:
    return Frames(
        rng.integers(0, 256, (frames, height, width, 3), dtype=np.uint8),
        rng.uniform(0.5, 4.0, (frames, height, width)).astype(np.float32),
        random_camera(rng, frames, height, width, upright=True),
    )


def rigid(rng) -> np.ndarray:
    """A random rotation about any axis, and a translation."""
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.linalg.det(q))
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = q, rng.uniform(-3, 3, 3)
    return motion.astype(np.float32)
