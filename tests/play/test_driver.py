"""The thread that drives: the last step wins, errors are sentences, videos are whole."""

import dataclasses
import threading

import av
import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.play import board, driver, saved, session
from pewm_jax.play.settings import Start
from tests.play.tiny_drive import FORWARD, LEFT, Telling, Toy, a_toy

LONG = 120


@dataclasses.dataclass(frozen=True, eq=False)
class Slow(Toy):
    """An engine whose steps wait to be let go, or fail."""

    go: threading.Event = dataclasses.field(default_factory=threading.Event)
    begun: threading.Event = dataclasses.field(default_factory=threading.Event)
    wrong: list = dataclasses.field(default_factory=list)

    def imagine(self, world, action_3, key):
        self.begun.set()
        assert self.go.wait(LONG)
        if self.wrong:
            raise self.wrong.pop()
        return super().imagine(world, action_3, key)


def a_slow():
    made = Slow(**{field.name: getattr(a_toy(), field.name) for field in dataclasses.fields(Toy)})
    made.go.set()
    return made


@pytest.fixture
def drives(tmp_path):
    """Begin drivers, and end them all."""
    begun = []

    def begin(load=a_toy, *, ahead=False, show=None):
        told = Telling()
        one = driver.Driver(load, Start(house=2), show or told, tmp_path, ahead=ahead)
        begun.append(one)
        assert one.wait(LONG)
        return one, told

    yield begin
    for one in begun:
        one.close()


def test_it_shows_a_picture_before_it_imagines_and_what_it_is_doing(drives):
    one, told = drives()
    pictured = next(k for k, shown in enumerate(told.told) if shown.picture is not None)
    assert any("Loading" in said for said in told.sentences[:pictured])
    preparing = [k for k, shown in enumerate(told.told) if "Preparing" in shown.said]
    assert preparing[0] > pictured
    assert all(told.told[k].busy for k in preparing)
    assert not told.told[-1].busy
    assert one.engine is a_toy()


def test_of_steps_asked_for_meanwhile_the_last_one_wins(drives):
    slow = a_slow()
    one, told = drives(lambda: slow)
    slow.go.clear()
    slow.begun.clear()
    one.put(LEFT)
    assert slow.begun.wait(LONG)
    for _ in range(10):
        one.put(LEFT)
    one.put(session.Save("between"))
    one.put(session.Drive((0.0, 0.0, -float(np.pi / 6))))
    slow.go.set()
    assert one.wait(LONG)
    assert told.session.steps == 2
    first = told.told[0]
    assert first is not None
    begun = next(shown.session for shown in told.told if shown.session is not None)
    np.testing.assert_allclose(told.session.planar_3, begun.planar_3, atol=1e-9)
    assert saved.names(one._folder) == ["between"]


def test_what_is_imagined_ahead_is_taken_and_bounded(drives):
    slow = a_slow()
    one, told = drives(lambda: slow, ahead=True)
    assert len(one._made) == 3
    slow.wrong.append(RuntimeError("it was not made ahead"))
    one.put(FORWARD)
    assert one.wait(LONG)
    failed = [shown for shown in told.told if shown.failed]
    assert len(failed) == 1  # the next step ahead, not the step
    assert told.session.steps == 1
    assert len(one._made) <= 3


def test_a_world_that_fails_leaves_a_sentence_and_the_world_as_it_was(drives):
    slow = a_slow()
    one, told = drives(lambda: slow)
    before = told.session
    for error in (RuntimeError("a device\nis lost"), UserError("Too far."), ValueError()):
        slow.wrong.append(error)
        one.put(LEFT)
        assert one.wait(LONG)
    said = [shown.said for shown in told.told if shown.failed]
    assert said[0].startswith("That failed (RuntimeError: a device is lost)")
    assert said[1] == "Too far."
    assert "ValueError" in said[2]
    assert one._session is before
    one.put(LEFT)
    assert one.wait(LONG)
    assert told.session.steps == 1
    assert not told.told[-1].failed


def test_a_model_that_does_not_load_is_a_sentence_and_can_be_tried_again(drives):
    tries = []

    def load():
        tries.append(1)
        if len(tries) == 1:
            raise UserError("runs/none holds no weights.")
        return a_toy()

    one, told = drives(load)
    assert told.told[-1].said == "runs/none holds no weights."
    one.put(FORWARD)
    assert one.wait(LONG)
    assert "no world yet" in told.told[-1].said
    one.put(session.Begin(Start(house=2)))
    assert one.wait(LONG)
    assert told.session.steps == 0


def test_a_page_that_is_gone_stops_nothing(drives):
    def gone(shown):
        raise ConnectionError

    one, _ = drives(show=gone)
    one.put(FORWARD)
    assert one.wait(LONG)
    assert one._session.steps == 1


def test_edits_are_taken_back_and_worlds_kept_and_gone_on_in(drives):
    one, told = drives()
    begun = told.session
    here = begun.planar_3
    box = ((here[0] - 3.0, here[1] - 3.0, -1.0), (here[0] + 3.0, here[1] + 3.0, 3.0))
    one.put(session.Save("before"))
    one.put(session.Erase(box))
    assert one.wait(LONG)
    assert told.session.steps == 1
    before, after = (len(one.engine.points(now.world)[0]) for now in (begun, told.session))
    assert after < before
    one.put(session.Undo())
    assert one.wait(LONG)
    assert told.session.world is begun.world
    one.put(session.Undo())
    assert one.wait(LONG)
    assert told.told[-1].said == "There is nothing to undo."
    one.put(session.Load("before"))
    assert one.wait(LONG)
    assert told.session.said == "This is the world 'before'."
    one.put(session.Sampler(2))
    assert one.wait(LONG)
    assert one.engine.sampler_steps == 2
    one.put(session.Sampler(0))
    assert one.wait(LONG)
    assert told.told[-1].failed
    assert one.engine.sampler_steps == 2


def test_it_drives_to_a_place_in_steps_and_a_key_stops_it(drives):
    one, told = drives()
    x, y, yaw = told.session.planar_3
    ahead = 0.3
    one.put(session.GoTo((x + ahead * np.cos(yaw), y + ahead * np.sin(yaw), yaw + 0.3)))
    assert one.wait(LONG)
    assert told.session.steps == 2
    there = told.session.planar_3
    np.testing.assert_allclose(there[:2], [x + ahead * np.cos(yaw), y + ahead * np.sin(yaw)])
    assert not one._todo


@pytest.mark.parametrize("ended", ["asked", "closed"])
def test_a_video_has_a_frame_for_each_step_and_is_whole_however_it_ends(drives, tmp_path, ended):
    one, told = drives()
    one.put(session.Record(on=True))
    for event in (FORWARD, LEFT):
        one.put(event)
        assert one.wait(LONG)
    assert told.told[-1].recording
    one.put(session.Record(on=False)) if ended == "asked" else one.close()
    one.wait(LONG)
    one.close()
    (path,) = tmp_path.glob("*.mp4")
    assert not list(tmp_path.glob("*.partial"))
    assert told.told[-1].link == path
    with av.open(str(path)) as film:
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(frames) == 3
    last = board.board(board.pictures(a_toy(), one._session), "toy")
    assert frames[-1].shape == last.shape
    assert np.abs(frames[-1].astype(float) - last).mean() < 8


def test_a_request_that_finds_too_many_waiting_is_dropped_and_said(drives):
    slow = a_slow()
    one, told = drives(lambda: slow)
    slow.go.clear()
    slow.begun.clear()
    one.put(LEFT)
    assert slow.begun.wait(LONG)
    for number in range(driver.MOST_WAITING):
        one.put(session.Save(f"w{number:02}"))
    assert not [shown for shown in told.told if shown.failed]
    one.put(session.Save("lost"))
    one.put(session.Undo())
    said = [shown.said for shown in told.told if shown.failed]
    assert len(said) == 2
    assert "32 requests are waiting: Save was dropped." in said[0]
    assert "Undo was dropped" in said[1]
    slow.go.set()
    assert one.wait(LONG)
    assert saved.names(one._folder) == [f"w{number:02}" for number in range(driver.MOST_WAITING)]


def test_drags_and_switches_are_coalesced_while_a_step_is_imagined(drives):
    slow = a_slow()
    one, told = drives(lambda: slow)
    x, y, yaw = told.session.planar_3.tolist()
    slow.go.clear()
    slow.begun.clear()
    one.put(LEFT)
    assert slow.begun.wait(LONG)
    for number in range(200):
        one.put(session.GoTo((x, y, yaw + number)))
        one.put(session.Walls(number % 2 == 0))
    assert len(one._waiting) == 2
    assert not [shown for shown in told.told if shown.failed]
    one.put(session.GoTo((x, y, yaw)))
    slow.go.set()
    assert one.wait(LONG)
    np.testing.assert_allclose(told.session.planar_3, [x, y, yaw], atol=1e-6)
    assert not told.session.walls


@pytest.mark.slow
def test_one_drag_drives_a_bounded_number_of_steps_and_says_so(drives):
    one, told = drives()
    before = told.session
    one.put(session.Walls(False))
    one.put(session.GoTo((before.planar_3[0] + 1000.0, *before.planar_3[1:].tolist())))
    assert one.wait(LONG)
    assert told.session.steps == before.steps + driver.MOST_WAY
    assert any(f"driving the first {driver.MOST_WAY}" in said for said in told.sentences)
