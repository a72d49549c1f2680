"""Holes are filled from the nearest known pixel; normals face the camera."""

import jax
import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from pewm_jax.geometry import depth_images
from pewm_jax.geometry.cameras import unproject
from pewm_jax.geometry.depth_images import normals
from tests.helpers import random_camera
from tests.properties import examples

fill = jax.jit(depth_images.fill_depth, static_argnums=1)


@examples(20)
@given(st.integers(0, 10_000), st.sampled_from([0.02, 0.3, 0.9]))
def test_a_hole_takes_the_depth_of_a_nearest_pixel(seed, share):
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1, 5, (2, 9, 14)).astype(np.float32) * (rng.random((2, 9, 14)) < share)
    filled = np.asarray(fill(depth, 7.0))
    for before, after in zip(depth, filled, strict=True):
        known = np.argwhere(before > 0)
        if not len(known):
            assert (after == 7).all()
            continue
        for place in np.ndindex(before.shape):
            distance = np.hypot(*(known - place).T)
            off = min(np.hypot(*(np.array(p) - place)) for p in np.argwhere(before == after[place]))
            assert off <= 1.3 * distance.min() + 1.0  # jump flooding is seldom off, by little


def test_without_holes_nothing_changes():
    depth = np.random.default_rng(0).uniform(1, 5, (2, 8, 8)).astype(np.float32)
    np.testing.assert_array_equal(fill(depth, 7.0), depth)


found = jax.jit(normals)


def plane(seed, facing=0.05):
    """A plane's depth image, its normal towards the camera, and the camera; None if it is aside."""
    rng = np.random.default_rng(seed)
    camera = random_camera(rng, 1)
    place = camera.world_from_camera[0, :3, 3]
    rays = np.asarray(unproject(np.ones((1, 16, 24), np.float32), camera)) - place
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    against = -(rays @ normal)
    if not ((against > facing).all() or (against < -facing).all()):
        return None
    depth = rng.uniform(0.5, 2) / np.abs(against)
    return depth.astype(np.float32), normal * np.sign(against.flat[0]), camera


@examples(30)
@given(st.integers(0, 10_000))
def test_normals_of_a_plane_are_its_own_and_face_the_camera(seed):
    drawn = plane(seed)
    assume(drawn is not None)
    depth, normal, camera = drawn
    made = np.asarray(found(depth, camera))
    np.testing.assert_allclose(made, np.broadcast_to(normal, made.shape), atol=2e-3)


def test_two_planes_keep_their_normals_up_to_the_edge_between_them():
    camera = random_camera(np.random.default_rng(0), 1, upright=True)
    depth = np.full((1, 16, 24), 2.0, np.float32)
    depth[..., 12:] = 3.0
    made = np.asarray(found(depth, camera))
    towards = -np.asarray(camera.world_from_camera)[0, :3, 2]
    np.testing.assert_allclose(made, np.broadcast_to(towards, made.shape), atol=1e-4)


def test_without_depth_there_is_no_normal_and_neighbours_do_without_it():
    depth, normal, camera = next(filter(None, map(plane, range(100))))
    depth[0, 4, 5] = 0
    depth[0, :, 20] = np.inf
    depth[0, 8, 10:13] = 0
    made = np.asarray(found(depth, camera))
    known = np.linalg.norm(made, axis=-1) > 0.5
    assert not known[0, 4, 5]
    assert not known[0, :, 20].any()
    assert known.mean() > 0.9
    np.testing.assert_allclose(made[known], np.broadcast_to(normal, made[known].shape), atol=2e-3)
    assert np.isfinite(made).all()
    alone = np.zeros_like(depth)
    alone[0, 3, 3] = 1
    assert not np.asarray(found(alone, camera)).any()
