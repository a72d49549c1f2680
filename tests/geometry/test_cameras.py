import ast
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pewm_jax
from pewm_jax.geometry import actions, cameras
from pewm_jax.memory import interface as memories
from pewm_jax.memory.images import ImagesConfig
from pewm_jax.memory.points import PointsConfig
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.memory.voxel_map import Map2DConfig, VoxelConfig
from pewm_jax.types import Camera, Frames
from tests.helpers import random_camera, rigid, tiny_model
from tests.properties import examples


@examples(20)
@given(seed=st.integers(0, 10_000))
def test_every_unprojected_pixel_projects_back_to_its_centre(seed):
    rng = np.random.default_rng(seed)
    camera = random_camera(rng, 3, 6, 8)
    depth = rng.uniform(0.3, 9, (3, 6, 8)).astype(np.float32)
    points = cameras.unproject(depth, camera)
    uv, z = cameras.project(points.reshape(3, -1, 3), camera)
    np.testing.assert_allclose(uv.reshape(3, 6, 8, 2)[0], cameras.pixel_grid(6, 8), atol=2e-3)
    np.testing.assert_allclose(z.reshape(3, 6, 8), depth, rtol=1e-4)


def test_pixel_centres_are_at_one_half():
    intrinsics = cameras.intrinsics_from_fov(4, 4, 90.0)
    rays = np.asarray(cameras.ray_directions(intrinsics, 4, 4))
    np.testing.assert_allclose(rays.sum((0, 1))[:2], 0, atol=1e-6)
    np.testing.assert_allclose(rays[0, 0], [-0.75, -0.75, 1])


def test_resized_intrinsics_see_the_same_directions():
    small = cameras.intrinsics_from_fov(4, 6, 70.0)
    large = cameras.resize_intrinsics(small, 2.0, 2.0)
    np.testing.assert_allclose(large, cameras.intrinsics_from_fov(8, 12, 70.0), rtol=1e-6)


def test_an_upright_camera_looks_where_its_yaw_says():
    pose = cameras.pose_from_yaw(np.array([1.0, 2.0, 3.0]), math.pi / 2, 0.0)
    point_ahead = np.array([[1.0, 4.0, 3.0]], np.float32)
    point_above_left = np.array([[0.5, 4.0, 3.5]], np.float32)
    camera = Camera(np.array([10, 10, 5, 5], np.float32), pose)
    uv, z = cameras.project(point_ahead, camera)
    np.testing.assert_allclose(uv, [[5, 5]], atol=1e-4)
    np.testing.assert_allclose(z, [2], atol=1e-5)
    uv, _ = cameras.project(point_above_left, camera)
    assert uv[0, 0] < 5, "left of the view axis is left in the image"
    assert uv[0, 1] < 5, "up in the world is up in the image"


@pytest.mark.parametrize("seed", range(3))
def test_inverse_and_relative_poses(seed):
    rng = np.random.default_rng(seed)
    motion = rigid(rng)
    np.testing.assert_allclose(cameras.invert_rigid(motion) @ motion, np.eye(4), atol=1e-5)
    camera = random_camera(rng, 4)
    relative = cameras.relative_to_first(camera)
    np.testing.assert_allclose(relative.world_from_camera[0], np.eye(4), atol=1e-5)
    moved = Camera(camera.intrinsics_4, motion @ camera.world_from_camera)
    again = cameras.relative_to_first(moved)
    np.testing.assert_allclose(again.world_from_camera, relative.world_from_camera, atol=1e-5)


GEOMETRY = sorted((Path(pewm_jax.__file__).parent / "geometry").glob("*.py"))


def products(jaxpr):
    """Yield the precision of every matrix product in a jaxpr and in those inside it."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation.params["precision"]
        for value in equation.params.values():
            for each in value if isinstance(value, (tuple, list)) else (value,):
                inner = getattr(each, "jaxpr", each)
                if hasattr(inner, "eqns"):
                    yield from products(inner)


CAMERA = Camera(jnp.array([[8.0, 8, 8, 8]] * 3), jnp.broadcast_to(jnp.eye(4), (3, 4, 4)))
POSE, DEPTH, POINTS = jnp.eye(4), jnp.ones((3, 16, 16)), jnp.ones((3, 5, 3))
EXACT = {
    "invert": lambda: cameras.invert_rigid(POSE),
    "relative": lambda: cameras.relative_to_first(CAMERA),
    "transform": lambda: cameras.transform_points(POSE, POINTS[0]),
    "unproject": lambda: cameras.unproject(DEPTH, CAMERA),
    "project": lambda: cameras.project(POINTS, CAMERA),
    "rays": lambda: cameras.plucker(CAMERA, 16, 16),
    "ray latents": lambda: cameras.camera_latents(CAMERA, 16, 16, 8, 1),
    "step": lambda: actions.step_pose(POSE, jnp.ones(3)),
    "integrate": lambda: actions.integrate(POSE, jnp.ones((2, 3))),
    "between": lambda: actions.actions_between(CAMERA.world_from_camera),
    "back": lambda: actions.there_and_back(jnp.ones((2, 3))),
    "camera steps": lambda: actions.camera_steps_between(CAMERA, CAMERA, 16),
    "follow": lambda: actions.follow_camera_steps(CAMERA, jnp.zeros((3, 6)), 16),
}
"""Functions that multiply positions and rotations, called with arrays of their own."""


@pytest.mark.parametrize("name", EXACT)
def test_geometry_multiplies_in_full_precision(name):
    """The default is bfloat16 products on TPUs and TF32 on GPUs."""
    found = list(products(jax.make_jaxpr(EXACT[name])().jaxpr))
    assert found
    highest = jax.lax.Precision.HIGHEST
    assert all(each == (highest, highest) for each in found)


MEMORIES = {
    "surfels": SurfelConfig(cells=(16, 16, 16), capacity=64, tokens=8),
    "voxel": VoxelConfig(cells=(16, 16, 16), capacity=64, tokens=8),
    "points": PointsConfig(cells=(16, 16, 16), capacity=64, tokens=8),
    "map2d": Map2DConfig(tokens=8),
    "images": ImagesConfig(tokens=8, snapshots=1),
}


@pytest.mark.parametrize("kind", MEMORIES)
def test_memories_place_and_show_points_in_full_precision(kind):
    model = tiny_model(memory=MEMORIES[kind])
    clip = model.clip
    camera = jax.tree.map(lambda x: x[:2], CAMERA)
    depth = jnp.ones((2, clip.height, clip.width))
    frames = Frames(jnp.zeros((*depth.shape, 3)), depth, camera)
    features = jnp.zeros((2, 2, 2, model.memory.encoder.channels))

    def all_of_it():
        memory = model.memory.empty(model, jnp.zeros(3))
        memory = memories.insert(model, {}, memory, frames, features)
        seen = model.memory.read(model, memory, camera)
        return seen, memories.render(model, memory, camera, clip.height, clip.width)

    highest = jax.lax.Precision.HIGHEST
    found = list(products(jax.make_jaxpr(all_of_it)().jaxpr))
    assert all(each == (highest, highest) for each in found)
    assert found


@pytest.mark.parametrize("path", GEOMETRY, ids=lambda path: path.stem)
def test_products_in_geometry_go_through_the_two_functions_of_full_precision(path):
    """So that a new function of geometry is exact without being listed above."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
            found.append(node.lineno)
        named = isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)
        products = ("matmul", "einsum", "dot", "tensordot", "vdot", "inner")
        if named and node.value.id == "jnp" and node.attr in products:
            found.append(node.lineno)
    assert len(found) == (2 if path.stem == "cameras" else 0), (path, found)


@pytest.mark.parametrize("seed", range(3))
def test_every_ray_passes_through_what_the_pixel_sees(seed):
    rng = np.random.default_rng(seed)
    camera = random_camera(rng, 2, 5, 7)
    rays = np.asarray(cameras.plucker(camera, 5, 7))
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
    before = cameras.plucker(camera, 4, 4)[..., 3:]
    after = cameras.plucker(Camera(camera.intrinsics_4, shifted), 4, 4)[..., 3:]
    np.testing.assert_array_equal(before, after)


def test_folding_repeats_the_first_frame_and_groups_the_others():
    frames = jnp.arange(9)[:, None]
    np.testing.assert_array_equal(
        cameras.fold_frames(frames, 4)[..., 0], [[0, 0, 0, 0], [1, 2, 3, 4], [5, 6, 7, 8]]
    )


def test_camera_latents_are_pooled_relative_and_keep_frame_order():
    rng = np.random.default_rng(1)
    camera = random_camera(rng, 9)
    latents = cameras.camera_latents(camera, 16, 24, 4, 4)
    assert latents.shape == (3, 4, 6, 24)
    rays = cameras.plucker(cameras.relative_to_first(camera), 16, 24)
    frame_6 = np.asarray(rays[6, :4, :4]).mean((0, 1))
    np.testing.assert_allclose(latents[2, 0, 0, 6:12], frame_6, atol=1e-6)
    moved = Camera(camera.intrinsics_4, rigid(rng) @ camera.world_from_camera)
    again = cameras.camera_latents(moved, 16, 24, 4, 4)
    np.testing.assert_allclose(again, latents, atol=1e-5)
