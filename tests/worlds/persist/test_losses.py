"""The losses of PERSIST's networks: what they ask for, of which frame, in which units."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.diffusion.flow import PERSIST_VOXELS
from pewm_jax.geometry import cameras
from pewm_jax.geometry.actions import camera_steps_between
from pewm_jax.geometry.march import RayHits
from pewm_jax.models.persist import camera_model, voxel_dit, voxel_renderer, voxel_vae
from pewm_jax.models.persist.config import (
    BlocksConfig,
    CameraModelConfig,
    VoxelDiTConfig,
    VoxelRendererConfig,
    VoxelVAEConfig,
)
from pewm_jax.types import Camera
from pewm_jax.worlds.persist import prepare, stages
from pewm_jax.worlds.persist.config import PersistTrainConfig
from tests.models.persist.networks import normal, weights

BLOCKS = BlocksConfig(layers=1, heads=2, head_dim=8, mlp_ratio=2, context=3)
NOISE = PERSIST_VOXELS


def model_of(**networks):
    """The settings that a stage's loss reads, with these networks."""
    return SimpleNamespace(
        backbone=SimpleNamespace(**networks),
        noise=NOISE,
        voxel_noise=NOISE,
        dtype="float32",
        clip=SimpleNamespace(width=32),
        dead_reckoning=False,
    )


def prepared(**arrays):
    return SimpleNamespace(extras={"prepared": arrays})


def walk(seed, frames=4):
    rng = np.random.default_rng(seed)
    poses = [
        cameras.pose_from_yaw(rng.normal(size=3), rng.uniform(-3, 3), rng.uniform(-0.5, 0.5))
        for _ in range(2 * frames)
    ]
    intrinsics = np.tile(cameras.intrinsics_from_fov(24, 32, 80), (2, frames, 1))
    return Camera(intrinsics, np.stack(poses).reshape(2, frames, 4, 4))


def test_actions_lead_to_their_frame_and_pictures_are_those_before():
    recorded = np.arange(1, 7, dtype=np.float32).reshape(1, 3, 2)
    led = prepare.leading_actions(recorded)
    np.testing.assert_array_equal(led[0], [[0, 0], [1, 2], [3, 4], [5, 6]])
    shown = prepare.previous_frames({"a": np.arange(4)[None]})
    np.testing.assert_array_equal(shown["a"][0], [0, 0, 1, 2])


def test_whoever_knows_the_answer_has_no_error():
    x0 = normal(0, 2, 5, 3, 4)
    asked = []

    def predict(x_t, times):
        asked.append(times.shape)
        return NOISE.velocity(x0, x_t, times / NOISE.scale)

    loss, measured = stages._velocity(NOISE, predict, x0, jax.random.key(0), jnp.float32)
    assert loss < 1e-4
    assert measured["x0_error"] < 1e-9
    assert asked == [(2, 5)]


@pytest.mark.slow
def test_world_frames_are_shown_the_picture_before_and_learn_from_everything():
    config = VoxelDiTConfig(
        latent_side=2, latent_channels=3, patch=1, actions=4, pixel_channels=5, blocks=BLOCKS
    )
    params = weights(voxel_dit, config)
    x0, actions, pixels = normal(0, 2, 4, 2, 2, 2, 3), normal(1, 2, 4, 4), normal(2, 2, 4, 2, 4, 5)

    @jax.jit
    def both(params, pixels):
        def total(params, pixels):
            clip = prepared(
                latents=x0, told=pixels, actions=actions, camera=normal(4, 2, 4, 10),
                known=np.ones(x0.shape[:-1], bool), occupied=0,
            )  # fmt: skip
            train = PersistTrainConfig(blind=0.3)
            return stages.world_frames(
                model_of(world_frames=config), train, {"voxel_dit": params}, clip, jax.random.key(3)
            )

        return jax.value_and_grad(total, (0, 1), has_aux=True)(params, pixels)

    silent = {**params, "proj_out": jax.tree.map(jnp.zeros_like, params["proj_out"])}
    (loss, _), _ = both(silent, pixels)
    np.testing.assert_allclose(loss, 1 + jnp.square(x0).mean(), rtol=0.3)
    (_, _), (slopes, to_pixels) = both(params, pixels)
    dead = [p for p, x in jax.tree_util.tree_leaves_with_path(slopes) if not x.any()]
    assert not [p for p in dead if "norm" not in str(p)]
    by_frame = np.abs(to_pixels).sum((0, 2, 3, 4))
    assert by_frame[0] > 0 == by_frame[-1]  # the last picture is of no frame's past


def test_the_error_counts_where_it_is_told_to():
    config = VoxelDiTConfig(
        latent_side=2, latent_channels=3, patch=1, actions=4, pixel_channels=5, blocks=BLOCKS
    )
    params = weights(voxel_dit, config)
    params = {**params, "proj_out": jax.tree.map(jnp.zeros_like, params["proj_out"])}
    actions, pixels, shape = normal(1, 2, 4, 4), normal(2, 2, 4, 2, 4, 5), (2, 4, 2, 2, 2)
    large = np.zeros(shape, bool)
    large[..., 0] = True
    x0 = 10.0 * large[..., None] * np.ones(3, np.float32)

    @jax.jit
    def error(counts, known):
        clip = prepared(
            latents=x0, told=pixels, actions=actions, camera=normal(4, 2, 4, 10), known=known,
            occupied=counts - 1,
        )  # fmt: skip
        train = PersistTrainConfig(blind=0.0, occupied=2.0)  # counts are 1 + (2 − 1) · occupied
        return stages.world_frames(
            model_of(world_frames=config), train, {"voxel_dit": params}, clip, jax.random.key(3)
        )[0]

    ones = np.ones(shape, bool)
    alike, here, there, more = (
        float(error(counts, ones))
        for counts in (1 + 0 * large, 1 * large, 1 * ~large, 1 + 3 * large)
    )
    assert 90 < here < 110
    assert there < 3
    np.testing.assert_allclose(alike, (here + there) / 2, rtol=1e-5)
    np.testing.assert_allclose(more, (4 * here + there) / 5, rtol=1e-5)
    np.testing.assert_allclose(float(error(1 + 3 * large, ~large)), there, rtol=1e-5)


def test_the_camera_learns_steps_and_does_not_see_where_the_next_grid_lies():
    units = (0.25, 0.25, 0.25, 0.3, 0.3, 0.3)
    config = CameraModelConfig(classes=5, inner=2, embed=4, actions=4, units=units, blocks=BLOCKS)
    params = weights(camera_model, config)
    silent = {**params, "proj_out": jax.tree.map(jnp.zeros_like, params["proj_out"])}
    seen, actions = walk(0), normal(1, 2, 4, 4)
    classes = jnp.asarray(np.random.default_rng(2).integers(0, 5, (2, 4, 2, 2, 2)))
    middle = seen.world_from_camera[..., :3, 3].round()

    @jax.jit
    def run(params, middle, poses):
        clip = prepared(
            classes=classes,
            middle=middle,
            camera=Camera(seen.intrinsics_4, poses),
            actions=actions,
        )
        model = model_of(camera_model=config)
        return stages.camera(model, None, {"camera_model": params}, clip, None)

    loss, measured = run(silent, middle, seen.world_from_camera)
    first, second = (
        jax.tree.map(lambda x, c=c: x[:, c], seen) for c in (slice(-1), slice(1, None))
    )
    steps = camera_steps_between(first, second, 32)
    np.testing.assert_allclose(loss, jnp.square(steps / np.array(units)).mean(), rtol=1e-5)
    away = np.linalg.norm(steps[..., :3], axis=-1).mean()
    np.testing.assert_allclose(measured["metres_off"], away, rtol=1e-5)

    loss = run(params, middle, seen.world_from_camera)[0]
    elsewhere = seen.world_from_camera + 7.0 * np.eye(4, k=3, dtype=np.float32)
    shift = np.array([7, 0, 0], np.float32)
    np.testing.assert_allclose(run(params, middle + shift, elsewhere)[0], loss, rtol=1e-3)
    last = middle + np.array([0, 0, 0, 1], np.float32)[:, None]
    assert run(params, last, seen.world_from_camera)[0] == loss


@pytest.mark.slow
def test_the_renderer_learns_to_fold_layers():
    config = VoxelRendererConfig(
        classes=5, height=2, width=4, latent_channels=3, layers=6, embed=4, fold=2, sides=True,
        blocks=BLOCKS,
    )  # fmt: skip
    params = weights(voxel_renderer, config)
    rng, shape = np.random.default_rng(0), (2, 3, 2, 4, 6)
    layers = RayHits(
        rng.integers(0, 5, shape), rng.uniform(0, 5, shape), rng.integers(-1, 3, shape)
    )
    x0 = normal(1, 2, 3, 2, 4, 3)

    @jax.jit
    def slopes(params):
        def loss(params):
            clip = prepared(
                latents=x0, ids=layers.ids_L, distance=layers.distance_L, side=layers.side_L,
                actions=None,
            )  # fmt: skip
            model = model_of(renderer=config)
            return stages.renderer(model, None, {"renderer": params}, clip, jax.random.key(0))[0]

        return jax.grad(loss)(params)

    found = slopes(params)
    for name in ("classes", "faces", "fold"):
        assert all((np.abs(x).sum(-1) > 0).all() for x in jax.tree.leaves(found[name])), name


def test_every_grid_of_a_clip_is_reconstructed(monkeypatch):
    config = VoxelVAEConfig(side=4, classes=3, patch=4, embed=2, widths=(4,))
    seen = []
    monkeypatch.setattr(voxel_vae, "loss", lambda *arguments: seen.append(arguments))
    grids = SimpleNamespace(extras={"prepared": np.zeros((2, 3, 4, 4, 4), np.int16)})
    stages.autoencode(model_of(voxel_vae=config), None, {"voxel_vae": {}}, grids, None)
    ((_, _, grids, _, _),) = seen
    assert grids.shape == (6, 4, 4, 4)
