import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.geometry import cameras, plucker
from pewm_jax.types import Camera
from tests.helpers import random_camera, rigid


@pytest.mark.parametrize("seed", range(3))
def test_every_ray_passes_through_what_the_pixel_sees(seed):
    rng = np.random.default_rng(seed)
    camera = random_camera(rng, 2, 5, 7)
    rays = np.asarray(plucker.plucker(camera, 5, 7))
    moment, direction = rays[..., :3], rays[..., 3:]
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, atol=1e-5)
    depth = rng.uniform(1, 5, (2, 5, 7)).astype(np.float32)
    points = np.asarray(cameras.unproject(depth, camera))
    np.testing.assert_allclose(np.cross(points, direction), moment, atol=2e-5)


def test_directions_are_not_moved_by_translation():
    rng = np.random.default_rng(0)
    camera = random_camera(rng, 1)
    shifted = np.array(camera.world_from_camera)
    shifted[:, :3, 3] += [3, -1, 2]
    before = plucker.plucker(camera, 4, 4)[..., 3:]
    after = plucker.plucker(Camera(camera.intrinsics_4, shifted), 4, 4)[..., 3:]
    np.testing.assert_array_equal(before, after)


def test_folding_repeats_the_first_frame_and_groups_the_others():
    frames = jnp.arange(9)[:, None]
    np.testing.assert_array_equal(
        plucker.fold_frames(frames, 4)[..., 0], [[0, 0, 0, 0], [1, 2, 3, 4], [5, 6, 7, 8]]
    )


def test_camera_latents_are_pooled_relative_and_keep_frame_order():
    rng = np.random.default_rng(1)
    camera = random_camera(rng, 9)
    latents = plucker.camera_latents(camera, 16, 24, 4, 4)
    assert latents.shape == (3, 4, 6, 24)
    rays = plucker.plucker(cameras.relative_to_first(camera), 16, 24)
    frame_6 = np.asarray(rays[6, :4, :4]).mean((0, 1))
    np.testing.assert_allclose(latents[2, 0, 0, 6:12], frame_6, atol=1e-6)
    moved = Camera(camera.intrinsics_4, rigid(rng) @ camera.world_from_camera)
    again = plucker.camera_latents(moved, 16, 24, 4, 4)
    np.testing.assert_allclose(again, latents, atol=1e-5)
