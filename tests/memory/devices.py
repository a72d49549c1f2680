"""Run on four simulated devices by ``test_devices``; prints what it measured as JSON."""

import json
import os

os.environ["XLA_FLAGS"] = " ".join(
    (os.environ.get("XLA_FLAGS", ""), "--xla_force_host_platform_device_count=4")
)

import jax
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from pewm_jax.memory import voxel_map
from pewm_jax.memory.voxel_map import VoxelConfig
from tests.helpers import random_frames

CONFIG = VoxelConfig(cell_m=(0.5, 0.5, 0.5), cells=(24, 24, 8), capacity=300, tokens=8)
BATCH = 8


def remember(frames, patches):
    voxels = voxel_map.empty(CONFIG, np.zeros(3), 6)
    return voxel_map.insert_frames(CONFIG, voxels, frames, patches)


def main() -> None:
    rng = np.random.default_rng(0)
    clips = [random_frames(rng, 2) for _ in range(BATCH)]
    frames = jax.tree.map(lambda *x: np.stack(x), *clips)
    patches = rng.normal(size=(BATCH, 2, 4, 6, 6)).astype(np.float32)
    mesh = jax.make_mesh((4,), ("batch",), axis_types=(AxisType.Auto,))
    split = NamedSharding(mesh, PartitionSpec("batch"))
    compiled = jax.jit(jax.vmap(remember), in_shardings=split, out_shardings=split)
    compiled = compiled.lower(frames, patches).compile()
    maps = compiled(*jax.device_put((frames, patches), split))
    text = compiled.as_text()
    alone = jax.jit(remember)
    equal = [jax.tree.map(lambda x, i=i: np.asarray(x[i]), maps) for i in range(BATCH)]
    singles = [alone(clips[i], patches[i]) for i in range(BATCH)]
    same = [
        jax.tree.all(jax.tree.map(lambda x, y: np.allclose(x, y, rtol=1e-6), a, b))
        for a, b in zip(equal, singles, strict=True)
    ]
    places = {
        name: sorted({shard.data.shape[0] for shard in getattr(maps, name).addressable_shards})
        for name in ("cell_of_slot_V", "features_VF", "occupied")
    }
    moved = [word for word in ("all-gather", "all-to-all", "collective-permute") if word in text]
    print(json.dumps({"same": same, "places": places, "moved": moved}))


if __name__ == "__main__":
    main()
