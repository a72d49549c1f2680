"""A drive with a body: keys walk, sliders move joints, the next state is the action."""

import dataclasses
import functools
from pathlib import Path

import jax
import numpy as np
import pytest

from pewm_jax import presets
from pewm_jax.bodies.humanoid import HUMANOID
from pewm_jax.cli import play
from pewm_jax.cli.play import Settings
from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import UserError, serialize
from pewm_jax.data.collect import collect
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.make_episode import CollectConfig
from pewm_jax.play import board, driver, engine, joints, page, places, saved, session
from pewm_jax.play.settings import Serve, Start
from pewm_jax.types import Frames, WorldState
from pewm_jax.worlds.egowm.world import EgoWM
from tests.helpers import randomised, shrink
from tests.play.tiny_drive import FORWARD, LEFT, Telling

LONG = 120
SIZE = 24


@functools.cache
def config():
    loaded = presets.load("egowm_humanoid")
    return dataclasses.replace(loaded, model=shrink(loaded.model, side=SIZE))


@dataclasses.dataclass(frozen=True, eq=False)
class Puppet(engine.Engine):
    """An engine without a network: it shows black, and keeps the steps that it was asked for."""

    steps: list = dataclasses.field(default_factory=list)

    def start(self, frames):
        return WorldState(as_signal(frames_at(frames, -1)), frames_at(frames, slice(0, 0)))

    def imagine(self, world, step, key):
        self.steps.append(step)
        rgb = -np.ones((1, SIZE, SIZE, 3), np.float32)
        return WorldState(Frames(rgb, np.zeros((1, SIZE, SIZE)), step.camera), world.map)


def frames_at(frames, where):
    where = slice(where, None) if where == -1 else where
    camera = dataclasses.replace(
        frames.camera,
        intrinsics_4=frames.camera.intrinsics_4[where],
        world_from_camera=frames.camera.world_from_camera[where],
    )
    return Frames(frames.rgb_THWC[where], frames.depth_THW[where], camera)


def a_puppet():
    return Puppet("puppet", config(), {})


@functools.cache
def a_place():
    return places.open_place(Start(house=2), SIZE, SIZE, body="humanoid")


def begun():
    one = a_puppet()
    return one, session.begin(one, a_place())


def test_a_drive_begins_with_the_body_in_its_own_picture():
    one, now = begun()
    np.testing.assert_allclose(now.planar_3, a_place().planar_3)
    np.testing.assert_array_equal(now.state_A, HUMANOID.rest)
    bare = places.truth(a_place(), now.world.frame.camera, SIZE, SIZE)
    differs = np.abs(bare.rgb_THWC.astype(int) - a_place().frames.rgb_THWC).max(-1) > 20
    assert 0.02 < differs.mean() < 0.6
    shown = board.pictures(one, now)
    np.testing.assert_array_equal(shown.truth, a_place().frames.rgb_THWC[0])
    assert shown.blind is None


def test_a_step_walks_and_its_action_is_the_next_state():
    one, now = begun()
    step = (0.12, 0.05, 0.1)
    after = session.apply(one, now, session.Drive(step))
    (control,) = one.steps
    np.testing.assert_allclose(control.actions_TA[0, -2:], (0.12, 0.1), atol=1e-6)  # never aside
    np.testing.assert_allclose(control.state_A, HUMANOID.rest, atol=1e-6)
    np.testing.assert_allclose(after.state_A, control.actions_TA[0])
    np.testing.assert_allclose(np.linalg.norm(after.planar_3[:2] - now.planar_3[:2]), 0.12)
    agent = a_place().agent
    pose = agent.camera(after.planar_3[None], after.state_A[None], np.ones(4), a_place().floor_z)
    np.testing.assert_allclose(
        after.world.frame.camera.world_from_camera, pose.world_from_camera, atol=1e-5
    )
    aside = session.apply(one, now, session.Drive((0.0, 0.2, 0.0)))
    assert aside.said == "This body does not step aside."
    assert aside.steps == now.steps
    far = session.apply(one, now, session.Drive((3.0, 0.0, 3.0)))
    np.testing.assert_allclose(far.state_A[-2:], HUMANOID.high[-2:], atol=1e-6)


def test_joints_move_to_the_wished_pose_at_their_speed_and_stay_inside_limits():
    one, now = begun()
    wished = session.apply(one, now, session.Pose(tuple(np.full(23, 9.0))))
    assert not one.steps
    count = HUMANOID.frames_to(now.state_A, wished.wished_A)
    assert 2 < count < 20
    after = wished
    for _ in range(count):
        before, after = after, session.apply(one, after, session.Drive((0, 0, 0)))
        change = np.abs(after.state_A - before.state_A)[:-2]
        assert (change <= HUMANOID.fastest[:-2] + 1e-6).all()
    np.testing.assert_allclose(after.state_A[:-2], HUMANOID.high[:-2], atol=1e-5)
    np.testing.assert_allclose(after.planar_3, now.planar_3)
    for joints_ in ((1.0,), (*[0.0] * 22, np.nan)):
        with pytest.raises(UserError, match="has 23 finite numbers"):
            session.apply(one, now, session.Pose(joints_))


def test_walls_stop_the_body_without_sliding():
    one, now = begun()
    for _ in range(200):
        after = session.apply(one, now, FORWARD)
        if after.said:
            break
        now = after
    assert after.said == "Blocked by a wall."
    assert after.state_A[-2] == now.state_A[-2]


def test_the_driver_moves_joints_walks_to_places_and_keeps_worlds(tmp_path):
    told, one = Telling(), a_puppet()
    drive = driver.Driver(lambda: one, Start(house=2), told, tmp_path, ahead=False)
    try:
        assert drive.wait(LONG)
        reach = joints.posture(HUMANOID, "reach")
        drive.put(session.Pose(tuple(reach)))
        assert drive.wait(LONG)
        np.testing.assert_allclose(drive._session.state_A[:-2], reach, atol=1e-5)
        drive.put(session.Save("reaching"))
        assert drive.wait(LONG)
        np.testing.assert_allclose(saved.posture(tmp_path, "reaching")[:-2], reach, atol=1e-5)
        start = drive._session.planar_3
        target = start + np.array([0.1 * np.cos(start[2]), 0.1 * np.sin(start[2]), 0.3])
        drive.put(session.GoTo(tuple(target)))
        assert drive.wait(LONG)
        np.testing.assert_allclose(drive._session.planar_3, target, atol=1e-5)
        drive.put(session.Pose(tuple(HUMANOID.rest[:-2])))
        drive.put(session.Load("reaching"))
        assert drive.wait(LONG)
        np.testing.assert_allclose(drive._session.state_A[:-2], reach, atol=1e-5)
        np.testing.assert_allclose(drive._session.planar_3, start, atol=1e-4)
    finally:
        drive.close()


def test_the_page_has_a_slider_for_every_joint_and_postures(tmp_path):
    served = Serve(port=0, ahead=False)
    one = page.Page(a_puppet, Start(house=2), served, tmp_path, "puppet", lambda _: None)
    try:
        assert one.driver.wait(LONG)
        panel = one._joints
        assert panel.folder.visible
        assert len(panel.sliders) == 23
        assert [k for k, _ in panel.sliders] == list(range(23))
        panel.take("raise")
        assert one.driver.wait(LONG)
        wished = joints.posture(HUMANOID, "raise")
        np.testing.assert_allclose(one.driver._session.state_A[:-2], wished, atol=0.01)
        assert panel.sliders[6][1].value == round(wished[6], 2)
        one.driver.put(session.Begin(Start(house=2)))
        assert one.driver.wait(LONG)
        assert panel.sliders[6][1].value == round(HUMANOID.rest[6], 2)
        after = dataclasses.replace(one.driver._session, steps=3)
        one.show(page.PageUpdate("", engine=one.driver.engine, session=after))
        panel.sliders[6][1].value = 0.5
        one.show(page.PageUpdate("", engine=one.driver.engine, session=after))
        assert panel.sliders[6][1].value == 0.5  # where the user holds it
        earlier = dataclasses.replace(after, steps=2)
        one.show(page.PageUpdate("", engine=one.driver.engine, session=earlier))
        assert panel.sliders[6][1].value == round(HUMANOID.rest[6], 2)  # as after an undo
    finally:
        one.close()


def test_ways_turn_walk_and_turn():
    before, after = np.array([0.3, -0.2, 0.4]), np.array([1.0, 0.9, -2.0])
    found = places.forward_way(before, after, 0.12, 10.0)
    assert not found[:, 1].any() or np.abs(found[:, 1]).max() < 1e-6
    free = places.StartPoint("", None)
    for action in found:
        before = places.walk(free, before, action)[0]
    np.testing.assert_allclose(before, after, atol=1e-5)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    common = {"train": 1, "validation": 0, "test": 0, "frames": 12, "size": SIZE, "workers": 1}
    common |= {"step_m": 0.12, "turn_deg": 10.0, "turn_around": 0.0}
    collect(CollectConfig(folder / "body", body="humanoid", **common), log=lambda _: None)
    collect(CollectConfig(folder / "camera", **common), log=lambda _: None)
    return Path(folder)


def test_a_drive_begins_in_an_episode_of_the_body_and_no_other(data):
    start = Start(episode=str(data / "body/train"), frames=8)
    place = places.open_place(start, SIZE, SIZE, body="humanoid")
    episode = EpisodeSource(data / "body/train")[0]
    np.testing.assert_allclose(place.state_A, episode.states[7])
    pose = place.agent.camera(
        place.planar_3[None], place.state_A[None], np.ones(4), place.floor_z
    ).world_from_camera[0]
    np.testing.assert_allclose(pose, episode.world_from_camera[7], atol=1e-4)
    other = dataclasses.replace(start, episode=str(data / "camera/train"))
    with pytest.raises(UserError, match="not recorded by the body humanoid"):
        places.open_place(other, SIZE, SIZE, body="humanoid")
    recording = Start(recording=str(data), intrinsics=(1.0, 1.0, 1.0, 1.0))
    with pytest.raises(UserError, match="a recording does not show"):
        places.open_place(recording, SIZE, SIZE, body="humanoid")
    camera = session.begin(a_puppet(), places.open_place(other, SIZE, SIZE))
    with pytest.raises(UserError, match="no joints"):
        session.apply(a_puppet(), camera, session.Pose((0.0,)))


def test_a_start_without_the_body_is_refused_before_the_page_opens(data, tmp_path):
    serialize.save(config(), tmp_path / "config.json")
    given = Settings(model=str(tmp_path), episode=str(data / "camera/train"))
    with pytest.raises(UserError, match="not recorded by the body humanoid"):
        play._require_usable(given)
    play._require_usable(dataclasses.replace(given, episode=str(data / "body/train")))


def test_what_steers_decides_who_can_drive():
    assert config().model.capabilities.body == "humanoid"
    assert not config().model.capabilities.actions
    nameless = dataclasses.replace(
        config().model, control=dataclasses.replace(config().model.control, body="", drawn=False)
    )
    with pytest.raises(UserError, match="neither planar actions"):
        engine.open_engine("x", dataclasses.replace(config(), model=nameless), {})


@pytest.mark.slow
def test_a_network_is_driven_by_the_same_steps():
    params = randomised(EgoWM.init, config().model, jax.random.key(0))
    one = engine.open_engine("egowm", config(), params)
    now = session.begin(one, a_place())
    after = session.apply(one, now, FORWARD)
    ahead = session.ahead(one, now, session.wanted(now, LEFT)[0])
    turned = session.apply(one, now, LEFT)
    np.testing.assert_array_equal(ahead.frame.rgb_THWC, turned.world.frame.rgb_THWC)
    assert np.abs(after.world.frame.rgb_THWC - turned.world.frame.rgb_THWC).max() > 1e-6
