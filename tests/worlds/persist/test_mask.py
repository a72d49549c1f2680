"""The mask of observed cells: what was observed stays, guesses may change, errors in training."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import presets, worlds
from pewm_jax.config import Config, ConfigError, StageConfig, UserError
from pewm_jax.memory import class_grid
from pewm_jax.models.persist import voxel_dit
from pewm_jax.worlds.persist import corruption, prepare, stages, voxel_frames
from pewm_jax.worlds.persist import state as windows
from pewm_jax.worlds.persist import world as persist
from pewm_jax.worlds.persist.config import PersistTrainConfig
from tests.models.persist.networks import normal, weights
from tests.worlds.persist.test_world import KEY, recorded, seen
from tests.worlds.persist.tiny_persist import MASKED, MODEL

TRAIN = PersistTrainConfig()
imagine = jax.jit(worlds.imagine, static_argnums=0)


@pytest.fixture(scope="module")
def params():
    shapes = jax.eval_shape(lambda: worlds.init(MASKED, KEY))
    rng = np.random.default_rng(0)

    def draw(path, leaf):
        low = 1.0 if jax.tree_util.keystr(path).endswith(("['scale']", "scale_C']")) else 0.0
        return jnp.asarray(low + 0.3 * rng.normal(size=leaf.shape), jnp.float32)

    return jax.tree_util.tree_map_with_path(draw, shapes)


@pytest.fixture(scope="module")
def state(params):
    return jax.jit(worlds.start, static_argnums=0)(MASKED, params, seen())


def test_edited_cells_are_observed_and_pieces_have_no_mask():
    memory = MODEL.memory
    grid = memory.empty(MODEL, jnp.zeros(3))
    assert not np.asarray(class_grid.observed(grid)).any()
    low = np.asarray(grid.low_3)
    box = np.stack([low, low + 1.0]).astype(np.float32)
    placed = class_grid.place(memory, grid, box, 3)
    found = np.asarray(class_grid.observed(placed))
    assert (found == 2).sum() == 8
    assert (found == 0).sum() == found.size - 8
    erased = class_grid.erase(memory, placed, box)
    assert (np.asarray(class_grid.observed(erased)) == 1).sum() == 8
    piece = class_grid.copy(memory, placed, box)
    shift = np.eye(4, dtype=np.float32)
    shift[0, 3] = 2.0
    pasted = class_grid.paste(memory, grid, piece, shift)
    assert (np.asarray(class_grid.observed(pasted)) == 2).sum() == 8
    with pytest.raises(UserError, match="has no mask"):
        class_grid.observed(piece)


def test_guesses_may_change_and_what_was_observed_stays(params):
    latents = jnp.asarray(np.random.default_rng(3).normal(size=(1, 4, 4, 4, 3)), jnp.float32)
    before = jnp.full((8, 8, 8), 3, jnp.int16)
    mask = jnp.zeros((8, 8, 8), jnp.uint8).at[:2].set(class_grid.OBSERVED)
    mask = mask.at[2:4].set(class_grid.SHOWN)
    decode = jax.jit(voxel_frames.decode_classes, static_argnums=0)
    free = dataclasses.replace(MASKED, persistence_logit=0.0)
    made = np.asarray(decode(free, params, latents, before, None, mask))
    assert (made[:2] != 3).any()
    kept = np.asarray(decode(MASKED, params, latents, before, None, mask))
    np.testing.assert_array_equal(kept[:4], 3)  # shown_logit is persistence_logit by default
    np.testing.assert_array_equal(kept[4:], made[4:])
    weak = dataclasses.replace(MASKED, shown_logit=0.0)
    assert weak.kept_logits == (0.0, 0.0, 1e6)
    some = np.asarray(decode(weak, params, latents, before, None, mask))
    np.testing.assert_array_equal(some[:2], 3)
    np.testing.assert_array_equal(some[2:], made[2:])
    # A real image that shows something else changes an observed cell, by the preset's logits too.
    preset = presets.load("persist").model
    logits = {name: getattr(preset, name) for name in ("persistence_logit", "observation_logit")}
    air = voxel_frames.ObservedCells(
        jnp.zeros((8, 8, 8), bool).at[0].set(True), jnp.full((8, 8, 8), -1)
    )
    real = dataclasses.replace(MASKED, **logits)
    changed = np.asarray(decode(real, params, latents, before, air, mask))
    assert not changed[0, :, :6].any()
    np.testing.assert_array_equal(changed[1], 3)
    # Levels that are not predicted keep their cells, and are empty if unknown.
    top = np.asarray(decode(MASKED, params, latents, before.at[..., 7].set(-1), None, mask))
    assert (top[..., 6] == 3).all()
    assert not top[..., 7].any()


def test_decoded_guesses_agree_on_colours_but_kinds_and_what_was_seen_stay():
    colours = 3
    memory = dataclasses.replace(MASKED.memory, colours=colours)
    nets = MASKED.backbone
    count = len(class_grid.names(memory))
    parts = {
        name: dataclasses.replace(getattr(nets, name), classes=count)
        for name in ("voxel_vae", "camera_model", "renderer")
    }
    ids = count + colours + 1
    frames = dataclasses.replace(nets.world_frames, map_ids=ids)
    nets = dataclasses.replace(nets, world_frames=frames, **parts)
    alone = dataclasses.replace(MASKED, memory=memory, backbone=nets)
    shapes = jax.eval_shape(lambda: worlds.init(alone, KEY)["voxel_vae"])
    rng = np.random.default_rng(5)
    drawn = jax.tree.map(lambda x: jnp.asarray(0.5 * rng.normal(size=x.shape), jnp.float32), shapes)
    latents = jnp.asarray(rng.normal(size=(1, 4, 4, 4, 3)), jnp.float32)
    before = jnp.full((8, 8, 8), class_grid.UNKNOWN, jnp.int16).at[0].set(4)
    mask = jnp.zeros((8, 8, 8), jnp.uint8).at[:1].set(class_grid.OBSERVED)
    colour = jnp.full((8, 8, 8), -1).at[1].set(2)
    evidence = voxel_frames.ObservedCells(jnp.zeros((8, 8, 8), bool), colour)
    decode = jax.jit(voxel_frames.decode_classes, static_argnums=0)

    def classes(model):
        found = decode(model, {"voxel_vae": drawn}, latents, before, evidence, mask)
        return np.asarray(found)

    reach = dataclasses.replace(alone, colour_reach_m=1.0)
    one, many = classes(alone), classes(reach)
    np.testing.assert_array_equal(one == 0, many == 0)
    filled = one > 0
    np.testing.assert_array_equal((one[filled] - 1) // colours, (many[filled] - 1) // colours)
    np.testing.assert_array_equal(many[:2], one[:2])
    assert (many != one).any()
    wide = classes(dataclasses.replace(alone, colour_reach_m=8.0))
    for kind in range(9):  # all cells of a kind vote for all others
        of_kind = wide[2:][(wide[2:] - 1) // colours == kind]
        assert len(set(of_kind[of_kind > 0].tolist())) <= 1


@pytest.mark.slow
def test_a_world_forgets_the_door_of_which_a_real_frame_shows_a_part_gone(params):
    door = class_grid.number_of(MASKED.memory, "door")
    frames = seen()
    eye = np.asarray(frames.camera.world_from_camera)[-1, :3, 3]
    moving = dataclasses.replace(MASKED, moving=("door",))
    depth = np.full_like(frames.depth_THW, 3.0)
    far = dataclasses.replace(frames, depth_THW=depth)
    one = jax.tree.map(lambda x: x[-1:], far)
    hidden = []
    for model in (MASKED, moving):
        world = jax.jit(worlds.start, static_argnums=0)(model, params, far)
        everywhere = np.stack([eye - 5, eye + 5]).astype(np.float32)
        world = persist.edit(world, class_grid.place, model.memory, everywhere, door)
        after = jax.jit(worlds.observe, static_argnums=0)(model, params, world, one)
        leaf = np.asarray(world.map.classes_XYZ) == door
        still = np.asarray(class_grid.observed(after.map)) == class_grid.OBSERVED
        hidden.append((leaf & still & (np.asarray(after.map.classes_XYZ) == door)).sum())
    assert hidden[0] - hidden[1] > 0.8 * 8**3  # of the window, in which the doors are connected


@pytest.mark.slow
def test_a_real_frame_completes_anew_what_was_only_guessed(params, monkeypatch):
    """As if it had never been guessed; what was observed or shown is an input."""
    given = []

    def decode_classes(model, params, latents, before, *_):
        given.append(np.asarray(before))
        return before

    before = jnp.full((8, 8, 8), 3, jnp.int16)
    mask = jnp.zeros((8, 8, 8), jnp.uint8).at[:2].set(class_grid.OBSERVED)
    mask = mask.at[2:4].set(class_grid.SHOWN)
    world = jax.jit(worlds.start, static_argnums=0)(MASKED, params, seen())
    history = world.map.history
    monkeypatch.setattr(voxel_frames, "decode_classes", decode_classes)
    none = voxel_frames.ObservedCells(jnp.zeros((8, 8, 8), bool), jnp.full((8, 8, 8), -1))
    for evidence in (none, None):
        voxel_frames.sample(
            MASKED, params, history, history.voxels, jnp.zeros(3), before, KEY, evidence, mask
        )
    real, imagined = given
    assert (real[:4] == 3).all()
    assert (real[4:] == -1).all()
    np.testing.assert_array_equal(imagined, before)


def test_with_a_context_of_one_frames_are_predicted_alone():
    nets = MASKED.backbone.world_frames
    config = dataclasses.replace(nets, blocks=dataclasses.replace(nets.blocks, context=1))
    net = weights(voxel_dit, config)
    latents, times = normal(0, 1, 2, 4, 4, 4, 3), jnp.ones((1, 2))
    told, actions, camera = normal(1, 1, 2, 4, 4, 88), normal(2, 1, 2, 3), normal(3, 1, 2, 10)
    given = jnp.zeros((1, 2, 8, 8, 8), jnp.int32), jnp.ones((1, 2, 8, 8, 8), jnp.int32)

    @jax.jit
    def run(latents):
        return voxel_dit.apply(
            config, net, latents, times, actions, told, camera_BTN=camera, map_BTXYZ=given
        )[0]

    whole = run(latents)
    np.testing.assert_array_equal(run(latents.at[:, 0].set(0.0))[:, 1], whole[:, 1])
    cache = voxel_dit.empty_cache(config, 1, jnp.float32)
    for k in range(2):
        made, cache = voxel_dit.apply(
            config,
            net,
            latents[:, k : k + 1],
            times[:, :1],
            actions[:, k : k + 1],
            told[:, k : k + 1],
            camera_BTN=camera[:, k : k + 1],
            map_BTXYZ=jax.tree.map(lambda x, k=k: x[:, k : k + 1], given),
            cache=cache,
        )
        np.testing.assert_allclose(made[:, 0], whole[:, k], atol=1e-5)


def test_the_map_of_a_real_frame_has_its_evidence():
    before = jnp.full((8, 8, 8), -1, jnp.int16).at[0].set(2).at[1].set(4)
    mask = jnp.zeros((8, 8, 8), jnp.uint8).at[:1].set(class_grid.OBSERVED)
    ids, states = voxel_frames.map_input(MASKED, before, mask, None)
    assert (ids[2:] < 0).all()
    per_layer = [voxel_dit.SEEN, voxel_dit.GUESS, *[voxel_dit.ABSENT] * 6]
    np.testing.assert_array_equal(states[:, 0, 0], per_layer)
    air = jnp.zeros((8, 8, 8), bool).at[2].set(True)
    colour = jnp.full((8, 8, 8), -1).at[0].set(0).at[1].set(0).at[3].set(0)
    ids, states = voxel_frames.map_input(
        MASKED, before, mask, voxel_frames.ObservedCells(air, colour)
    )
    # Layer 0 is known by its class; of layers 1 and 3 only the colour was observed.
    np.testing.assert_array_equal(ids[:, 0, 0], [2, 13, 0, 13, -1, -1, -1, -1])
    np.testing.assert_array_equal(states[:4], voxel_dit.SEEN)
    surfaces = dataclasses.replace(MASKED.memory, pictures="surfaces")
    plain = dataclasses.replace(MASKED, memory=surfaces, observation_logit=0.0)
    assert voxel_frames.coloured_surface(plain, jnp.int32(0)) == 14


def test_the_network_reads_cells_and_mask_and_predicts_its_storey():
    config = MASKED.backbone.world_frames
    net = weights(voxel_dit, config)
    latents, times = normal(0, 1, 2, 4, 4, 4, 3), jnp.ones((1, 2))
    told, actions, camera = normal(1, 1, 2, 4, 4, 88), normal(2, 1, 2, 3), normal(3, 1, 2, 10)
    ids = jnp.zeros((1, 2, 8, 8, 8), jnp.int32)
    mask = jnp.full_like(ids, voxel_dit.GUESS)

    @jax.jit
    def run(ids, mask):
        return voxel_dit.apply(
            config, net, latents, times, actions, told, camera_BTN=camera, map_BTXYZ=(ids, mask)
        )[0]

    made = run(ids, mask)
    assert made.shape == latents.shape
    assert not made[..., 3, :].any()
    assert (jnp.abs(made[..., :3, :]).sum(-1) > 0).all()
    for other in ((ids.at[:, 0, 3].set(5), mask), (ids, mask.at[:, 0, 3].set(voxel_dit.SEEN))):
        assert (run(*other)[:, 0] != made[:, 0]).any()
    above = run(ids.at[..., 7].set(5), mask)
    np.testing.assert_array_equal(above, made)  # a level that is not predicted is not read
    later = run(ids.at[:, 1].set(5), mask)
    np.testing.assert_array_equal(later[:, 0], made[:, 0])
    with pytest.raises(UserError, match="two of"):
        voxel_dit.apply(config, net, latents, times, actions, told, camera_BTN=camera)


@pytest.mark.slow
def test_observed_cells_stay_observed_in_a_rollout_and_guesses_fill_the_window(params, state):
    first = np.asarray(class_grid.observed(state.map))
    assert (first == 1).any()
    assert (first == 2).any()
    unknown = np.asarray(
        windows.window(MASKED, class_grid.observed(state.map), state.map.history.start_3)
    )
    assert (unknown == 0).any()  # one image does not show all of the window
    far = np.repeat(np.array([[0.6, 0, 0.4]], np.float32), 3, 0)
    after, frames = imagine(MASKED, params, state, far, KEY)
    assert np.isfinite(frames.rgb_THWC).all()
    then = np.asarray(class_grid.observed(after.map))
    np.testing.assert_array_equal(then[first > 0], first[first > 0])
    cells = np.asarray(state.map.classes_XYZ)
    np.testing.assert_array_equal(np.asarray(after.map.classes_XYZ)[first > 0], cells[first > 0])
    shown = np.asarray(after.map.mask_XYZ) == class_grid.SHOWN
    assert shown.any()
    assert (np.asarray(after.map.classes_XYZ)[shown] >= 0).all()


@pytest.mark.slow
def test_voxels_are_sampled_where_new_cells_enter(params, state):
    still = np.zeros((2, 3), np.float32)
    after, _ = imagine(MASKED, params, state, still, KEY)
    np.testing.assert_array_equal(after.map.classes_XYZ, state.map.classes_XYZ)
    always = dataclasses.replace(MASKED, sampled="always")
    other, _ = imagine(always, params, state, still, KEY)
    assert (np.asarray(other.map.classes_XYZ) != np.asarray(after.map.classes_XYZ)).any()


@pytest.mark.slow
def test_a_given_grid_is_observed(params):
    frames = seen()
    place = np.asarray(frames.camera.world_from_camera[0, :3, 3])
    origin = (place - [3, 3, 3.25]).astype(np.float32)
    classes = np.random.default_rng(5).integers(0, 13, (12, 12, 12)).astype(np.uint8)
    begun = jax.jit(persist.start_in, static_argnums=0)(MASKED, params, frames, classes, origin)
    found = np.asarray(class_grid.observed(begun.map))
    assert (found > 0).sum() == 12 * 12 * 8  # as high as the world is
    cells = np.asarray(begun.map.classes_XYZ)
    np.testing.assert_array_equal(found[found > 0], np.where(cells[found > 0] > 0, 2, 1))


def test_errors_are_parts_missing_moved_or_doubled():
    rng = np.random.default_rng(0)
    grid = np.where(rng.random((16, 16, 16)) < 0.2, rng.integers(1, 5, (16,) * 3), 0)
    grid[:, :, 12:] = -1
    wrong = np.asarray(
        jax.jit(jax.vmap(corruption.corrupt, (None, 0)))(grid, jax.random.split(KEY, 32))
    )
    np.testing.assert_array_equal(wrong[..., 12:], -1)
    assert set(np.unique(wrong)) <= {-1, 0, 1, 2, 3, 4}
    changed = (wrong != grid)[..., :12].mean((1, 2, 3))
    assert 0.001 < changed.mean() < 0.3
    more = ((wrong > 0).sum((1, 2, 3)) - (grid > 0).sum()).astype(int)
    assert more.min() < 0 < more.max()
    # A window that has moved has the same changes of the same cells.
    changes = corruption.draw_changes(grid, KEY, changes=12)
    same = dataclasses.replace(changes, shift_N3=0 * changes.shift_N3)
    whole = corruption.apply_changes(grid, same, jnp.zeros(3, jnp.int32))
    part = corruption.apply_changes(grid[4:, 2:], same, jnp.array([4, 2, 0]))
    np.testing.assert_array_equal(part, whole[4:, 2:])


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, 4], ids=["world_frames", "renderer"])
def test_a_stage_learns_with_masks_and_errors(params, number):
    stage = worlds.stages(MASKED)[number]
    own = {name: params[name] for name in jax.eval_shape(lambda: stage.init(MASKED, KEY))}
    clip = jax.jit(stage.prepare, static_argnums=0)(MASKED, own, recorded(4))

    @jax.jit
    def slopes(params):
        loss = lambda p: stage.loss(MASKED, TRAIN, p, clip, KEY)  # noqa: E731
        return jax.value_and_grad(loss, has_aux=True)(params)

    (loss, _), found = slopes(own)
    assert np.isfinite(loss)
    trained = found[{"world_frames": "voxel_dit"}.get(stage.name, stage.name)]
    dead = [p for p, x in jax.tree_util.tree_leaves_with_path(trained) if not np.any(x)]
    assert not [p for p in map(jax.tree_util.keystr, dead) if "map" in p or "modulate" in p]


@pytest.fixture(scope="module")
def made():
    """Prepared inputs of two clips, half of whose first layers are seen by frame 0 and 1."""
    rng = np.random.default_rng(1)
    seen = np.full((2, 8, 8, 8), 3, np.uint8)
    seen[:, :2], seen[:, 2:4] = 0, 1
    before = np.zeros((2, 8, 8, 8), np.uint8)
    before[:, 4] = 1 << 5
    return {
        "classes": rng.integers(0, 13, (2, 3, 8, 8, 8)).astype(np.int16),
        "seen": seen,
        "before": before,
        "known": np.ones((2, 3, 4, 4, 4), bool),
    }


def test_a_map_in_training_holds_what_was_observed_and_guesses_or_nothing(made):
    plain = dataclasses.replace(TRAIN, guessed=0.0)
    full = dataclasses.replace(TRAIN, guessed=1.0, entering=0.0)
    open_ = dataclasses.replace(TRAIN, guessed=1.0, entering=1.0)
    keys = jax.random.split(KEY, 16)
    draw = jax.jit(jax.vmap(stages.drawn_map, (None, None, None, 0)), static_argnums=(0, 1))
    ids, states = (np.asarray(x) for x in draw(MASKED, plain, made, keys))
    assert (states[:, :, :, :2] == voxel_dit.SEEN).all()
    assert (states[:, :, 0, 2:4] != voxel_dit.SEEN).all()
    later = (states[:, :, 2, 2:4] == voxel_dit.SEEN).all((2, 3, 4))
    assert 0 < later.mean() < 1  # up to a drawn frame the frames are real
    views = (states[:, :, 0, 4] == voxel_dit.SEEN).all((2, 3))
    assert 0 < views.mean() < 1
    assert (states[:, :, :, 5:] == voxel_dit.ABSENT).all()
    assert (ids[states == voxel_dit.ABSENT] == -1).all()
    known = (states == voxel_dit.SEEN) & (ids < 13)
    frames = made["classes"][None, :, None].astype(int)  # of the last real frame, whichever it is
    assert (ids[:, :, :, None] == frames).any(3)[known].all()
    ids, states = (np.asarray(x) for x in draw(MASKED, full, made, keys))
    assert (states != voxel_dit.ABSENT).all()
    other = dataclasses.replace(full, elsewhere=1.0)
    ids, states = (np.asarray(x) for x in draw(MASKED, other, made, keys))
    guess = (states == voxel_dit.GUESS)[:, :, 0]
    swapped = np.broadcast_to(made["classes"][::-1, 0], guess.shape)
    assert (ids[:, :, 0][guess] == swapped[guess]).mean() > 0.5
    assert (ids[:, :, 0][guess] == swapped[:, ::-1][guess]).mean() < 0.3
    ids, states = (np.asarray(x) for x in draw(MASKED, open_, made, keys))
    share = (states == voxel_dit.ABSENT).mean((2, 3, 4, 5))
    assert ((share > 0.1) & (share < 0.6)).all()


@pytest.mark.slow
def test_the_error_of_new_cells_weighs_more(made):
    """With a silent network the loss is the weighted mean of the squared target."""
    frames = dataclasses.replace(MASKED.backbone.world_frames)
    net = weights(voxel_dit, frames)
    silent = {"voxel_dit": {**net, "proj_out": jax.tree.map(jnp.zeros_like, net["proj_out"])}}
    latents = np.zeros((2, 3, 4, 4, 4, 3), np.float32)
    latents[:, :, 3] = 1.0  # cells 6 and 7, which are never observed
    batch = made | {
        "latents": latents, "told": normal(1, 2, 3, 4, 4, 88), "camera": normal(2, 2, 3, 10),
        "actions": normal(3, 2, 3, 3), "occupied": np.zeros((2, 3, 4, 4, 4), bool),
    }  # fmt: skip
    clip = dataclasses.replace(recorded(2), extras={"prepared": batch})
    error = jax.jit(
        lambda train: stages.world_frames(MASKED, train, silent, clip, KEY)[0], static_argnums=0
    )
    one, ten, alone = (
        float(error(dataclasses.replace(TRAIN, guessed=0.0, new=new))) for new in (1.0, 10.0, 1e6)
    )
    share = one / alone
    assert 0 < share < 0.9
    wrong = dataclasses.replace(TRAIN, guessed=1.0, entering=0.0, elsewhere=1.0, new=1e6)
    assert float(error(wrong)) > float(error(dataclasses.replace(wrong, new=1.0)))
    np.testing.assert_allclose(ten, alone * 10 * share / (1 + 9 * share), rtol=1e-3)


def test_drawn_frames_of_clips_are_predicted_and_no_others(made):
    nets = MASKED.backbone
    frames = dataclasses.replace(
        nets.world_frames, blocks=dataclasses.replace(nets.world_frames.blocks, context=1)
    )
    model = dataclasses.replace(MASKED, backbone=dataclasses.replace(nets, world_frames=frames))
    latents = normal(0, 2, 3, 4, 4, 4, 3).at[:, 2].set(jnp.nan)
    batch = made | {
        "latents": latents, "told": normal(1, 2, 3, 4, 4, 88), "camera": normal(2, 2, 3, 10),
        "actions": normal(3, 2, 3, 3), "occupied": np.zeros((2, 3, 4, 4, 4), bool),
    }  # fmt: skip
    clip = dataclasses.replace(recorded(2), extras={"prepared": batch})
    params = {"voxel_dit": weights(voxel_dit, frames)}
    keys = jax.random.split(KEY, 8)

    def errors(count):
        train = dataclasses.replace(TRAIN, frames_per_clip=count)
        one = jax.jit(lambda key: stages.world_frames(model, train, params, clip, key)[0])
        return np.array([one(key) for key in keys])

    assert np.isnan(errors(0)).all()
    assert np.isnan(errors(3)).all()
    assert 0 < np.isnan(errors(1)).mean() < 1  # the frame without a number is not always drawn
    two = dataclasses.replace(TRAIN, frames_per_clip=2)
    drawn = np.array([stages._drawn_frames(two, (4, 5), key) for key in keys])
    assert drawn.shape == (8, 4, 2)
    assert (np.diff(drawn) > 0).all()
    assert set(np.unique(drawn)) == set(range(5))


@pytest.mark.parametrize("storey", [(0, 0), (1, 3)])
def test_a_column_is_known_if_all_its_predicted_cells_are(storey):
    frames = dataclasses.replace(
        MASKED.backbone.world_frames, storey=storey, patch_z=2 if storey == (1, 3) else 4
    )
    nets = dataclasses.replace(MASKED.backbone, world_frames=frames)
    model = dataclasses.replace(MASKED, backbone=nets)
    cells = np.zeros((8, 8, 8), np.int16)
    cells[2, 5, 4] = -1  # latent (1, 2, 2)
    cells[7, 7, 7] = -1  # latent (3, 3, 3)
    low, high = frames.levels
    wanted = np.zeros((4, 4, 4), bool)
    wanted[..., low:high] = True
    wanted[1, 2] = False
    wanted[3, 3] &= high == 3  # the cell is above the storey
    np.testing.assert_array_equal(windows.known_latents(model, cells), wanted)
    there = np.zeros((4, 4, 4), bool)
    there[..., low:high] = ~wanted[..., low:high]
    np.testing.assert_array_equal(windows.any_in_token(model, cells < 0), there)


def test_settings_that_do_not_fit_are_refused():
    with pytest.raises(ConfigError, match=r"model.colour_reach_m is 0.2: use 0, or 0.5 metres"):
        dataclasses.replace(MASKED, colour_reach_m=0.2)
    with pytest.raises(ConfigError, match=r"model.body_m is -1"):
        dataclasses.replace(MASKED, body_m=-1.0)
    nets = MASKED.backbone
    for part, change, says in (
        ("world_frames", {"map_ids": 13}, "map_ids and map_cells are (13, 2)"),
        ("world_frames", {"storey": (2, 9)}, "voxel_dit.storey is (2, 9)"),
        ("world_frames", {"patch_z": 2}, "voxel_dit.patch_z is 2"),
        ("renderer", {"corrupted": 0.8}, "together at most 1"),
    ):
        with pytest.raises(ConfigError, match=re.escape(says)):
            dataclasses.replace(
                MASKED,
                backbone=dataclasses.replace(
                    nets, **{part: dataclasses.replace(getattr(nets, part), **change)}
                ),
            )
    with pytest.raises(ConfigError, match=r"model\.guess_logit is -2\.0"):
        dataclasses.replace(MASKED, guess_logit=-2.0)
    with pytest.raises(ConfigError, match=r"train\.guessed is 2"):
        Config(model=MASKED, train=PersistTrainConfig(guessed=2.0))
    with pytest.raises(ConfigError, match=r"frames_per_clip is 1 and .*context 3"):
        Config(model=MASKED, train=PersistTrainConfig(frames_per_clip=1))
    with pytest.raises(ConfigError, match=r"train\.frames_per_clip is -1"):
        Config(model=MASKED, train=PersistTrainConfig(frames_per_clip=-1))
    alone = StageConfig(steps=1, batch=4, micro_batches=4)
    with pytest.raises(ConfigError, match=r"cells of another clip .* parts of at least 2 clips"):
        Config(model=MASKED, train=PersistTrainConfig(elsewhere=0.3, world_frames=alone))


def test_views_before_a_clip_are_turned_about_the_vertical():
    pose = jnp.asarray(seen().camera.world_from_camera[0])
    turned = prepare.turn_pose(pose, jnp.float32(np.pi))
    np.testing.assert_allclose(turned[:3, 3], pose[:3, 3])
    np.testing.assert_allclose(turned[:2, :3], -pose[:2, :3], atol=1e-6)
    np.testing.assert_allclose(turned[2], pose[2], atol=1e-6)
