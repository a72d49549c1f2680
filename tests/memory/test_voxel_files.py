import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from pewm_jax.config import UserError
from pewm_jax.io import weights
from pewm_jax.memory import voxel_map
from pewm_jax.memory.voxel_map import VoxelConfig

CONFIG = VoxelConfig(cell_m=(0.25, 0.25, 0.5), cells=(24, 24, 8), capacity=60, tokens=4)


def a_map(channels=6, dtype=jnp.float32, count=80):
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 3.5, (count, 3)).astype(np.float32)
    values = rng.uniform(-1, 1, (count, channels)).astype(np.float32)
    voxels = voxel_map.empty(CONFIG, np.zeros(3), channels, dtype)
    insert = jax.jit(voxel_map.insert, static_argnums=0)
    return insert(CONFIG, voxels, points, values, np.ones(count, bool))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_a_map_comes_back_bit_for_bit(tmp_path, dtype):
    voxels = a_map(dtype=dtype)
    assert int(voxels.outside) > 0
    voxel_map.save(CONFIG, voxels, tmp_path / "map.safetensors")
    again = voxel_map.load(CONFIG, tmp_path / "map.safetensors")
    assert jax.tree.map(lambda x: x.dtype, again) == jax.tree.map(lambda x: x.dtype, voxels)
    jax.tree.map(np.testing.assert_array_equal, again, voxels)
    larger = voxel_map.load(dataclasses.replace(CONFIG, capacity=99), tmp_path / "map.safetensors")
    assert larger.cell_of_slot_V.shape == (99,)
    assert int(larger.occupied) == int(voxels.occupied)
    assert [p.name for p in tmp_path.iterdir()] == ["map.safetensors"]


def test_a_file_that_does_not_fit_is_refused(tmp_path):
    path = tmp_path / "map.safetensors"
    with pytest.raises(UserError, match="does not exist"):
        voxel_map.load(CONFIG, path)
    voxel_map.save(CONFIG, a_map(), path)
    for change, sentence in (
        ({"cell_m": (0.25, 0.25, 1.0)}, "memory.cell_m"),
        ({"cells": (24, 24, 9)}, "memory.cells"),
        ({"capacity": 10, "tokens": 4}, "raise the capacity"),
    ):
        with pytest.raises(UserError, match=sentence):
            voxel_map.load(dataclasses.replace(CONFIG, **change), path)
    whole = path.read_bytes()
    path.write_bytes(whole[:-7])
    with pytest.raises(UserError, match="damaged"):
        voxel_map.load(CONFIG, path)
    path.write_bytes(whole.replace(b"voxel map 1", b"voxel map 7"))
    with pytest.raises(UserError, match="damaged"):
        voxel_map.load(CONFIG, path)
    weights.save(path, {"cells": np.zeros(3)}, {"format": "voxel map 7"})
    with pytest.raises(UserError, match="not a voxel map"):
        voxel_map.load(CONFIG, path)
    with pytest.raises(UserError, match="one map"):
        voxel_map.save(CONFIG, jax.tree.map(lambda x: x[None], a_map()), path)


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_an_exported_map_stands_where_the_map_stands(tmp_path, suffix):
    voxels = a_map()
    points, values, valid = (np.asarray(x) for x in voxel_map.to_points(CONFIG, voxels))
    points, values = points[valid], values[valid]
    shades = np.clip(((values[:, :3] - values[:, 3:]) / 2 + 1) * 127.5, 0, 255)
    upright = points if suffix == ".ply" else points[:, [0, 2, 1]] * (1, 1, -1)
    voxel_map.export(CONFIG, voxels, tmp_path / f"points{suffix}", style="points")
    cloud = trimesh.load_scene(tmp_path / f"points{suffix}").dump()[0]
    np.testing.assert_allclose(cloud.vertices, upright, atol=1e-5)
    np.testing.assert_allclose(np.asarray(cloud.colors)[:, :3], shades, atol=1)

    voxel_map.export(CONFIG, voxels, tmp_path / f"cubes{suffix}")
    mesh = trimesh.load_scene(tmp_path / f"cubes{suffix}", process=False).dump()[0]
    assert len(mesh.faces) == 12 * len(points)
    size = np.prod(CONFIG.cell_m) * 0.9**3
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.volume, size * len(points), rtol=1e-4)
    middles = mesh.vertices.reshape(-1, 8, 3).mean(1)
    np.testing.assert_allclose(middles, upright, atol=1e-5)
    colours = np.asarray(mesh.visual.vertex_colors)[::8, :3]
    np.testing.assert_allclose(colours, shades, atol=1)


def test_other_features_and_given_colours_are_drawn_too(tmp_path):
    voxels = a_map(channels=10)
    voxel_map.export(CONFIG, voxels, tmp_path / "a.ply", style="points")
    colours = np.full((CONFIG.capacity, 3), 1.0)
    voxel_map.export(CONFIG, voxels, tmp_path / "b.ply", style="points", colours_V3=colours)
    drawn = [trimesh.load_scene(tmp_path / f"{name}.ply").dump()[0].colors for name in "ab"]
    assert len(np.unique(drawn[0], axis=0)) > 10
    assert (np.asarray(drawn[1]) == 255).all()


def test_an_unknown_format_and_an_empty_map_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"\.ply"):
        voxel_map.export(CONFIG, a_map(), tmp_path / "map.obj")
    blank = voxel_map.empty(CONFIG, np.zeros(3), 6)
    with pytest.raises(UserError, match="empty"):
        voxel_map.export(CONFIG, blank, tmp_path / "map.ply")
    assert not list(tmp_path.iterdir())
