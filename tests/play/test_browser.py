"""The page in a real browser: keys, a button, an edit; screenshots are compared by what they show.

Skipped where no Chromium is installed (Debian's package ``chromium``).
"""

import io
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pewm_jax.play.settings import Serve, Start
from tests.play.tiny_drive import a_place, a_toy

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",  # WebGL on the processor
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
LONG = 120
LEFT_HALF = {"x": 0, "y": 60, "width": 520, "height": 480}
"""Where the pictures are, in a window of 1280 × 800."""
MAP = {"x": 560, "y": 150, "width": 390, "height": 600}
"""Where the map is, and nothing else."""

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium is installed (Debian: apt install chromium)"
)


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    from pewm_jax.play import page

    a_place()
    folder = tmp_path_factory.mktemp("worlds")
    one = page.Page(a_toy, Start(house=2), Serve(port=0, ahead=False), folder, "toy")
    assert one.driver.wait(LONG)
    yield one
    one.close()


@pytest.fixture(scope="module")
def tabs(served, tmp_path_factory):
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    outside = []
    with sync_api.sync_playwright() as library:
        context = library.chromium.launch_persistent_context(
            str(tmp_path_factory.mktemp("profile")),
            executable_path=CHROMIUM,
            args=FLAGS,
            headless=True,
            viewport={"width": 1280, "height": 800},
        )
        context.set_default_timeout(LONG * 1000)
        tab = context.new_page()
        tab.on("request", lambda r: outside.append(r.url))
        tab.goto(served.url)
        tab.get_by_text("Walls stop me").wait_for()
        until(tab, lambda: shown(tab, MAP).std() > 8)  # the points are there
        yield tab, context, outside
        context.close()


def until(tab, holds, seconds=60):
    """Wait until something holds, while the browser goes on."""
    for _ in range(seconds * 5):
        if holds():
            return
        tab.wait_for_timeout(200)
    raise AssertionError(f"not within {seconds} s")


def shown(tab, clip):
    """What is seen in a part of the window, (H, W, 3)."""
    code = tab.screenshot(clip=clip)
    keep(tab, code)
    return np.asarray(Image.open(io.BytesIO(code)).convert("RGB")).astype(float)


def keep(tab, code):
    """Keep screenshots in the folder that the environment names, to look at them."""
    folder = os.environ.get("PEWM_JAX_SCREENSHOTS")
    if folder:
        path = Path(folder)
        path.mkdir(parents=True, exist_ok=True)
        number = len(list(path.glob("*.png")))
        (path / f"{number:03d}.png").write_bytes(code)


def changed(one, other):
    """The share of pixels that differ."""
    return float((np.abs(one - other).max(-1) > 24).mean())


def steps(served):
    assert served.driver.wait(LONG)
    return served.driver._session.steps


@pytest.mark.slow
def test_keys_and_buttons_drive_and_the_picture_changes(served, tabs):
    tab, _, outside = tabs
    before, count = shown(tab, LEFT_HALF), steps(served)
    assert before.std() > 20  # a picture, not a blank
    camera = [np.array(c.camera.position) for c in served._server.get_clients().values()]
    here = served.driver._session.path_P3[-1]
    for pressed, key in enumerate(("a", "ArrowLeft", "w"), 1):
        tab.keyboard.press(key)
        until(tab, lambda n=count + pressed: steps(served) == n)
    until(tab, lambda: changed(before, shown(tab, LEFT_HALF)) > 0.3)
    went = served.driver._session.path_P3[-1] - here
    after = [np.array(c.camera.position) for c in served._server.get_clients().values()]
    for one, other in zip(camera, after, strict=True):
        # The map's camera follows the agent; the keys themselves do not move it.
        np.testing.assert_allclose(other - one, went, atol=0.02)
    middle = shown(tab, LEFT_HALF)
    tab.get_by_role("button", name="right ↷").click()
    until(tab, lambda: steps(served) == count + 4)
    until(tab, lambda: changed(middle, shown(tab, LEFT_HALF)) > 0.3)
    own = served.url.removeprefix("http")
    assert [
        u for u in outside if not u.startswith((f"http{own}", f"ws{own}", "data:", "blob:"))
    ] == []


@pytest.mark.slow
def test_a_box_that_is_chosen_in_the_map_and_erased_is_gone(served, tabs):
    tab, _, _ = tabs
    count, many = steps(served), len(served._map.points)
    tab.keyboard.down("Shift")
    tab.mouse.move(MAP["x"] + 120, MAP["y"] + 150)
    tab.mouse.down()
    tab.mouse.move(MAP["x"] + 200, MAP["y"] + 250, steps=4)
    tab.mouse.move(MAP["x"] + 300, MAP["y"] + 330, steps=4)
    tab.mouse.up()
    tab.keyboard.up("Shift")
    until(tab, lambda: served._map.box_23 is not None)
    low, high = served._map.box_23
    tab.wait_for_timeout(500)
    with_box = shown(tab, MAP)
    inside = ((served._map.points >= low) & (served._map.points < high)).all(-1)
    assert inside.sum() > 20
    tab.get_by_role("button", name="Erase").click()
    until(tab, lambda: steps(served) == count + 1)
    # What is imagined when one looks again may be new there, observed is nothing.
    held, _, observed = served.driver.engine.points(served.driver._session.world)
    assert not (((held >= low) & (held < high)).all(-1) & observed).any()
    assert served._map.box_23 is None
    until(tab, lambda: changed(with_box, shown(tab, MAP)) > 0.005)
    tab.get_by_role("button", name="Undo").click()
    until(tab, lambda: len(served._map.points) == many)


@pytest.mark.slow
def test_a_second_tab_sees_the_same_and_a_closed_one_stops_nothing(served, tabs):
    tab, context, _ = tabs
    second = context.new_page()
    second.goto(served.url)
    second.get_by_text("Walls stop me").wait_for()
    until(second, lambda: changed(shown(second, LEFT_HALF), shown(tab, LEFT_HALF)) < 0.05)
    tab.bring_to_front()
    count = steps(served)
    second.close()
    tab.keyboard.press("d")
    until(tab, lambda: steps(served) == count + 1)


@pytest.mark.slow
def test_a_world_that_fails_says_so_on_the_page(served, tabs, monkeypatch):
    from pewm_jax.play import session

    tab, _, _ = tabs

    def fails(*_):
        raise RuntimeError("no device")

    with monkeypatch.context() as patched:
        patched.setattr(session, "ahead", fails)
        tab.keyboard.press("w")
        tab.get_by_text("That failed (RuntimeError: no device)").wait_for()
    count = steps(served)
    tab.keyboard.press("a")
    until(tab, lambda: steps(served) == count + 1)
