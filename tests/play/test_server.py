"""The page without a browser: it is served, tabs come and go, and it ends."""

import contextlib
import socket
import subprocess
import sys
import urllib.error
import urllib.request

import numpy as np
import pytest
import viser
import viser.transforms
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from pewm_jax.cli import main as program
from pewm_jax.cli import play
from pewm_jax.config import ConfigError, UserError
from pewm_jax.play import page, serving, session
from pewm_jax.play.settings import Serve, Start
from tests.play.tiny_drive import FORWARD, Toy, a_place, a_toy

LONG = 120


@contextlib.contextmanager
def a_page(folder, load=a_toy, log=lambda _: None):
    one = page.Page(load, Start(house=2), Serve(port=0, ahead=False), folder, "toy", log)
    try:
        yield one
    finally:
        one.close()


def a_tab(one, **rest):
    protocol = f"viser-v{viser.__version__}"
    return connect(one.url.replace("http", "ws"), subprotocols=[protocol], max_size=None, **rest)


def heard(tab):
    """Bytes that a tab was sent until it is quiet for a moment."""
    count = 0
    with contextlib.suppress(TimeoutError):
        while True:
            count += len(tab.recv(timeout=1.0))
    return count


def test_it_is_served_and_tabs_that_go_take_nothing_with_them(tmp_path):
    a_place()
    with a_page(tmp_path) as one:
        with urllib.request.urlopen(one.url, timeout=30) as answer:
            assert answer.status == 200
            assert b"<html" in answer.read().lower()
        assert one.driver.wait(LONG)
        first, second = a_tab(one), a_tab(one)
        assert min(heard(first), heard(second)) > 10_000  # the picture and the map, at once
        one.driver.put(FORWARD)
        assert one.driver.wait(LONG)
        assert min(heard(first), heard(second)) > 5_000
        first.socket.close()  # lost, without a word
        one.driver.put(FORWARD)
        assert one.driver.wait(LONG)
        assert heard(second) > 5_000
        second.close()
        one.driver.put(FORWARD)
        assert one.driver.wait(LONG)
        assert one.driver._session.steps == 3
        third = a_tab(one)
        assert heard(third) > 10_000
    with pytest.raises((urllib.error.URLError, ConnectionError)):
        urllib.request.urlopen(one.url, timeout=5)
    with contextlib.suppress(ConnectionClosed):
        heard(third)


def test_what_goes_wrong_is_on_the_page(tmp_path):
    def load():
        raise UserError("runs/<none> holds no weights.")

    with a_page(tmp_path, load) as one:
        assert one.driver.wait(LONG)
        assert "runs/&lt;none&gt; holds no weights." in one._status.content
        one.driver.put(FORWARD)
        assert one.driver.wait(LONG)
        assert "no world yet" in one._status.content
        one._edit("erase")
        assert "Choose a box first" in one._status.content


def test_the_terminal_is_told_now_and_then_what_is_waited_for(tmp_path, monkeypatch):
    told = []

    def load():
        raise UserError("nothing to load here")

    with a_page(tmp_path, load, told.append) as one:
        assert one.driver.wait(LONG)
        assert told[1:] == ["Loading the model …", "error: nothing to load here"]
        told.clear()
        for seconds in range(1, 4):
            one._tell(session.PageUpdate(f"Preparing … {seconds} s", busy=True))
        monkeypatch.setattr(page, "SAY_AGAIN_S", 0.0)
        one._tell(session.PageUpdate("Preparing … 4 s", busy=True))
        one._tell(session.PageUpdate("Drive."))
        assert told == ["Preparing … 1 s", "Preparing … 4 s", "Ready."]


def test_a_box_goes_where_it_was_dragged_and_the_agent_too(tmp_path):
    with a_page(tmp_path) as one:
        assert one.driver.wait(LONG)
        view, begun = one._map, one.driver._session
        low, high = (begun.planar_3[0] - 1, begun.planar_3[1] - 1), (4.0, 4.0)
        box = np.array([[*low, 0.2], [low[0] + high[0], low[1] + high[1], 1.0]])
        inside = ((view.points >= box[0]) & (view.points < box[1])).all(-1)
        assert 0 < inside.sum() < len(view.points)
        one._choose(box)
        view.target.position = view.target.position + np.array([0.0, 0.0, -20.0])
        view.target.wxyz = viser.transforms.SO3.from_z_radians(np.pi / 2).wxyz
        one._edit("copy")
        assert one.driver.wait(LONG)
        assert (view.points[:, 2] < -10).sum() == inside.sum()
        assert view.box_23 is None
        x, y, yaw = begun.planar_3
        view.handle.position = np.array([x, y, 0.0])
        view.handle.wxyz = viser.transforms.SO3.from_z_radians(yaw + 0.4).wxyz
        one._put(session.GoTo(view.dragged()))
        assert one.driver.wait(LONG)
        assert np.cos(one.driver._session.planar_3[2] - yaw - 0.4) > 1 - 1e-6
        view.ceiling = view.tint = True
        view.redraw()
        assert len(view.points) == len(one.driver.engine.points(one.driver._session.world)[0])


@pytest.mark.parametrize(("editable", "steps"), [(True, 2), (False, 0)])
def test_only_what_the_model_can_do_is_offered(tmp_path, monkeypatch, editable, steps):
    a_place()
    monkeypatch.setattr(Toy, "editable", editable)
    monkeypatch.setattr(Toy, "sampler_steps", steps)
    with a_page(tmp_path) as one:
        assert one.driver.wait(LONG)
        assert one._editing.visible == editable
        assert one._steps.visible == (steps > 0)


def test_a_page_of_another_site_cannot_drive(tmp_path):
    told = []

    def load():
        raise UserError("nothing to load here")

    with a_page(tmp_path, load, told.append) as one:
        a_tab(one, origin=one.url).close()
        for origin in ("https://evil.example", "http://127.0.0.1:1", "null"):
            with pytest.raises(InvalidStatus, match="403"):
                a_tab(one, origin=origin)
        port = int(one.url.rpartition(":")[2])
        rebound = f"evil.example:{port}"  # a name that was made to point at this machine
        way = socket.create_connection(("127.0.0.1", port))
        with way, pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://{rebound}", sock=way, origin=f"http://{rebound}")
        page_of_a_stranger = urllib.request.Request(one.url, headers={"Host": rebound})
        with pytest.raises(urllib.error.HTTPError, match="403") as refused:
            urllib.request.urlopen(page_of_a_stranger, timeout=30)
        assert b"--names evil.example" in refused.value.read()
    said = [line for line in told if line.startswith("refused: ")]
    assert len(said) == len(set(said)) == 4
    assert any("another site" in line for line in said)


def test_which_visitors_are_welcome():
    here = "127.0.0.1"
    for origin, host, names in (
        (None, "localhost:8080", ()),
        ("http://localhost:8080", "localhost:8080", ()),
        ("http://[::1]:8080", "[::1]:8080", ()),
        ("http://192.168.0.7:8080", "192.168.0.7:8080", ()),
        ("https://Box.example", "box.example:443", ("box.example",)),
        ("https://box.example", "127.0.0.1:8080", ("box.example",)),  # a proxy that renames
    ):
        assert serving.rejection_reason(origin, host, here, names) == "", (origin, host)
    for origin, host, names in (
        ("http://localhost:8080", "localhost:8081", ()),
        ("https://localhost", "localhost:80", ()),
        ("http://box.example:8080", "box.example:8080", ()),
        ("http://localhost.evil.example", "localhost", ()),
        ("file://", "localhost:8080", ("",)),
        (None, None, ("",)),
        (None, "localhost:port", ()),
    ):
        assert serving.rejection_reason(origin, host, here, names), (origin, host)
    assert serving.rejection_reason("http://box:80", "box", "box") == ""
    for odd in ("a;b", "a\udc9b", "a b", "<b>", "a" * 300):
        for origin, host in ((None, odd), (f"http://{odd}", "localhost")):
            said = serving.rejection_reason(origin, host, here)
            assert said.isascii()
            assert "--names" not in said


def test_a_server_that_cannot_be_asked_about_is_not_served(monkeypatch):
    class Other:
        def __init__(self, **_):
            self.stop = lambda: None

    monkeypatch.setattr(serving.viser, "ViserServer", Other)
    with pytest.raises(UserError, match="pages of other sites"):
        serving.server(Serve(port=0))


def test_only_this_machine_reaches_it_unless_told_otherwise_and_then_it_says_so():
    assert Serve().host == "127.0.0.1"
    assert serving.warning(Serve()) == ""
    assert "no password" in serving.warning(Serve(host="0.0.0.0"))
    assert [serving.here(host) for host in ("0.0.0.0", "::1", "me")] == ["127.0.0.1", "[::1]", "me"]
    with pytest.raises(ConfigError, match="is not an address that this machine"):
        serving.server(Serve(host="203.0.113.7"))  # an address of nobody


def test_the_command_refuses_what_is_no_run_and_says_what_is_missing():
    wrong = (
        ([], "MODEL is missing"),
        (["runs/none"], "is not a run"),
        (["small", "--port", "a"], "an integer"),
        (["small", "--scene", "a.glb", "--episode", "b"], "one place"),
    )
    for argv, says in wrong:
        with pytest.raises(UserError, match=says):
            program.execute(["play", *argv])
    code = (
        "import sys; sys.modules['viser'] = None\n"
        "from pewm_jax.cli.main import main\n"
        "sys.exit(main(['play', 'small']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.strip().splitlines() == [
        "error: the live viewer needs viser, which is not installed: pip install 'pewm-jax[play]'."
    ]


def test_settings_of_a_page_are_those_of_its_parts():
    settings = play.Settings(model="small", house=5, port=0)
    assert isinstance(settings, Start)
    assert isinstance(settings, Serve)
    assert (settings.house, settings.port) == (5, 0)
    with pytest.raises(ConfigError):
        play.Settings(model="small", port=-1)
    assert session.Begin(Start()).start.house == 2
