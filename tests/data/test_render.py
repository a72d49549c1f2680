"""The renderer against geometry that can be worked out by hand."""

import pickle

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from pewm_jax.config import UserError
from pewm_jax.data.render import render
from pewm_jax.data.scenes import from_trimesh, house, load_scene
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw, unproject
from pewm_jax.houses.generate import generate_house
from pewm_jax.types import Camera
from tests.properties import examples


def wall_facing_minus_x(distance: float, half: float = 50.0) -> trimesh.Trimesh:
    """A wall at x = distance, seen from the origin; uv (0, 0) is at the viewer's bottom left."""
    corners = [[distance, half, -half], [distance, -half, -half]]
    corners += [[distance, -half, half], [distance, half, half]]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def painted(mesh: trimesh.Trimesh, image: np.ndarray, *, pbr: bool) -> trimesh.Trimesh:
    picture = Image.fromarray(image)
    material = PBRMaterial(baseColorTexture=picture) if pbr else SimpleMaterial(image=picture)
    uv = [[0, 0], [1, 0], [1, 1], [0, 1]]
    mesh.visual = TextureVisuals(uv=uv, material=material)
    return mesh


def camera(*poses: np.ndarray, height: int = 24, width: int = 32, fov: float = 80.0) -> Camera:
    intrinsics = np.tile(intrinsics_from_fov(height, width, fov), (len(poses), 1))
    return Camera(intrinsics, np.stack(poses))


LOOK_X = pose_from_yaw(np.zeros(3), 0.0)


@examples(40)
@given(
    st.floats(-1.2, 1.2),
    st.floats(-0.5, 0.5),
    st.floats(0.3, 9.0),
    st.tuples(st.floats(-30, 30), st.floats(-30, 30), st.floats(-3, 3)),
)
def test_depth_is_the_distance_along_z_to_a_plane(yaw, pitch, distance, shift):
    wall = wall_facing_minus_x(distance)
    wall.apply_translation(shift)
    pose = pose_from_yaw(np.array(shift), yaw, pitch)
    view = camera(pose)
    depth = render(from_trimesh(wall, "wall"), view, 24, 32).depth_THW[0]
    hit = depth > 0
    intrinsics, pose = np.float64(view.intrinsics_4[0]), np.float64(pose)
    u, v = np.meshgrid(np.arange(32) + 0.5, np.arange(24) + 0.5)
    x = (u - intrinsics[2]) / intrinsics[0]
    y = (v - intrinsics[3]) / intrinsics[1]
    slope = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2]
    with np.errstate(divide="ignore"):
        expected = (shift[0] + distance - pose[0, 3]) / slope
    assert hit[12, 16]
    near = hit & (expected < 20)
    np.testing.assert_allclose(depth[near], expected[near], atol=1e-5, rtol=1e-5)


def test_depth_does_not_grow_towards_the_corners_of_the_image():
    depth = render(from_trimesh(wall_facing_minus_x(2.0), "w"), camera(LOOK_X), 24, 32).depth_THW
    np.testing.assert_allclose(depth, 2.0, atol=1e-6)


def test_points_of_a_box_lie_on_its_surface_far_from_the_origin():
    box = trimesh.creation.box((2.0, 1.0, 0.5))
    box.apply_translation([410.0, -230.0, 55.0])
    poses = [pose_from_yaw(np.array([407.0, -230.2, 55.3]), a, -0.1) for a in (-0.2, 0.0, 0.3)]
    view = camera(*poses)
    seen = render(from_trimesh(box, "box"), view, 24, 32)
    local = Camera(view.intrinsics_4, np.array(view.world_from_camera, np.float64))
    local.world_from_camera[:, :3, 3] -= [410.0, -230.0, 55.0]
    points = np.asarray(unproject(seen.depth_THW, local))[seen.depth_THW > 0]
    assert len(points) > 100
    outside = np.max(np.abs(points) / [1.0, 0.5, 0.25], -1) - 1
    np.testing.assert_allclose(outside, 0, atol=2e-5)


def test_rays_go_through_pixel_centres():
    """A step edge exactly between two columns falls exactly between them."""
    mesh = wall_facing_minus_x(1.0, half=1.0)
    mesh.apply_translation([0, 1.0, 0])  # covers y ≥ 0: the left half of the image
    view = Camera(np.array([[8.0, 8.0, 8.0, 8.0]]), LOOK_X[None])
    ids = render(from_trimesh(mesh, "half"), view, 16, 16).ids_THW[0]
    assert (ids[8, :8] == 0).all()
    assert (ids[8, 8:] == -1).all()
    edge = Camera(np.array([[8.0, 8.0, 8.45, 8.0]]), LOOK_X[None])
    assert (render(from_trimesh(mesh, "half"), edge, 16, 16).ids_THW[0, 8, :8] == 0).all()
    edge = Camera(np.array([[8.0, 8.0, 8.55, 8.0]]), LOOK_X[None])
    assert render(from_trimesh(mesh, "half"), edge, 16, 16).ids_THW[0, 8, 8] == 0


@pytest.mark.parametrize("pbr", [True, False])
def test_textures_are_upright_and_not_mirrored(pbr):
    image = np.zeros((8, 8, 3), np.uint8)
    image[:4, :4], image[:4, 4:] = (200, 0, 0), (0, 200, 0)
    image[4:, :4], image[4:, 4:] = (0, 0, 200), (200, 200, 0)
    wall = painted(wall_facing_minus_x(1.0, half=1.0), image, pbr=pbr)
    view = Camera(np.array([[16.0, 16.0, 16.0, 16.0]]), LOOK_X[None])
    rgb = render(from_trimesh(wall, "wall"), view, 32, 32).rgb_THWC[0]
    assert rgb[4, 4].tolist() == [200, 0, 0]
    assert rgb[4, 27].tolist() == [0, 200, 0]
    assert rgb[27, 4].tolist() == [0, 0, 200]
    assert rgb[27, 27].tolist() == [200, 200, 0]


def test_one_texel_per_pixel_returns_the_image_itself():
    image = np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)
    wall = painted(wall_facing_minus_x(1.0, half=1.0), image, pbr=True)
    view = Camera(np.array([[16.0, 16.0, 16.0, 16.0]]), LOOK_X[None])
    rgb = render(from_trimesh(wall, "wall"), view, 32, 32).rgb_THWC[0]
    np.testing.assert_allclose(rgb.astype(int), image, atol=1)


def test_far_textures_are_averaged_instead_of_flickering():
    image = np.zeros((64, 64, 3), np.uint8)
    image[::2, ::2], image[1::2, 1::2] = 255, 255
    wall = painted(wall_facing_minus_x(4.0, half=4.0), image, pbr=True)
    view = Camera(np.array([[4.0, 4.0, 4.0, 4.0]]), LOOK_X[None])
    rgb = render(from_trimesh(wall, "wall"), view, 8, 8).rgb_THWC[0]
    np.testing.assert_allclose(rgb, 127.5, atol=8)


def test_vertex_colours_are_interpolated_and_face_colours_are_not():
    wall = wall_facing_minus_x(1.0, half=1.0)
    wall.visual.vertex_colors = [[0, 0, 0, 255], [200, 0, 0, 255]] * 2
    wall.visual.vertex_colors[2:] = [[200, 0, 0, 255], [0, 0, 0, 255]]
    view = Camera(np.array([[8.0, 8.0, 8.0, 8.0]]), LOOK_X[None])
    red = render(from_trimesh(wall, "wall"), view, 16, 16).rgb_THWC[0, :, :, 0].astype(float)
    expected = np.tile((np.arange(16) + 0.5) / 16 * 200, (16, 1))
    np.testing.assert_allclose(red, expected, atol=1)
    wall = wall_facing_minus_x(1.0, half=1.0)
    wall.visual.face_colors = [[10, 20, 30, 255], [200, 100, 50, 255]]
    rgb = render(from_trimesh(wall, "wall"), view, 16, 16).rgb_THWC[0]
    assert rgb[14, 8].tolist() == [10, 20, 30]
    assert rgb[1, 8].tolist() == [200, 100, 50]


def test_a_factor_multiplies_the_texture():
    image = np.full((4, 4, 3), 200, np.uint8)
    wall = painted(wall_facing_minus_x(1.0), image, pbr=True)
    wall.visual.material.baseColorFactor = [255, 128, 0, 255]
    rgb = render(from_trimesh(wall, "wall"), camera(LOOK_X), 24, 32).rgb_THWC[0, 12, 16]
    np.testing.assert_allclose(rgb, [200, 100, 0], atol=1)


def test_a_mesh_without_colours_is_grey_and_its_faces_are_told_apart():
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    pose = pose_from_yaw(np.array([-1.5, -0.8, 1.4]), 0.5, -0.6)
    seen = render(from_trimesh(box, "box"), camera(pose), 24, 32)
    colours = np.unique(seen.rgb_THWC[seen.ids_THW == 0], axis=0)
    assert len(colours) == 3
    assert (np.ptp(colours.astype(int), axis=1) < 40).all()


def test_instances_of_a_graph_are_moved_and_numbered():
    ball, scene = trimesh.creation.icosphere(radius=0.3), trimesh.Scene()
    scene.add_geometry(
        ball,
        geom_name="ball",
        node_name="left",
        transform=trimesh.transformations.translation_matrix([2, 0.7, 0]),
    )
    scene.graph.update(
        "right", geometry="ball", matrix=trimesh.transformations.translation_matrix([2, -0.7, 0])
    )
    world = from_trimesh(scene, "two")
    seen = render(world, camera(LOOK_X), 24, 32)
    left, right = seen.ids_THW[0, 12, 10], seen.ids_THW[0, 12, 21]
    assert (world.objects[left], world.objects[right]) == ("left", "right")
    assert seen.ids_THW[0, 12, 16] == -1
    assert seen.depth_THW[0, 12, 16] == 0
    assert seen.rgb_THWC[0, 12, 16].tolist() == [0, 0, 0]


def test_y_up_files_are_turned_to_z_up(tmp_path):
    """glTF has y up: what is at y = 2 there is 2 m above the ground here."""
    box = trimesh.creation.box((1.0, 0.2, 0.4))
    box.apply_translation([5.0, 2.0, -3.0])
    box.export(tmp_path / "box.glb")
    box.export(tmp_path / "box.ply")
    turned = load_scene(tmp_path / "box.glb").vertices_V3
    np.testing.assert_allclose((turned.min(0) + turned.max(0)) / 2, [5.0, 3.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(np.ptp(turned, axis=0), [1.0, 0.4, 0.2], atol=1e-6)
    kept = load_scene(tmp_path / "box.ply").vertices_V3
    np.testing.assert_allclose((kept.min(0) + kept.max(0)) / 2, [5.0, 2.0, -3.0], atol=1e-6)
    kept = load_scene(tmp_path / "box.glb", up="z").vertices_V3
    np.testing.assert_allclose(np.ptp(kept, axis=0), [1.0, 0.2, 0.4], atol=1e-6)


def test_a_house_survives_the_way_through_a_file(tmp_path):
    mesh = generate_house(4)
    mesh.export(tmp_path / "house.glb")
    again, direct = load_scene(tmp_path / "house.glb", up="z"), from_trimesh(mesh, "house")
    x0, y0, x1, y1 = mesh.metadata["rooms"][0]
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2, 1.3])
    view = camera(*(pose_from_yaw(middle, a) for a in (0.1, 2.2, 4.3)))
    a, b = render(again, view, 24, 32), render(direct, view, 24, 32)
    np.testing.assert_allclose(a.depth_THW, b.depth_THW, atol=1e-4)
    different = np.abs(a.rgb_THWC.astype(int) - b.rgb_THWC).max(-1) > 3
    assert different.mean() < 0.02


def test_textured_obj_files_are_read(tmp_path):
    image = np.zeros((8, 8, 3), np.uint8)
    image[:4] = (250, 10, 10)
    painted(wall_facing_minus_x(1.0, half=1.0), image, pbr=False).export(tmp_path / "wall.obj")
    view = Camera(np.array([[16.0, 16.0, 16.0, 16.0]]), LOOK_X[None])
    rgb = render(load_scene(tmp_path / "wall.obj"), view, 32, 32).rgb_THWC[0]
    np.testing.assert_allclose(rgb[4, 16], [250, 10, 10], atol=2)
    np.testing.assert_allclose(rgb[28, 16], [0, 0, 0], atol=2)


def test_a_point_has_the_same_colour_from_everywhere():
    """Light is fixed to the world: a wall seen from two places differs by nothing."""
    wall = wall_facing_minus_x(2.0)
    scene = trimesh.Scene(wall)
    scene.metadata["shading"] = "soft"
    world = from_trimesh(scene, "wall")
    poses = [pose_from_yaw(np.array([0, y, 0.0]), a) for y, a in ((0, 0), (3, -0.6), (-4, 0.8))]
    rgb = render(world, camera(*poses), 24, 32).rgb_THWC.reshape(-1, 3)
    assert (np.ptp(rgb.astype(int), axis=0) <= 1).all()


def test_rendering_in_chunks_or_one_by_one_is_the_same():
    world = house(1)
    x0, y0, x1, y1 = world.metadata["rooms"][0]
    poses = [
        pose_from_yaw(np.array([(x0 + x1) / 2, (y0 + y1) / 2, 1.2]), 0.3 * k) for k in range(9)
    ]
    again = pickle.loads(pickle.dumps(world))
    many = render(world, camera(*poses, height=48, width=64), 48, 64)
    assert many.rgb_THWC.shape == (9, 48, 64, 3)
    for k in (0, 5, 8):
        one = render(again, camera(poses[k], height=48, width=64), 48, 64)
        np.testing.assert_array_equal(one.rgb_THWC[0], many.rgb_THWC[k])
        np.testing.assert_array_equal(one.depth_THW[0], many.depth_THW[k])
        np.testing.assert_array_equal(one.ids_THW[0], many.ids_THW[k])


def refused(what) -> str:
    with pytest.raises(UserError) as error:
        what()
    message = str(error.value)
    assert "\n" not in message
    assert message.endswith(".")
    return message


def test_bad_files_are_refused_in_a_sentence(tmp_path):
    assert "nowhere.glb" in refused(lambda: load_scene(tmp_path / "nowhere.glb"))
    (tmp_path / "broken.glb").write_bytes(b"glTF\x02\x00\x00\x00 this is no mesh")
    assert "broken.glb" in refused(lambda: load_scene(tmp_path / "broken.glb"))
    (tmp_path / "notes.txt").write_text("hello")
    assert "notes.txt" in refused(lambda: load_scene(tmp_path / "notes.txt"))
    (tmp_path / "empty.ply").write_bytes(b"")
    assert "empty.ply" in refused(lambda: load_scene(tmp_path / "empty.ply"))
    whole = trimesh.creation.box().export(file_type="glb")
    (tmp_path / "cut.glb").write_bytes(whole[: len(whole) // 2])
    assert "cut.glb" in refused(lambda: load_scene(tmp_path / "cut.glb"))
    trimesh.PointCloud(np.random.default_rng(0).normal(size=(50, 3))).export(tmp_path / "p.ply")
    assert "no triangles" in refused(lambda: load_scene(tmp_path / "p.ply"))


def test_bad_geometry_is_refused_in_a_sentence():
    assert "no triangles" in refused(lambda: from_trimesh(trimesh.Scene(), "nothing"))
    wall = wall_facing_minus_x(1.0)
    holed = trimesh.Trimesh(np.array(wall.vertices), wall.faces, process=False)
    holed.vertices[0, 1] = np.nan
    assert "not finite" in refused(lambda: from_trimesh(holed, "holed"))
    astray = trimesh.Trimesh(np.array(wall.vertices), [[0, 1, 9]], process=False)
    assert "past" in refused(lambda: from_trimesh(astray, "astray"))


def test_bad_cameras_are_refused_in_a_sentence():
    world = from_trimesh(wall_facing_minus_x(1.0), "wall")
    single = Camera(intrinsics_from_fov(8, 8, 90), LOOK_X)
    assert "leading axis" in refused(lambda: render(world, single, 8, 8))
    lost = LOOK_X.copy()
    lost[0, 3] = np.nan
    assert "not finite" in refused(lambda: render(world, camera(lost), 8, 8))
    assert "empty" in refused(lambda: render(world, camera(LOOK_X), 0, 8))
