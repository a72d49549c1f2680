"""Houses: determined by their seed, connected, furnished, closed."""

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

from pewm_jax.data.render import render
from pewm_jax.data.scenes import from_trimesh, house
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw
from pewm_jax.houses import floorplan
from pewm_jax.houses import floorplan as connectivity
from pewm_jax.houses import generate as houses_module
from pewm_jax.houses.generate import generate_house
from pewm_jax.types import Camera

SEEDS = range(12)
DIGEST = """
import hashlib, sys
from pewm_jax.data.scenes import house
scene = house(int(sys.argv[1]))
digest = hashlib.sha256()
for array in (scene.vertices_V3, scene.faces_F3, scene.shading_16F, scene.textures.texels_P4):
    digest.update(array.tobytes())
print(digest.hexdigest(), scene.name)
"""


@pytest.fixture(scope="module")
def houses():
    return [generate_house(seed) for seed in SEEDS]


def views(mesh, size: int = 24) -> Camera:
    """Two cameras in the middle of every room."""
    middles = [
        np.array([(x0 + x1) / 2, (y0 + y1) / 2, 1.9]) for x0, y0, x1, y1 in mesh.metadata["rooms"]
    ]
    poses = np.stack([pose_from_yaw(m, a, -0.2) for m in middles for a in (0.4, 3.5)])
    return Camera(np.tile(intrinsics_from_fov(size, size, 90), (len(poses), 1)), poses)


def test_the_seed_decides_every_byte_in_any_process():
    results = []
    for hash_seed in ("1", "2"):
        environment = {**os.environ, "PYTHONHASHSEED": hash_seed}
        command = [sys.executable, "-c", DIGEST, "5"]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        results.append(done.stdout)
    assert results[0] == results[1]
    assert results[0].endswith("house-000005\n")
    other = house(6)
    assert hashlib.sha256(other.vertices_V3.tobytes()).hexdigest() not in results[0]


def test_houses_have_three_to_eight_rooms_that_do_not_overlap(houses):
    counts = {len(mesh.metadata["rooms"]) for mesh in houses}
    assert counts <= set(range(3, 9))
    assert len(counts) >= 4
    for mesh in houses:
        rooms = mesh.metadata["rooms"]
        for i, a in enumerate(rooms):
            assert a[2] - a[0] > 2.4
            assert a[3] - a[1] > 2.4
            for b in rooms[:i]:
                assert a[0] >= b[2] or b[0] >= a[2] or a[1] >= b[3] or b[1] >= a[3]


def test_doorways_join_the_rooms_into_one(houses):
    for mesh in houses:
        reached = {0}
        for _ in mesh.metadata["rooms"]:
            for a, b, *_ in mesh.metadata["doorways"]:
                if {a, b} & reached:
                    reached |= {a, b}
        assert len(reached) == len(mesh.metadata["rooms"])


def test_at_least_twelve_kinds_of_furniture_and_many_in_each_house(houses):
    shell = {"trim", "floor", "ceiling", "window0", "window1", "window2", "window3"}
    shell |= {f"wall{side}" for side in range(4)}
    kinds = [
        {node.split("-")[1] for node in mesh.graph.nodes_geometry if node.startswith("room")}
        - shell
        for mesh in houses
    ]
    wanted = {
        "bed", "sofa", "dining_table", "chair", "wardrobe", "bookshelf", "desk", "plant", "rug",
        "tv_stand", "kitchen_counter", "fridge", "picture", "wall_shelf", "floor_lamp",
    }  # fmt: skip
    assert wanted <= set.union(*kinds)
    assert min(len(found) for found in kinds) >= 8


def test_rooms_are_closed_every_ray_ends_inside(houses):
    for mesh in houses[:5]:
        seen = render(from_trimesh(mesh, "house"), views(mesh), 24, 24)
        assert (seen.ids_THW >= 0).all()
        assert seen.depth_THW.max() < 20


def test_surfaces_face_the_room(houses):
    """Floors look up, ceilings down, walls inward: otherwise baked light would be wrong."""
    for mesh in houses[:4]:
        scene = from_trimesh(mesh, "house")
        for index, (x0, y0, x1, y1) in enumerate(mesh.metadata["rooms"]):
            use = mesh.metadata["uses"][index]
            middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2, 1.25])
            for part in ("floor", "ceiling", "wall0", "wall1", "wall2", "wall3"):
                instance = scene.objects.index(f"room{index}-{use}-{part}")
                faces = scene.object_F == instance
                towards = middle - scene.vertices_V3[scene.faces_F3[faces]].mean(1)
                assert ((towards * scene.normals_F3[faces]).sum(-1) > 0).all(), part


def test_rooms_of_a_house_have_different_walls(houses):
    for mesh in houses:
        scene = from_trimesh(mesh, "house")
        tones = []
        for index, use in enumerate(mesh.metadata["uses"]):
            instances = [scene.objects.index(f"room{index}-{use}-wall{side}") for side in range(4)]
            rows = scene.texture_F[np.isin(scene.object_F, instances)]
            first, size = scene.textures.offset_L[rows[0]], scene.textures.width_L[rows[0]]
            tones.append(scene.textures.texels_P4[first : first + 40 * size, :3].mean(0))
        gaps = np.linalg.norm(np.array(tones)[:, None] - np.array(tones), axis=-1)
        assert gaps[~np.eye(len(tones), dtype=bool)].min() > 8


def test_pictures_show_structure_and_light(houses):
    """Frames are neither black nor flat: many colours, and corners darker than open walls."""
    for mesh in houses[:4]:
        rgb = render(from_trimesh(mesh, "house"), views(mesh), 24, 24).rgb_THWC
        assert 60 < rgb.mean() < 220
        assert min(len(np.unique(frame.reshape(-1, 3), axis=0)) for frame in rgb) > 60


def test_light_is_softer_in_corners_than_in_the_open(houses):
    scene = from_trimesh(houses[0], "house")
    use = houses[0].metadata["uses"][0]
    faces = np.flatnonzero(scene.object_F == scene.objects.index(f"room0-{use}-ceiling"))
    first = scene.vertices_V3[scene.faces_F3[faces, 0], :2]
    x0, y0, x1, y1 = houses[0].metadata["rooms"][0]
    edge = np.minimum(first - [x0, y0], [x1, y1] - first).min(-1)
    light = scene.shading_16F[0, faces]
    assert light[edge < 0.01].mean() < 0.9 * light[edge > 1.0].mean()


def test_a_blocked_room_is_noticed_and_the_house_drawn_again(monkeypatch):
    plan = floorplan.draw_plan(np.random.default_rng(3))
    assert connectivity.all_reachable(plan, [])
    _, _, (x0, y0, x1, y1) = plan.doorways[0]
    plug = (x0 - 0.4, y0 - 0.4, x1 + 0.4, y1 + 0.4)
    assert not connectivity.all_reachable(plan, [plug])
    narrowed = (x0 - 0.1, y0 - 0.1, x1 - 0.5 * (x1 - x0 > 0.5), y1 - 0.5 * (y1 - y0 > 0.5))
    assert not connectivity.all_reachable(plan, [narrowed])
    verdicts = iter([False, True])
    first = generate_house(7)
    monkeypatch.setattr(houses_module, "all_reachable", lambda *_: next(verdicts))
    again = generate_house(7)
    assert next(verdicts, "used up") == "used up"
    assert again.metadata["rooms"] != first.metadata["rooms"]
    assert again.metadata["name"] == "house-000007"
