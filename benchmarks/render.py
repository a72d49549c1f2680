"""Frames per second of the renderer on a six-room house, beside trimesh's own ray casting.

Run with ``python benchmarks/render.py``. Every number is the median of several repeats. *Whole*
is colour, depth and instance ids; *cast* is the rays alone. The peer, ``trimesh.ray`` (Embree
through ``intersects_location``), gets the same pixels' depth, ids and one flat colour per face,
which is less than the renderer delivers.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import platform
import statistics
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version

import numpy as np
import trimesh

from pewm_jax.data.navigation import navigable, sample_free
from pewm_jax.data.render import camera_rays, render
from pewm_jax.data.scenes import Scene, from_trimesh, house
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw
from pewm_jax.houses.generate import generate_house
from pewm_jax.types import Camera

FRAMES = {64: 192, 128: 48, 256: 16}
"""Frames per repeat at each image size."""
GOALS = {64: 400, 128: 120}
"""Frames per second asked of two processes."""


def six_room_seed() -> int:
    """Return the first seed whose house has six rooms."""
    return next(s for s in range(1000) if len(generate_house(s).metadata["rooms"]) == 6)


def cameras(scene: Scene, size: int, seed: int) -> Camera:
    """Return cameras at random free places, eye height 1.25 m, 90° wide."""
    rng = np.random.default_rng(seed)
    places = sample_free(navigable(scene), rng, FRAMES[size])
    poses = [pose_from_yaw(np.append(place, 1.25), rng.uniform(0, 2 * np.pi)) for place in places]
    intrinsics = np.tile(intrinsics_from_fov(size, size, 90), (len(poses), 1))
    return Camera(intrinsics, np.stack(poses))


def cast_only(scene: Scene, camera: Camera, size: int) -> None:
    """Cast the rays that `render` casts and drop the hits."""
    pose, intrinsics = np.float64(camera.world_from_camera), np.float64(camera.intrinsics_4)
    for k in range(len(pose)):
        part = slice(k, k + 1)
        origins, directions = camera_rays(scene, pose[part], intrinsics[part], size, size)
        scene.tracer.run(origins, directions, output=1)


def peer(mesh: trimesh.Trimesh, scene: Scene, camera: Camera, size: int) -> None:
    """Render depth, ids and flat colours through trimesh's ray interface."""
    pose, intrinsics = np.float64(camera.world_from_camera), np.float64(camera.intrinsics_4)
    colour = scene.shading_16F[:3].T * 255
    for k in range(len(pose)):
        part = slice(k, k + 1)
        origins, directions = camera_rays(scene, pose[part], intrinsics[part], size, size)
        origins = origins + scene.centre_3
        place, ray, face = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
        rgb = np.zeros((size * size, 3), np.uint8)
        depth, ids = np.zeros(size * size, np.float32), np.full(size * size, -1, np.int32)
        rgb[ray] = np.minimum(colour[face], 255)
        depth[ray] = (place - pose[k, :3, 3]) @ pose[k, :3, 2]
        ids[ray] = scene.object_F[face]


def repeat(job: Callable[[], object], repeats: int) -> list[float]:
    """Return the seconds of each repeat, after one that is not counted."""
    job()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        job()
        seconds.append(time.perf_counter() - start)
    return seconds


def worker(seed: int, size: int, what: str, repeats: int, *, gate, results) -> None:
    """Repeat one job in a process of its own; all processes start each repeat together."""
    scene = house(seed)
    camera = cameras(scene, size, os.getpid())
    for index in range(repeats + 1):
        gate.wait()
        start = time.perf_counter()
        if what == "whole":
            render(scene, camera, size, size)
        else:
            cast_only(scene, camera, size)
        results.put((index, time.perf_counter() - start))


def on_processes(count: int, seed: int, size: int, what: str, repeats: int) -> float:
    """Return frames/s of that many processes together: the median over the repeats."""
    context = multiprocessing.get_context("spawn")
    gate, results = context.Barrier(count), context.Queue()
    processes = [
        context.Process(
            target=worker,
            args=(seed, size, what, repeats),
            kwargs={"gate": gate, "results": results},
        )
        for _ in range(count)
    ]
    for process in processes:
        process.start()
    found = [results.get() for _ in range(count * (repeats + 1))]
    for process in processes:
        process.join()
    slowest = [max(t for index, t in found if index == k) for k in range(1, repeats + 1)]
    return count * FRAMES[size] / statistics.median(slowest)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=7, help="repeats per number (at least 5)")
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128], choices=FRAMES)
    options = parser.parse_args()
    repeats = max(5, options.repeats)
    seed = six_room_seed()
    mesh = generate_house(seed)
    build = repeat(partial(generate_house, seed), repeats)
    bake = repeat(partial(from_trimesh, mesh, "house"), repeats)
    scene = house(seed)
    grid = repeat(partial(navigable, scene), repeats)
    whole = trimesh.Trimesh(scene.vertices_V3, scene.faces_F3, process=False)
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, ", end="")
    print(", ".join(f"{name} {version(name)}" for name in ("embreex", "trimesh", "numpy")))
    print(f"house {seed}: 6 rooms, {len(scene.faces_F3)} triangles, {len(scene.objects)} objects")
    for name, seconds in (("generate", build), ("bake light", bake), ("navigation grid", grid)):
        print(f"{name}: {statistics.median(seconds) * 1e3:.0f} ms")
    for size in options.sizes:
        for what in ("whole", "cast"):
            one, two = (on_processes(n, seed, size, what, repeats) for n in (1, 2))
            goal = f" (goal {GOALS[size]})" if what == "whole" and size in GOALS else ""
            print(f"{size}x{size} {what}: {one:.0f} frames/s on 1 process, {two:.0f} on 2{goal}")
        camera = cameras(scene, size, 0)
        few = Camera(camera.intrinsics_4[:8], camera.world_from_camera[:8])
        theirs = statistics.median(repeat(partial(peer, whole, scene, few, size), repeats)) / 8
        ours = statistics.median(repeat(partial(render, scene, few, size, size), repeats)) / 8
        print(
            f"{size}x{size} trimesh.ray on 1 process: {1 / theirs:.0f} frames/s; "
            f"the renderer is {theirs / ours:.1f} times as fast"
        )


if __name__ == "__main__":
    main()
