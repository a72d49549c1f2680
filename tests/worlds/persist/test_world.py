"""The world of PERSIST: voxels that evolve, edits that stay, frames that know nothing of later."""

import dataclasses
import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import config as configuration
from pewm_jax import presets, worlds
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import Config, ConfigError, UserError
from pewm_jax.geometry import actions as action_geometry
from pewm_jax.geometry.actions import camera_numbers
from pewm_jax.memory import class_grid
from pewm_jax.memory import interface as memories
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.models.persist import blocks as frame_blocks
from pewm_jax.models.persist import voxel_dit, voxel_vae
from pewm_jax.planning import imagined_env
from pewm_jax.types import Camera, Clip, Control, Frames
from pewm_jax.worlds.persist import prepare as persist_prepare
from pewm_jax.worlds.persist import state as windows
from pewm_jax.worlds.persist import step as persist_pictures
from pewm_jax.worlds.persist import voxel_frames as persist_voxels
from pewm_jax.worlds.persist import world as persist
from pewm_jax.worlds.persist.config import PersistTrainConfig
from pewm_jax.worlds.persist.state import encode_picture
from tests.helpers import random_frames
from tests.worlds.persist.tiny_persist import MODEL, NOISE

CONFIG = Config(model=MODEL, train=PersistTrainConfig())
KEY = jax.random.key(1)
MOVES = np.array([[0.4, 0, 0], [0.4, 0, 0.3], [0.2, 0.1, -0.3]], np.float32)
imagine = jax.jit(worlds.imagine, static_argnums=0, static_argnames=("remember", "memory"))
begin = jax.jit(worlds.start, static_argnums=0)


def equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def seen(count=1, seed=0):
    frames = random_frames(np.random.default_rng(seed), count, 16, 16)
    return jax.tree.map(jnp.asarray, frames)


@pytest.fixture(scope="module")
def params():
    shapes = jax.eval_shape(lambda: worlds.init(MODEL, KEY))
    rng = np.random.default_rng(0)

    def draw(path, leaf):
        low = 1.0 if jax.tree_util.keystr(path).endswith(("['scale']", "scale_C']")) else 0.0
        return jnp.asarray(low + 0.2 * rng.normal(size=leaf.shape), jnp.float32)

    return jax.tree_util.tree_map_with_path(draw, shapes)


@pytest.fixture(scope="module")
def state(params):
    return begin(MODEL, params, seen())


@pytest.fixture(scope="module")
def walked(params, state):
    return imagine(MODEL, params, state, MOVES, KEY)


@pytest.mark.slow
def test_one_image_begins_a_world_whose_window_is_known(state):
    start = state.map.history.start_3
    inside = windows.window(MODEL, state.map.classes_XYZ, start)
    assert (inside >= 0).all()
    assert (state.map.classes_XYZ >= 0).sum() == inside.size
    camera = state.frame.camera.world_from_camera[0, :3, 3]
    off = windows.middle(MODEL, state.map.low_3, start) - camera
    assert np.abs(off[:2]).max() <= 0.5 * MODEL.backbone.token_cells + 0.5
    floor = (camera[2] - MODEL.memory.eye_m - state.map.low_3[2]) / 0.5
    np.testing.assert_allclose(floor, np.round(floor), atol=1e-4)


@pytest.mark.slow
def test_imagined_twice_is_the_same_and_its_caches_have_grown(params, state, walked):
    equal(imagine(MODEL, params, state, MOVES, KEY), walked)
    after, frames = walked
    assert frames.rgb_THWC.shape == (3, 16, 16, 3)
    assert np.isfinite(frames.depth_THW).all()
    equal(after.frame, jax.tree.map(lambda x: x[-1:], frames))
    assert int(after.map.history.voxels.count) == 3
    assert int(after.map.history.pictures.count) == 4


@pytest.mark.slow
def test_no_frame_depends_on_later_actions(params, state):
    @jax.jit
    def slope(moves):
        def total(moves):
            frames = worlds.imagine(MODEL, params, state, moves, KEY)[1]
            return (frames.rgb_THWC[:2] ** 2).sum() + (
                frames.camera.world_from_camera[:2] ** 2
            ).sum()

        return jax.grad(total)(moves)

    found = np.abs(slope(jnp.asarray(MOVES))).sum(-1)
    assert (found[:2] > 0).all()
    assert found[2] == 0
    other = MOVES.copy()
    other[2] = [0.1, -0.2, 0.5]
    one, two = (imagine(MODEL, params, state, m, KEY)[1] for m in (MOVES, other))
    equal(one.rgb_THWC[:2], two.rgb_THWC[:2])
    assert np.any(one.rgb_THWC[2] != two.rgb_THWC[2])


@pytest.mark.slow
def test_the_camera_model_steers(params, state, walked):
    poses = action_geometry.integrate(state.frame.camera.world_from_camera[0], MOVES)[1:]
    made = walked[1].camera.world_from_camera
    assert not np.allclose(made, poses, atol=1e-3)
    silent = {**params, "camera_model": jax.tree.map(jnp.zeros_like, params["camera_model"])}
    _, straight = imagine(MODEL, silent, state, MOVES, KEY)
    np.testing.assert_allclose(straight.camera.world_from_camera, poses, atol=1e-5)


def test_a_cell_changes_only_where_another_class_is_likelier_by_what_is_held(params):
    latents = jnp.asarray(np.random.default_rng(3).normal(size=(1, 4, 4, 4, 3)), jnp.float32)
    nothing = jnp.full((8, 8, 8), -1, jnp.int16)
    free, firm = (dataclasses.replace(MODEL, persistence_logit=hold) for hold in (0.0, 0.5))
    held = jax.jit(persist_voxels.decode_classes, static_argnums=0)
    made = held(free, params, latents, nothing)
    np.testing.assert_array_equal(held(firm, params, latents, nothing), made)
    before = jnp.full((8, 8, 8), 3, jnp.int16)
    kept = held(firm, params, latents, before)
    assert ((kept == made) | (kept == 3)).all()
    assert (kept == 3).sum() > (made == 3).sum()
    np.testing.assert_array_equal(held(MODEL, params, latents, before), before)


def test_a_cell_of_which_nothing_was_known_has_air_unless_a_class_is_likelier_by_a_margin(params):
    latents = jax.random.normal(KEY, (1, 4, 4, 4, 3))
    unknown = jnp.full((8, 8, 8), class_grid.UNKNOWN).at[:4].set(3)
    models = [
        dataclasses.replace(MODEL, persistence_logit=0.0, empty_prior=nats)
        for nats in (0.0, 0.5, 1e6)
    ]
    free, doubtful, sure = (
        np.asarray(persist_voxels.decode_classes(model, params, latents, unknown))
        for model in models
    )
    np.testing.assert_array_equal(doubtful[:4], free[:4])  # what was known is not doubted
    assert ((doubtful == free) | (doubtful == 0)).all()
    assert (sure[4:] == 0).all()
    assert (free[4:] == 0).sum() < (doubtful[4:] == 0).sum() < sure[4:].size


def test_an_edit_is_the_world_that_goes_on(params, state):
    here = np.asarray(state.frame.camera.world_from_camera[0, :3, 3])
    reach = np.array([1, 1, 0.6], np.float32)
    box = np.stack([here - reach, here + reach])
    edited = persist.edit(state, class_grid.place, MODEL.memory, box, 5)
    inside = np.asarray(edited.map.classes_XYZ) == 5
    assert inside.sum() >= 16
    after, frames = imagine(MODEL, params, edited, MOVES, KEY)
    np.testing.assert_array_equal((np.asarray(after.map.classes_XYZ) == 5)[inside], True)
    _, without = imagine(MODEL, params, state, MOVES, KEY)
    assert np.abs(frames.rgb_THWC - without.rgb_THWC).max() > 1e-4
    gone = persist.edit(after, class_grid.erase, MODEL.memory, box)
    assert not (np.asarray(gone.map.classes_XYZ)[inside]).any()


@pytest.mark.slow
def test_the_next_voxels_depend_on_what_was_edited_elsewhere(params, state):
    free = dataclasses.replace(MODEL, persistence_logit=0.0)
    low = np.asarray(state.map.low_3) + 0.5 * np.asarray(state.map.history.start_3)
    box = np.stack([low, low + np.array([2.0, 4.0, 4.0])]).astype(np.float32)  # half of the window
    edited = persist.edit(state, class_grid.place, MODEL.memory, box, 5)
    loud = {**params, "voxel_dit": jax.tree.map(lambda x: 8 * x, params["voxel_dit"])}
    still = np.zeros((1, 3), np.float32)
    one, two = (
        np.asarray(imagine(free, loud, begun, still, KEY)[0].map.classes_XYZ)
        for begun in (state, edited)
    )
    beyond = int(state.map.history.start_3[0]) + 4
    assert (one != two)[beyond:].any()


@pytest.mark.slow
def test_the_cache_of_a_rollout_is_that_of_its_frames_at_once(params, state):
    clean = dataclasses.replace(NOISE, context_noise=0.0, smallest=0.0)
    model = dataclasses.replace(MODEL, voxel_noise=clean)
    config, coder = MODEL.backbone.world_frames, MODEL.backbone.voxel_vae
    middle = windows.middle(MODEL, state.map.low_3, state.map.history.start_3)
    frames, present, shown = [], state, persist.past_of(MODEL, params, state).shown
    for move in (MOVES[0] * 0.01, MOVES[1] * 0.01):  # small steps, that leave the window
        grid = windows.window(MODEL, present.map.classes_XYZ, present.map.history.start_3)
        told = windows.picture_channels(MODEL, shown, middle)
        camera = camera_numbers(shown.camera, MODEL.clip.width, middle)
        latents = voxel_vae.encode(coder, params["voxel_vae"], grid[None].astype(int))[0]
        frames.append((latents, present.map.history.action_A, told, camera))
        shown = persist.past_of(MODEL, params, present).shown
        present, _ = imagine(model, params, present, move[None], KEY)
    np.testing.assert_array_equal(present.map.history.start_3, state.map.history.start_3)
    latents, actions, told, camera = (jnp.stack(x)[None] for x in zip(*frames, strict=True))
    times = jnp.zeros((1, 2))
    inputs, times = clean.precondition(latents, times)
    _, cache = voxel_dit.apply(
        config, params["voxel_dit"], inputs, times, actions, told,
        camera_BTN=camera if config.camera_numbers else None,
        cache=voxel_dit.empty_cache(config, 1),
    )  # fmt: skip
    found = present.map.history.voxels
    np.testing.assert_allclose(found.keys_LBSNKd, cache.keys_LBSNKd, atol=1e-4)
    np.testing.assert_allclose(found.values_LBSNKd, cache.values_LBSNKd, atol=1e-4)


def test_boxes_are_moved_and_copied_by_the_calls_of_the_voxel_map(state):
    here = np.round(np.asarray(state.map.low_3), 4)
    box = np.stack([here + 2.0, here + 3.0]).astype(np.float32)
    blank = dataclasses.replace(state.map, classes_XYZ=jnp.zeros((24, 24, 8), jnp.int16))
    placed = class_grid.place(MODEL.memory, blank, box, 7)
    assert (placed.classes_XYZ == 7).sum() == 8
    shift = np.eye(4, dtype=np.float32)
    shift[:3, 3] = 0.5, 1.0, -0.5
    moved = MODEL.memory.move(MODEL, placed, box, shift)
    copied = MODEL.memory.move(MODEL, placed, box, shift, leave=True)
    assert [(x.classes_XYZ == 7).sum() for x in (moved, copied)] == [8, 16]
    np.testing.assert_array_equal(moved.classes_XYZ[5:7, 6:8, 3:5], 7)
    assert moved.history is not None
    frames = seen()
    above = np.array(frames.camera.world_from_camera)
    above[0, :3, 3] = here + np.array([2.5, 2.5, 3.9])
    above[0, :3, :3] = np.diag([1, -1, -1])  # looks down
    view = memories.render(MODEL, placed, Camera(frames.camera.intrinsics_4, above), 16, 16)
    assert view.seen_THW[0, 8, 8]
    assert not view.seen_THW[0, 0, 0]
    np.testing.assert_allclose(view.depth_THW[0, 8, 8], 0.9, atol=1e-4)
    points, colours, there = MODEL.memory.to_points(MODEL, MODEL.memory.erase(MODEL, placed, box))
    assert not there.any()
    assert points.shape == colours.shape == (24 * 24 * 8, 3)
    with pytest.raises(UserError, match="no class 'sofa'"):
        class_grid.number_of(MODEL.memory, "sofa")
    assert class_grid.names(MODEL.memory)[class_grid.number_of(MODEL.memory, "door")] == "door"
    with pytest.raises(UserError, match="takes no frames by itself"):
        MODEL.memory.insert(MODEL, {}, blank, None, None)


def test_windows_move_by_tokens_and_what_leaves_is_kept(params, walked, state):
    far = np.repeat(np.array([[1.0, 0, 0]], np.float32), 3, 0)
    before = state.map
    after, _ = imagine(MODEL, params, state, far, KEY)
    moved = after.map.history.start_3 - before.history.start_3
    assert np.any(moved)
    assert not np.any(moved % MODEL.backbone.token_cells)
    known = np.asarray(before.classes_XYZ) >= 0
    np.testing.assert_array_equal(after.map.classes_XYZ[known], before.classes_XYZ[known])
    assert (after.map.classes_XYZ >= 0).sum() > known.sum()
    shape = (1, 1, 2, 64, 1, 1)
    tokens = jnp.arange(128.0).reshape(shape) + 1
    cache = frame_blocks.FrameCache(tokens, tokens, jnp.ones((1, 2, 64), bool), jnp.int32(2))
    turned = windows.move_cache(MODEL, cache, jnp.array([2, 0, 0]), jnp.array([4, 0, 0]))
    grid, new = (x.reshape(2, 4, 4, 4) for x in (tokens, turned.keys_LBSNKd))
    np.testing.assert_array_equal(new[:, :3], grid[:, 1:])
    known = np.asarray(turned.known_BSN).reshape(2, 4, 4, 4)
    assert known[:, :3].all()
    assert not known[:, 3].any()


@pytest.mark.slow
def test_known_grids_are_begun_in_and_rendered(params):
    frames = seen()
    rng = np.random.default_rng(5)
    place = np.asarray(frames.camera.world_from_camera[0, :3, 3])
    origin = (place - [3, 3, 3.25]).astype(np.float32)
    classes = rng.integers(0, 13, (12, 12, 12)).astype(np.uint8)
    begun = jax.jit(persist.start_in, static_argnums=0)(MODEL, params, frames, classes, origin)
    inside = windows.window(MODEL, begun.map.classes_XYZ, begun.map.history.start_3)
    off = np.round((begun.map.low_3 - origin) / 0.5).astype(int) + begun.map.history.start_3
    x, y, z = off
    np.testing.assert_array_equal(inside, classes[x : x + 8, y : y + 8, z : z + 8])
    poses = action_geometry.integrate(frames.camera.world_from_camera[0], MOVES[:1])[1:]
    camera = Camera(frames.camera.intrinsics_4, poses)
    other = rng.integers(0, 13, (1, 12, 12, 12))
    render = jax.jit(persist.render_true, static_argnums=0)
    one, two = (
        render(MODEL, params, begun, camera, grid, origin[None], KEY)[1]
        for grid in (other, classes[None].astype(int))
    )
    assert np.abs(one.rgb_THWC - two.rgb_THWC).max() > 1e-4
    np.testing.assert_array_equal(one.camera.world_from_camera, poses)
    with pytest.raises(UserError, match="class ids and the"):
        persist.start_in(MODEL, params, frames, classes[0], origin)


def test_without_its_memory_it_begins_anew_and_the_state_is_left(state, monkeypatch):
    """What a step does is tested elsewhere; here it is only which world it is asked to go on."""
    begun, went_on = [], []
    anew = dataclasses.replace(state.map, classes_XYZ=state.map.classes_XYZ + 1)

    def start(model, params, frames, *, real):
        begun.append((frames, real))
        return dataclasses.replace(state, map=anew)

    def step(model, params, past, action, key, given):
        went_on.append(past.grid)
        return past, jax.tree.map(lambda x: x[:1], state.frame)

    monkeypatch.setattr(persist, "_begin_from_frames", start)
    monkeypatch.setattr(persist, "step", step)
    with jax.disable_jit():
        for memory in (True, False):
            kept, _ = MODEL.imagine({}, state, MOVES[:1], KEY, memory=memory)
            equal(kept.map, state.map)
    equal([frames for frames, _ in begun], [state.frame])
    assert [real for _, real in begun] == [False]  # an imagined frame is no evidence
    equal(went_on, [state.map, anew])


@pytest.mark.slow
def test_it_is_an_environment(params):
    env = imagined_env.WorldModelEnv(CONFIG, params, render_mode="rgb_array")
    first, _ = env.reset(seed=0, options={"frames": seen(1, 2), "goal": seen(1, 3)})
    after, *_ = env.step(1)
    assert after in env.observation_space
    assert not np.array_equal(after["rgb"], first["rgb"])


@pytest.mark.slow
def test_real_frames_carry_it_on(params):
    frames = seen(2, 2)
    whole = begin(MODEL, params, frames)
    np.testing.assert_allclose(whole.frame.depth_THW, frames.depth_THW[1:])
    assert int(whole.map.history.pictures.count) == 2
    assert int(whole.map.history.voxels.count) == 1


def recorded(count=2):
    """Return a batch of clips with voxels, as the loader gives it."""
    rng = np.random.default_rng(0)
    moves = np.tile(MOVES[:2], (count, 1, 1))
    frames = jax.tree.map(lambda x: np.stack([x] * count), random_frames(rng, 3, 16, 16))
    poses = np.stack([action_geometry.integrate(p[0], m) for p, m in
                      zip(frames.camera.world_from_camera, moves, strict=True)])  # fmt: skip
    frames = Frames(
        frames.rgb_THWC, frames.depth_THW, Camera(frames.camera.intrinsics_4, np.asarray(poses))
    )
    place = poses[..., :3, 3]
    origin = (np.floor(place / 0.5) - 6) * 0.5
    classes = rng.integers(0, 13, (count, 3, 12, 12, 12)).astype(np.uint8)
    context = jax.tree.map(lambda x: x[:, :1], frames)
    extras = {"classes_TXYZ": classes, "origin_T3": origin.astype(np.float32)}
    return Clip(frames, context, np.ones((count, 1), bool), moves, extras)


@pytest.mark.slow
@pytest.mark.parametrize("stage", worlds.stages(MODEL), ids=lambda stage: stage.name)
def test_a_stage_learns_what_it_names_from_what_was_prepared(params, stage):
    shapes = jax.eval_shape(lambda: stage.init(MODEL, KEY))
    own = {name: params[name] for name in shapes}
    assert jax.tree.map(jnp.shape, own) == jax.tree.map(lambda x: x.shape, shapes)
    clip = recorded()

    @jax.jit
    def slopes(params, clip):
        return jax.value_and_grad(
            lambda p: stage.loss(MODEL, CONFIG.train, p, clip, KEY), has_aux=True
        )(params)

    prepared = jax.jit(stage.prepare, static_argnums=0)(MODEL, own, clip)
    (loss, _), found = slopes(own, prepared)
    assert np.isfinite(loss)
    labels = stage.labels(own)
    moves = jax.tree.map(lambda g, label: bool(np.any(g)) and label == "train", found, labels)
    assert any(jax.tree.leaves(moves))


def test_clips_prepared_for_one_stage_are_not_read_by_another():
    """Their folder is named by ``prepares_by`` and the batch, which two stages may share."""
    for one, other in itertools.combinations(worlds.stages(MODEL), 2):
        assert (one.prepares_by == other.prepares_by) == (one.prepare is other.prepare), one.name


def test_windows_of_recorded_grids_are_those_of_a_rollout():
    clip = recorded(1)
    places = np.arange(12**3).reshape(12, 12, 12)
    clip = clip.with_extras(classes_TXYZ=np.broadcast_to(places, (1, 3, 12, 12, 12)))
    found, start = persist_prepare.lattice(MODEL, clip)
    grids = persist_prepare.cut_windows(MODEL, clip, start, found)
    for frame in range(3):
        x, y, z = np.asarray(start - found)[0, frame]
        np.testing.assert_array_equal(
            grids[0, frame], places[x : x + 8, y : y + 8, z : z + 8].astype(np.int16)
        )
    agent = np.floor(
        (clip.frames.camera.world_from_camera[0, :, :3, 3] - clip.extras["origin_T3"][0]) / 0.5
    )
    off = agent + np.asarray(found)[0] - np.asarray(start)[0]
    assert np.abs(off[:, :2] - 4).max() <= MODEL.backbone.token_cells
    with pytest.raises(UserError, match=re.escape("--voxels.side 12")):
        persist_prepare.lattice(MODEL, clip.with_extras(classes_TXYZ=None))


def test_a_latent_is_occupied_where_anything_is_known_in_its_cells():
    classes = np.zeros((1, 1, 8, 8, 8), np.int16)
    classes[0, 0, 3, 5, 6], classes[0, 0, 0, 0, 0] = 7, -1
    found = np.asarray(persist_prepare.occupied(MODEL, classes))
    assert found.shape == (1, 1, 4, 4, 4)
    assert np.argwhere(found[0, 0]).tolist() == [[1, 2, 3]]


@pytest.mark.slow
def test_the_renderer_is_given_the_voxels_drawn_in_their_colours(params):
    cells = np.zeros((8, 8, 8), np.int32)
    cells[6] = class_grid.number_of(MODEL.memory, "furniture")
    camera = jax.tree.map(lambda x: jnp.asarray(x[0]), seen().camera)
    corner = np.asarray(camera.world_from_camera[:3, 3]) - 2.0
    made = persist_pictures.draw_latents(MODEL, params, cells, corner, camera)
    view = MODEL.memory.render(MODEL, class_grid.ClassGrid(cells, corner), seen().camera, 16, 16)
    wanted = encode_picture(MODEL, params, view.features_THWF[0], view.depth_THW[0])
    np.testing.assert_allclose(made, wanted, atol=1e-6)
    empty = persist_pictures.draw_latents(MODEL, params, 0 * cells, corner, camera)
    assert np.abs(made - empty).max() > 1e-3
    told = persist_pictures.features(MODEL, params, cells, corner, jnp.zeros(3, jnp.int32), camera)
    np.testing.assert_allclose(told[0, 0, ..., -64:], made, atol=1e-6)


def test_clips_that_begin_elsewhere_lie_on_other_lattices():
    cells = np.stack(np.meshgrid(*[np.arange(-16, 16)] * 2, [3], indexing="ij"), -1).reshape(-1, 3)
    mixed = np.asarray(persist_prepare._hash_cell(jnp.asarray(cells)))
    assert not mixed[:, 2].any()
    for axis in (0, 1):
        shares = np.bincount(mixed[:, axis] % 8, minlength=8) / len(cells)
        assert np.abs(shares - 1 / 8).max() < 0.05
        for other in (cells[:, 0] % 8, cells[:, 1] % 8, mixed[:, 1 - axis] % 8):
            together = np.histogram2d(mixed[:, axis] % 8, other, 8)[0] / len(cells)
            assert np.abs(together - 1 / 64).max() < 0.02


def test_its_settings_travel_and_what_cannot_work_is_refused():
    assert configuration.from_dict(Config, configuration.to_dict(CONFIG)) == CONFIG
    tiny = presets.load("persist_tiny")
    assert configuration.from_dict(Config, configuration.to_dict(tiny)) == tiny
    for changes, says in (
        ({"persistence_logit": -1.0}, "use 0 or more nats"),
        ({"observation_logit": -1.0}, "model.observation_logit is -1.0: use 0 or more nats"),
        (
            {"memory": dataclasses.replace(MODEL.memory, pictures="surfaces")},
            "it reads colours of blocks",
        ),
        (
            {
                "backbone": dataclasses.replace(
                    MODEL.backbone,
                    renderer=dataclasses.replace(MODEL.backbone.renderer, drawn=5),
                )
            },
            "backbone.renderer.drawn is 5: use 0, or the 64",
        ),
        ({"memory": VoxelConfig()}, "made of a GridConfig"),
        ({"codec": PixelConfig(spatial=2, temporal=1)}, "pixel_channels is 88"),
        ({"noise": dataclasses.replace(NOISE, per_frame=False)}, "per_frame is false"),
        ({"memory": dataclasses.replace(MODEL.memory, recorded=8)}, "memory.recorded is 8"),
        ({"memory": dataclasses.replace(MODEL.memory, cells=(24, 24, 10))}, "along z"),
    ):
        with pytest.raises(ConfigError, match=re.escape(says)):
            dataclasses.replace(MODEL, **changes)
    with pytest.raises(UserError, match="colours"):
        worlds.start(MODEL, {}, random_frames(np.random.default_rng(0), 2))


def test_the_published_sizes_are_those_of_the_preset():
    model = presets.load("persist_xl").model
    shapes = jax.eval_shape(lambda: worlds.init(model, KEY))
    wanted = {"voxel_vae": 138e6, "voxel_dit": 686e6, "camera_model": 234e6, "renderer": 460e6}
    for name, count in wanted.items():
        found = sum(int(np.prod(x.shape)) for x in jax.tree.leaves(shapes[name]))
        assert abs(found / count - 1) < 0.005, name


def test_a_control_of_nothing_known_is_refused(params, state):
    with pytest.raises(UserError, match="no actions"):
        worlds.imagine(MODEL, params, state, np.zeros((0, 3), np.float32), KEY)
    control = Control(state.frame.camera, np.zeros((1, 5), np.float32))
    with pytest.raises(UserError, match="takes 3"):
        worlds.imagine(MODEL, params, state, control, KEY)
