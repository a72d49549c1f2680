"""The drive without a page: what comes of an event, what is kept, what is chosen and drawn."""

import dataclasses
import io
import re
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pewm_jax
from pewm_jax import worlds
from pewm_jax.cli import parser as cli
from pewm_jax.cli import play
from pewm_jax.config import Config, ConfigError, UserError
from pewm_jax.data.navigation import is_free
from pewm_jax.memory.images import ImagesConfig
from pewm_jax.play import board, engine, picking, places, saved, session
from pewm_jax.play.settings import Serve, Start
from pewm_jax.worlds.codec import CodecTask, CodecTrainConfig
from tests.play.tiny_drive import (
    FORWARD,
    LEFT,
    MODEL,
    a_place,
    a_session,
    an_engine,
    same,
)
from tests.properties import examples
from tests.worlds.persist.tiny_persist import MODEL as PERSIST

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "play.md").read_text()
CODEC = Config(model=CodecTask(), train=CodecTrainConfig())


def boxed(points, box):
    return ((points >= box[0]) & (points < box[1])).all(-1)


def seen_box(now, side=0.8):
    """A box around the middle of what is seen at present."""
    frame = now.world.frame
    camera, depth = session.pose(now), float(frame.depth_THW[0, 8, 12])
    middle = camera[:3, 3] + depth * camera[:3, 2]
    return tuple(tuple(float(x) for x in middle + sign * side / 2) for sign in (-1, 1))


def test_a_step_is_what_the_world_imagines_and_what_was_imagined_ahead_is_the_same():
    model, now = an_engine(), a_session()
    events = [FORWARD, LEFT]
    world = now.world
    for event in events:
        action, planar, _ = session.wanted(now, event)
        made = session.ahead(model, now, action)
        asked = session.apply(model, now, event)
        given_ahead = session.apply(model, now, event, made)
        same(asked.world, given_ahead.world)
        key = jax.random.fold_in(jax.random.key(0), now.steps)
        world, _ = worlds.imagine(MODEL, model.params, world, jnp.asarray(action)[None], key)
        same(asked.world, world)
        np.testing.assert_array_equal(asked.planar_3, planar)
        now = session.catch_up(model, asked)
        assert now.due is None
    camera = session.pose(now)
    np.testing.assert_allclose(camera[:2, 3], now.planar_3[:2], atol=1e-4)
    np.testing.assert_allclose(np.arctan2(*camera[1::-1, 2]), now.planar_3[2], atol=1e-4)
    assert now.steps == 2
    assert len(now.path_P3) == 3
    assert not np.array_equal(now.world.frame.rgb_THWC, now.blind.frame.rgb_THWC)
    same(now.blind.map, a_session().world.map)  # without memory nothing is added to it


@pytest.mark.slow
def test_the_code_of_the_documentation_runs(monkeypatch, capsys):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    tiny = an_engine()
    monkeypatch.setattr(pewm_jax, "load", lambda _: (tiny.config, tiny.params), raising=False)
    exec(compile(code, "docs/play.md", "exec"), {})
    assert capsys.readouterr().out.startswith("Erased ")


def test_the_commands_of_the_documentation_can_be_read_and_its_buttons_are_there():
    lines = re.findall(r"^pewm-jax play (.+)$", PAGE, re.MULTILINE)
    assert len(lines) >= 5
    for line in lines:
        _, *flags = line.split()
        cli.parse(play.Settings, ["small", *flags], prog="pewm-jax play")
    known = {field.name for field in dataclasses.fields(play.Settings)}
    for flag in sorted(set(re.findall(r"(?<=[`\s])--(\w+)", PAGE)) - {"help"}):
        assert flag.removeprefix("no_") in known, flag
    code = "".join(path.read_text() for path in (ROOT / "pewm_jax" / "play").glob("*.py"))
    for button in re.findall(r"(?<!\*)\*([A-Z][^*\n]+)\*(?!\*)", PAGE):
        assert f'"{button}"' in code, button
    assert (ROOT / "docs" / "play.png").stat().st_size < 400_000


def test_walls_stop_and_can_be_walked_through():
    place, planar = a_place(), a_session().planar_3
    for _ in range(60):
        planar, collided = places.walk(place, planar, np.array([0.25, 0.0, 0.0]))
        assert is_free(place.simulator.grid, planar[:2])
    assert collided
    now = dataclasses.replace(a_session(), planar_3=planar)
    action, _, collided = session.wanted(now, FORWARD)
    assert collided
    if not np.abs(action).max() > 1e-6:  # no way along the wall
        after = session.apply(an_engine(), now, FORWARD)
        assert "wall" in after.said
        assert after.steps == now.steps
    free = session.apply(an_engine(), now, session.Walls(stop=False))
    action, beyond, collided = session.wanted(free, FORWARD)
    assert not collided
    np.testing.assert_allclose(action, [0.25, 0, 0], atol=1e-6)
    out, collided = places.walk(place, beyond, np.array([5.0, 0.0, 0.0]))
    assert not collided  # outside nothing can be in the way: one can come back
    assert np.linalg.norm(out[:2] - beyond[:2]) == pytest.approx(5)


def test_the_path_that_is_kept_is_bounded(monkeypatch):
    monkeypatch.setattr(session, "MOST_PATH", 3)
    now = a_session()
    for _ in range(4):
        now = session.apply(an_engine(), now, LEFT)
    assert len(now.path_P3) == 3


def test_what_is_erased_is_gone_from_the_map_and_from_what_is_seen():
    model, now = an_engine(), a_session()
    box = seen_box(now)
    points, _, _ = model.points(now.world)
    inside = boxed(points, np.array(box))
    assert 0 < inside.sum() < len(points)
    erased = model.erase(now.world, np.array(box))
    left, _, _ = model.points(erased)
    assert not boxed(left, np.array(box)).any()
    assert len(left) == len(points) - inside.sum()
    changed = np.abs(erased.frame.rgb_THWC[0] - now.world.frame.rgb_THWC[0]).max(-1) > 1e-3
    assert changed[8, 12]
    assert not changed.all()
    after = session.apply(model, now, session.Erase(box))
    assert after.said == f"Erased {inside.sum()} points of the map."
    assert after.steps == now.steps + 1
    np.testing.assert_allclose(session.pose(after), session.pose(now), atol=1e-6)


@pytest.mark.slow
def test_a_box_is_copied_and_moved():
    model, now = an_engine(), a_session()
    box = seen_box(now)
    points, _, _ = model.points(now.world)
    inside = boxed(points, np.array(box))
    shift = (0.0, 0.0, 1.5)
    motion = session.about_middle(np.array(box), shift, 90.0)
    copied, moved = (model.move(now.world, box, motion, leave=leave) for leave in (True, False))
    there = points[inside] @ motion[:3, :3].T + motion[:3, 3]
    for world, kept_there in ((copied, True), (moved, False)):
        found, _, _ = model.points(world)
        gap = np.linalg.norm(found[:, None] - there[None], axis=-1).min(0)
        assert gap.max() < 0.2
        assert boxed(found, np.array(box)).any() == kept_there
    middle = np.array(box).mean(0)
    np.testing.assert_allclose(motion[:3, :3] @ middle + motion[:3, 3], middle + shift, atol=1e-5)


@pytest.mark.parametrize("box", [((0, 0, 0), (0, 1, 1)), ((1, 1, 1), (0, 0, 0))])
def test_a_box_without_inside_is_refused(box):
    with pytest.raises(UserError, match="is empty"):
        session.apply(an_engine(), a_session(), session.Erase(box))


def test_a_memory_without_places_is_refused_an_edit_and_a_codec_a_drive():
    images = dataclasses.replace(MODEL, memory=ImagesConfig())
    model = dataclasses.replace(an_engine(), config=Config(model=images))
    with pytest.raises(UserError, match="cannot be edited"):
        session.apply(model, a_session(), session.Erase(((0, 0, 0), (1, 1, 1))))
    with pytest.raises(UserError, match="trained a codec alone"):
        engine.open_engine("codec", CODEC, {})


def test_a_world_that_is_kept_comes_back_bit_for_bit(tmp_path):
    model, now = an_engine(), session.apply(an_engine(), a_session(), FORWARD)
    saved.save(model, now.world, tmp_path / "worlds", "my world")
    assert saved.names(tmp_path / "worlds") == ["my world"]
    back = saved.load(model, a_session().world, tmp_path / "worlds", "my world")
    same(back, now.world)
    resumed = session.resume(now, back, "back")
    np.testing.assert_allclose(resumed.planar_3, now.planar_3, atol=1e-4)
    assert not resumed.observed
    other = dataclasses.replace(MODEL, clip=dataclasses.replace(MODEL.clip, far_m=9.0))
    stranger = dataclasses.replace(model, config=Config(model=other))
    with pytest.raises(UserError, match="images or memory differ"):
        saved.load(stranger, now.world, tmp_path / "worlds", "my world")
    with pytest.raises(UserError, match="no world"):
        saved.load(model, now.world, tmp_path, "none yet")


@pytest.mark.parametrize("name", ["../out", "a/b", "", ".hidden", "x" * 61, "a\n"])
def test_names_that_lead_elsewhere_are_refused(name, tmp_path):
    with pytest.raises(ConfigError, match="is not a valid name of a world"):
        saved.path_of(tmp_path, name)


POSES = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


@examples(40)
@given(before=POSES, after=POSES)
def test_a_way_leads_to_its_end_in_small_steps(before, after):
    actions, planar = places.way(before, after, 0.25, 30.0), before
    for action in actions:
        assert np.linalg.norm(action[:2]) <= 0.25 + 1e-4
        assert abs(action[2]) <= np.radians(30) + 1e-4
        planar, _ = places.walk(places.StartPoint("", a_place().frames), planar, action)
    np.testing.assert_allclose(planar[:2], after[:2], atol=1e-4)
    assert np.cos(planar[2] - after[2]) > 1 - 1e-5


def write_recording(folder, frames):
    """A recording in the shape of Open3D's, with y down, of 16-bit depths in millimetres."""
    (folder / "image").mkdir(parents=True)
    (folder / "depth").mkdir()
    lines = []
    for k in range(len(frames.depth_THW)):
        rgb, depth = frames.rgb_THWC[k], (frames.depth_THW[k] * 1000).astype(np.uint16)
        cv2.imwrite(str(folder / "image" / f"{k:03d}.png"), rgb[..., ::-1])
        cv2.imwrite(str(folder / "depth" / f"{k:03d}.png"), depth)
        pose = frames.camera.world_from_camera[k]
        lines += [f"{k} {k} 1", *(" ".join(map(str, row)) for row in pose.tolist())]
    (folder / "poses.log").write_text("\n".join(lines))


def test_a_world_of_blocks_begins_in_houses_of_blocks_and_not_with_surfaces():
    recorded = Start(recording="room", intrinsics=(8.0, 8.0, 8.0, 8.0))
    places.require_shown(MODEL, recorded)
    with pytest.raises(UserError, match="was trained on images of blocks"):
        places.require_shown(PERSIST, recorded)
    surfaces = dataclasses.replace(PERSIST.memory, pictures="surfaces")
    plain = dataclasses.replace(PERSIST, memory=surfaces, observation_logit=0.0)
    places.require_shown(plain, recorded)
    assert places.blocks_of(plain) is None
    assert places.blocks_of(MODEL) is None
    blocks = places.blocks_of(PERSIST)
    assert blocks is not None
    place = places.open_place(Start(house=2), 16, 16, blocks)
    places.require_shown(PERSIST, Start())
    one = jax.tree.map(lambda x: x[-1:], place.frames.camera)
    seen = places.truth(place, one, 16, 16)
    assert seen is not None
    np.testing.assert_array_equal(seen.rgb_THWC[0], place.frames.rgb_THWC[-1])
    other = places.open_place(Start(house=2), 16, 16)
    np.testing.assert_array_equal(other.planar_3, place.planar_3)
    assert np.any(other.frames.rgb_THWC != place.frames.rgb_THWC)


def test_a_drive_begins_with_a_recording_of_another_shape(tmp_path):
    place = places.open_place(Start(house=2, frames=3), 32, 40)
    write_recording(tmp_path / "room", place.frames)
    intrinsics = place.frames.camera.intrinsics_4[0] - [0, 0, 0.5, 0.5]
    start = Start(
        recording=str(tmp_path / "room"),
        intrinsics=tuple(map(float, intrinsics)),
        recording_up="z",
        frames=3,
    )
    found = places.open_place(start, *an_engine().size)
    assert found.name == "room"
    assert found.simulator is None
    assert 1 <= len(found.frames.depth_THW) <= 3
    fx, fy, cx, cy = found.frames.camera.intrinsics_4[0]
    assert (cx, cy) == pytest.approx((12, (16 - 2) * 16 / 27), rel=1e-4)  # 2 rows are cut above
    assert fx == pytest.approx(intrinsics[0] * 24 / 40, rel=1e-4)
    assert fy == pytest.approx(intrinsics[1] * 16 / 27, rel=1e-4)
    now = session.begin(an_engine(), found)
    assert board.pictures(an_engine(), now).truth is None
    action, _, collided = session.wanted(now, FORWARD)
    assert not collided
    np.testing.assert_allclose(action, [0.25, 0, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("given_", "says"),
    [
        ({"scene": "a.glb", "episode": "data"}, "one place"),
        ({"recording": "room"}, "--intrinsics"),
        ({"house": -1}, "--house"),
        ({"frames": 0}, "--frames"),
        ({"hfov": 180.0}, "--hfov"),
        ({"camera_height": float("nan")}, "--camera_height"),
    ],
)
def test_a_start_that_cannot_be_is_refused(given_, says):
    with pytest.raises(ConfigError, match=says):
        Start(**given_)


def test_an_address_that_cannot_be_is_refused():
    for wrong in ({"port": -1}, {"port": 65536}, {"host": ""}):
        with pytest.raises(ConfigError):
            Serve(**wrong)


def test_a_rectangle_on_the_screen_chooses_what_stands_in_it():
    rng = np.random.default_rng(0)
    floor = np.stack([*rng.uniform(-3, 3, (2, 4000)), np.zeros(4000)], -1)
    sofa = rng.uniform((0.5, 0.5, 0.1), (1.5, 1.0, 0.8), (800, 3))
    points = np.concatenate([floor, sofa])
    down = np.diag([1.0, -1.0, -1.0])  # from above: right is x, down is −y
    eye = picking.Eye(np.array([0.0, 0.0, 5.0]), down, np.pi / 2, 1.0)
    at = 0.5 + np.array([[0.4, -1.3], [1.8, -0.3]]) / 10
    box = picking.in_rectangle(points, eye, tuple(at[0]), tuple(at[1]))
    np.testing.assert_allclose(box, [[0.5, 0.5, 0.1], [1.5, 1.0, 0.8]], atol=0.1)
    wall = rng.uniform((3.0, 0.6, 0.3), (3.1, 0.9, 0.6), (800, 3))  # behind, from the side
    ahead = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    side = picking.Eye(np.array([-5.0, 0.75, 0.45]), ahead, np.pi / 2, 1.0)
    front = picking.in_rectangle(np.concatenate([points, wall]), side, (0.45, 0.45), (0.55, 0.55))
    assert front[1, 0] < 1.7
    only_floor = picking.in_rectangle(points, eye, (0.25, 0.25), (0.35, 0.35))
    assert only_floor[1, 2] < 0.1
    assert picking.in_rectangle(points, eye, (1.5, 1.5), (1.6, 1.6)) is None
    clicked = picking.at_click(points, eye.position_3, np.array([1.0, 0.7, -4.5]))
    assert boxed(sofa, clicked).sum() > 400
    assert not boxed(floor, clicked).any()
    assert picking.at_click(points, eye.position_3, np.array([0.0, 0.0, 1.0])) is None
    assert picking.at_click(points[:0], eye.position_3, np.array([0.0, 0.0, 1.0])) is None


def test_a_board_has_even_sides_and_shows_each_picture_large_enough():
    shown = board.pictures(an_engine(), a_session())
    assert shown.observed
    np.testing.assert_array_equal(shown.truth, shown.imagined)  # nothing is imagined yet
    whole = board.board(shown, "tiny")
    assert whole.shape[1] == board.WIDTH
    assert not any(side % 2 for side in whole.shape[:2])
    bare = board.board(dataclasses.replace(shown, truth=None, blind=None), "tiny")
    assert bare.shape[0] < whole.shape[0]
    assert io.BytesIO(board.waiting("opening").tobytes())
