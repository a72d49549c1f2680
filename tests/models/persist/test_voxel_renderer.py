"""What the renderer sees of voxels: rays through latents, folded as torch's Conv1d does."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from pewm_jax.config import UserError
from pewm_jax.geometry import cameras
from pewm_jax.geometry.march import RayHits
from pewm_jax.models.persist import voxel_renderer
from pewm_jax.models.persist.config import BlocksConfig, VoxelRendererConfig
from pewm_jax.types import Camera
from tests.models.persist.networks import weights

CONFIG = VoxelRendererConfig(
    classes=9, height=6, width=8, latent_channels=3, layers=14, embed=6, fold=5, longest_m=30.0,
    blocks=BlocksConfig(layers=1, heads=1, head_dim=8),
)  # fmt: skip


def test_published_layers_become_752_channels():
    assert (VoxelRendererConfig().places, VoxelRendererConfig().features) == (47, 752)


def test_layers_are_folded_as_by_torch():
    rng = np.random.default_rng(0)
    params = weights(voxel_renderer, CONFIG)
    depth = rng.uniform(0, 12, (2, 3, 14)).astype(np.float32)
    seen = RayHits(rng.integers(0, 9, (2, 3, 14)), depth, rng.integers(-1, 3, (2, 3, 14)))
    run = jax.jit(voxel_renderer.features, static_argnums=0)
    made = run(CONFIG, params, seen)

    waves = np.geomspace(CONFIG.shortest_m, CONFIG.longest_m, 3)
    angle = 2 * np.pi * depth[..., None] / waves
    told = np.asarray(params["classes"]["kernel"])[seen.ids_L]
    told = told + np.concatenate([np.sin(angle), np.cos(angle)], -1)
    convolution = torch.nn.Conv1d(6, 5, 6, 4)
    kernel = np.asarray(params["fold"]["kernel"]).reshape(6, 6, 5).transpose(2, 1, 0)
    with torch.no_grad():
        convolution.weight.copy_(torch.tensor(kernel))
        convolution.bias.copy_(torch.tensor(np.asarray(params["fold"]["bias"])))
        flat = torch.tensor(told.reshape(6, 14, 6), dtype=torch.float32).movedim(-1, 1)
        wanted = convolution(flat).movedim(1, -1).reshape(2, 3, 15)
    np.testing.assert_allclose(made, wanted, atol=1e-4)

    faced = dataclasses.replace(CONFIG, sides=True)
    faces = {"faces": {"kernel": jnp.asarray(rng.normal(size=(4, 6)), jnp.float32)}}
    plain = run(faced, {**params, **faces}, seen)
    inside = dataclasses.replace(seen, side_L=np.full_like(seen.side_L, -1))
    assert not np.allclose(plain, run(faced, {**params, **faces}, inside))


def test_drawn_voxels_join_what_rays_meet_and_reach_the_picture():
    config = dataclasses.replace(CONFIG, drawn=3)
    params = weights(voxel_renderer, config)
    rng = np.random.default_rng(1)
    shape = (1, 1, 6, 8, 14)
    layers = RayHits(rng.integers(0, 9, shape), rng.uniform(0, 5, shape), np.zeros(shape, int))
    drawn = rng.normal(size=(1, 1, 6, 8, 3)).astype(np.float32)
    told = voxel_renderer.features(config, params, layers, drawn_hwC=drawn)
    assert told.shape[-1] == config.features == config.folded + 3
    np.testing.assert_array_equal(told[..., -3:], drawn)
    plain = voxel_renderer.features(CONFIG, params, layers)
    np.testing.assert_array_equal(told[..., :-3], plain)
    noisy = jnp.zeros((1, 1, 6, 8, 3))
    made, other = (
        voxel_renderer.apply(config, params, noisy, jnp.zeros((1, 1)), x)[0]
        for x in (told, told.at[..., -3:].multiply(-1))
    )
    assert np.abs(made - other).max() > 1e-3
    for settings, given in ((config, None), (CONFIG, drawn), (config, drawn[..., :2])):
        with pytest.raises(UserError, match=r"renderer\.drawn"):
            voxel_renderer.features(settings, params, layers, drawn_hwC=given)


def test_each_frame_looks_into_its_own_grid_through_the_middle_of_latents():
    grids = np.zeros((2, 8, 8, 8), np.uint8)
    grids[0, 6] = 3  # a wall across x, 2.5 cells ahead of the middle of cell 3
    grids[1, 5] = 4
    grids[1, 7] = 5
    low = np.array([[-2.0, -2, -2], [8, -2, -2]], np.float32)
    poses = np.stack([cameras.pose_from_yaw(low[i] + 1.75, 0.0) for i in range(2)])
    fine = Camera(np.tile(cameras.intrinsics_from_fov(24, 32, 60), (2, 1)), poses)
    look = jax.jit(
        lambda camera, size: voxel_renderer.cast_rays(CONFIG, grids, low, 0.5, camera, size),
        static_argnums=1,
    )
    made = look(fine, (24, 32))
    assert made.ids_L.shape == (2, 6, 8, 14)
    np.testing.assert_array_equal(made.ids_L[0, ..., 0], 3)
    np.testing.assert_array_equal(made.ids_L[1, ..., 0], 4)
    ids = np.asarray(made.ids_L[1]).reshape(-1, 14)  # a slanting ray meets a wall more than once
    assert all(sorted(row[row > 0]) == list(row[row > 0]) and set(row) == {0, 4, 5} for row in ids)
    np.testing.assert_allclose(made.distance_L[0, ..., 0], 1.25, atol=1e-5)
    np.testing.assert_allclose(made.distance_L[1, ..., 0], 0.75, atol=1e-5)
    assert set(np.unique(made.ids_L[0])) == {0, 3}
    coarse = Camera(np.tile(cameras.intrinsics_from_fov(6, 8, 60), (2, 1)), poses)
    again = look(coarse, (6, 8))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), again, made)
