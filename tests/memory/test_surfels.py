"""Surfels: what is kept of a cell, what is counted, and how well what was seen is shown again."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import ConfigError
from pewm_jax.data.episodes import read_episode
from pewm_jax.data.make_episode import CollectConfig, make_episode
from pewm_jax.encoders.simple import PatchColoursConfig
from pewm_jax.eval.metrics.images import seen_masks
from pewm_jax.memory import interface as memories
from pewm_jax.memory import rendering, surfels
from pewm_jax.memory import rendering as views
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.types import Frames
from tests.helpers import TINY, random_camera, tiny_model
from tests.memory.test_memories import encoded, scene
from tests.properties import examples

SMALL = SurfelConfig(cell_m=(0.5,) * 3, cells=(8, 8, 8), capacity=64, tokens=8)
insert = jax.jit(surfels.insert, static_argnums=(0, 3))


def of(config, **changes):
    """The tiny model with surfels."""
    return tiny_model(memory=dataclasses.replace(config, **changes))


def blank(config):
    return config.empty(of(config), np.zeros(3))


def drawn(seed, count=200, spread=1.9, frames=3):
    """Points at random, some of them invalid; colours and normals from −1 to 1."""
    rng = np.random.default_rng(seed)
    return surfels.Points(
        rng.uniform(-spread, spread, (count, 3)).astype(np.float32),
        rng.uniform(-1, 1, (count, 6)).astype(np.float32),
        rng.uniform(0.01, 0.2, count).astype(np.float32),
        np.sort(rng.integers(0, frames, count)).astype(np.int32),
        rng.random(count) < 0.9,
    )


def by_loop(config, batches):
    """Cell → (points, colours, sizes, observed), batch after batch: ``(new, observed)``."""
    held = {}
    for new, observed in batches:
        place = np.floor(new.points_P3 / np.float32(0.5)).astype(int)
        shown = {}
        for p in np.flatnonzero(new.valid_P):
            cell = tuple(place[p])
            if observed or not config.protect or not (cell in held and held[cell][3]):
                shown.setdefault(cell, []).append(p)
        for cell, every in shown.items():
            members = every
            if config.keep == "newest":
                newest = max(new.time_P[p] for p in members)
                members = [p for p in members if new.time_P[p] == newest]
            rows = [new.points_P3[members], new.values_PC[members], new.size_P[members]]
            mixed = False
            if config.keep == "mean" and cell in held and (held[cell][3] or not observed):
                rows = [np.concatenate(x) for x in zip(held[cell], rows, strict=False)]
                mixed = held[cell][3]
            held[cell] = (*rows, observed or mixed)
    return held


def compare(config, memory, held):
    points, colours, sides, _, valid = (np.asarray(x) for x in surfels.means(config, memory))
    assert int(memory.occupied) == valid.sum() == len(held)
    place = [tuple(x) for x in np.floor(points[valid] / 0.5).astype(int)]
    assert set(place) == set(held)
    for slot, cell in enumerate(place):
        where, colour, size, observed = held[cell]
        np.testing.assert_allclose(points[slot], where.mean(0), atol=1e-5)
        np.testing.assert_allclose(colours[slot], colour.mean(0)[:3], atol=1e-5)
        np.testing.assert_allclose(sides[slot], colour.mean(0)[3:], atol=1e-5)
        assert memory.size_V[slot] == size.min()
        assert memory.observed_V[slot] == observed
    for rest in (points, colours, sides, memory.size_V, memory.observed_V):
        assert not np.asarray(rest)[~valid].any()


@pytest.mark.slow
@examples(15)
@given(
    seed=st.integers(0, 100_000), keep=st.sampled_from(["mean", "newest"]), protect=st.booleans()
)
def test_a_cell_keeps_what_a_plain_loop_keeps(seed, keep, protect):
    """Also whether it was observed: with ``protect`` False, until imagined points replace it."""
    config = dataclasses.replace(SMALL, capacity=512, keep=keep, protect=protect)
    rng = np.random.default_rng(seed)
    batches = [(drawn(seed + k), bool(rng.random() < 0.5)) for k in range(3)]
    memory = blank(config)
    for new, observed in batches:
        memory = insert(config, memory, new, observed)
    compare(config, memory, by_loop(config, batches))
    assert int(memory.dropped) == int(memory.outside) == 0


@pytest.mark.parametrize("keep", ["mean", "newest"])
def test_the_order_of_points_does_not_matter_and_equal_points_make_equal_memories(keep):
    config = dataclasses.replace(SMALL, capacity=512, keep=keep)
    new = drawn(1, 400)
    order = np.random.default_rng(2).permutation(400)
    first = insert(config, blank(config), new, True)
    again = insert(config, blank(config), new, True)
    mixed = insert(config, blank(config), jax.tree.map(lambda x: x[order], new), True)
    for a, b, c in zip(*map(jax.tree.leaves, (first, again, mixed)), strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_allclose(a, c, atol=1e-5)


def test_the_mean_does_not_depend_on_the_order_of_frames_and_the_newest_is_the_last():
    early, late = drawn(3), drawn(4)
    for keep, alike in (("mean", True), ("newest", False)):
        config = dataclasses.replace(SMALL, capacity=512, keep=keep)
        one, other = blank(config), blank(config)
        for new in (early, late):
            one = insert(config, one, new, True)
        for new in (late, early):
            other = insert(config, other, new, True)
        np.testing.assert_array_equal(one.cell_V, other.cell_V)
        assert np.allclose(one.sums_VC, other.sums_VC, atol=1e-5) == alike


@pytest.mark.parametrize("observed", [True, False])
def test_losses_are_counted_and_what_is_there_stays(observed):
    full = insert(SMALL, blank(SMALL), drawn(5, 60, 0.9), observed)
    before = int(full.occupied)
    new = drawn(6, 500, 2.6)
    after = insert(SMALL, full, new, True)
    place = np.floor(new.points_P3[new.valid_P] / np.float32(0.5)).astype(int)
    inside = ((place >= -4) & (place < 4)).all(1)
    assert int(after.outside) == (~inside).sum() > 0
    held = {tuple(x) for x in np.asarray(np.floor(drawn(5, 60, 0.9).points_P3 / 0.5)).astype(int)}
    distinct = {tuple(x) for x in place[inside]}
    assert int(after.occupied) == SMALL.capacity
    assert before < SMALL.capacity
    lost = len(distinct - held) - (SMALL.capacity - before)
    assert abs(int(after.dropped) - lost) <= len(held) - before  # held has invalid points too
    assert set(np.asarray(full.cell_V[:before])) <= set(np.asarray(after.cell_V))


def test_what_was_imagined_gives_way_to_what_is_observed_and_never_the_other_way():
    config = dataclasses.replace(SMALL, capacity=512)
    seen, dreamt = drawn(7), drawn(8)
    observed = insert(config, blank(config), seen, True)
    held = np.asarray(observed.cell_V[: int(observed.occupied)])
    both = insert(config, observed, dreamt, False)
    slots = np.searchsorted(np.asarray(both.cell_V), held)
    np.testing.assert_array_equal(both.sums_VC[slots], observed.sums_VC[: len(held)])
    assert np.asarray(both.observed_V).sum() == len(held) < int(both.occupied)
    back = insert(config, insert(config, blank(config), dreamt, False), seen, True)
    slots = np.searchsorted(np.asarray(back.cell_V), held)
    np.testing.assert_array_equal(back.sums_VC[slots], observed.sums_VC[: len(held)])


def test_a_memory_is_told_what_is_imagined_where_it_asks():
    frames = jax.tree.map(jnp.asarray, scene())
    for config, told in ((SMALL, True), (TINY.memory, False)):
        easy = {"imagined_far": 99.0, "imagined_edge": 0.0}
        config = dataclasses.replace(config, cells=(24, 24, 24), capacity=2048, **easy)  # noqa: PLW2901
        model = tiny_model(memory=config)
        memory = model.memory.empty(model, jnp.zeros(3))
        made = [
            jax.jit(functools.partial(memories.insert, model, observed=truth))(
                {}, memory, frames, encoded(frames)
            )
            for truth in (True, False)
        ]
        alike = [np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, made), strict=True)]
        assert all(alike) != told


@pytest.mark.slow
def test_features_are_those_of_the_patch_a_pixel_lies_in():
    model = of(SMALL, cells=(24, 24, 24), capacity=4096, features=True, cell_m=(0.05,) * 3)
    model = of(model.memory, cells=(512, 512, 512))
    assert model.memory.KEEPS_FEATURES
    assert not SMALL.KEEPS_FEATURES
    frames = scene(count=1)
    patches = encoded(frames)
    memory = memories.insert(model, {}, model.memory.empty(model, jnp.zeros(3)), frames, patches)
    _, features, valid = model.memory.to_points(model, memory)
    assert features.shape[1] == model.memory.encoder.channels
    rows = {tuple(x) for x in np.asarray(patches).reshape(-1, patches.shape[-1])}
    single = np.asarray(valid & (memory.sums_VC[:, 0] == 1))
    assert single.sum() > 100
    assert {tuple(x) for x in np.asarray(features)[single]} <= rows
    assert np.asarray(model.memory.read(model, memory, frames.camera).valid_M).all()


def test_wrong_settings_are_refused_in_a_sentence():
    with pytest.raises(ConfigError, match="footprint"):
        dataclasses.replace(SMALL, footprint=0)
    with pytest.raises(ConfigError, match="mean or newest"):
        dataclasses.replace(SMALL, keep="oldest")
    model = of(SMALL, features=True)
    memory = model.memory.empty(model, jnp.zeros(3))
    with pytest.raises(ValueError, match="no features"):
        model.memory.insert(model, {}, memory, scene())


@pytest.mark.slow
@pytest.mark.parametrize("footprint", [1, 3])
def test_what_was_seen_is_seen_again_by_the_camera_that_saw_it(footprint):
    model = of(SMALL, cell_m=(0.02,) * 3, cells=(1024,) * 3, capacity=1024, footprint=footprint)
    rng = np.random.default_rng(0)
    camera = jax.tree.map(jnp.asarray, random_camera(rng, 1, upright=True))
    depth = np.full((1, 16, 24), 2.0, np.float32)
    rgb = rng.uniform(-1, 1, (1, 16, 24, 3)).astype(np.float32)
    memory = model.memory.empty(model, camera.world_from_camera[0, :3, 3])
    memory = model.memory.insert(model, {}, memory, Frames(rgb, depth, camera))
    view = model.memory.render_colours(memory, camera, 16, 24)
    assert np.asarray(view.seen_THW).all()
    np.testing.assert_allclose(view.features_THWF, rgb, atol=0.01)
    np.testing.assert_allclose(view.depth_THW, depth, atol=0.01)
    whole = memories.render(model, memory, camera, 16, 24)
    np.testing.assert_array_equal(whole.features_THWF[..., :3], view.features_THWF)


@functools.lru_cache(maxsize=1)
def walk():
    """A way out through a generated house and some frames of the way back, at 64 × 64."""
    settings_ = CollectConfig(Path("unused"), frames=48, size=64, seed=3)
    episode = read_episode(make_episode(settings_, "revisit", 0))
    turn = int(episode.info["return_frame"])
    context = as_signal(episode.frames(list(range(0, turn, 2))))
    target = as_signal(episode.frames(list(range(turn + 3, turn + 12, 3))))
    return tuple(jax.tree.map(jnp.asarray, x) for x in (context, target))


def decibels(image, truth, mask):
    off = (np.clip(image, -1, 1) - truth)[mask] / 2
    return -10 * np.log10((off**2).mean())


@pytest.mark.slow
def test_surfels_show_a_house_better_than_the_voxel_map():
    context, target = walk()
    seen = np.asarray(seen_masks(target, context)[0])
    truth = np.asarray(target.rgb_THWC)
    assert seen.mean() > 0.3
    valid = jnp.ones(len(context.depth_THW), bool)
    # One patch per pixel would be surfels; a patch of 8 pixels is what the voxel map gets.
    encoder = PatchColoursConfig()
    small = VoxelConfig(cell_m=(0.25,) * 3, encoder=encoder)
    fine = SurfelConfig(encoder=encoder)
    reached, shown = {}, {}
    for name, config in (("voxel", small), ("surfels", fine)):
        model = tiny_model(memory=config)
        memory = jax.jit(memories.from_context, static_argnums=0)(model, {}, context, valid)
        assert int(memory.dropped) == 0
        assert int(memory.outside) == 0
        if name == "surfels":
            view = model.memory.render_colours(memory, target.camera, 64, 64)
            colours, readout = view.features_THWF, view.seen_THW
        else:
            view = memories.render(model, memory, target.camera, 64, 64)
            flat = model.point_colours(view.features_THWF.reshape(-1, encoder.channels))
            colours, readout = flat.reshape(truth.shape), view.seen_THW
        filled = views.fill_nearest(rendering.View(colours, view.depth_THW, readout))
        reached[name] = decibels(filled.features_THWF, truth, seen)
        shown[name] = np.asarray(readout)[seen].mean()
        assert (np.asarray(filled.depth_THW) > 0).all()
    assert reached["surfels"] > reached["voxel"] + 2, reached
    assert shown["surfels"] > 0.95, shown
