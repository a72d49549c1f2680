"""The controls of a body's joints on the page: a slider for each, postures by button and key."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from pewm_jax.bodies.humanoid import BODIES
from pewm_jax.bodies.kinematics import Body
from pewm_jax.play import session
from pewm_jax.play.serving import viser
from pewm_jax.play.session import Request

POSTURES: Mapping[str, Mapping[str, float]] = {
    "rest": {},
    "reach": {"shoulder_pitch": 1.0, "elbow_pitch": 0.5, "hand_closure": 0.0},
    "raise": {"shoulder_pitch": 1.7, "shoulder_roll": 0.3, "elbow_pitch": 1.2},
    "carry": {"shoulder_pitch": 0.4, "shoulder_yaw": 0.3, "elbow_pitch": 1.6, "hand_closure": 1.0},
    "look down": {"neck_pitch": 0.9},
}
"""Name → the joints that differ from rest, on both sides of the body."""
HOTKEYS = {"rest": "F", "reach": "R", "raise": "T", "carry": "C", "look down": "V"}
"""Posture → its key."""


def posture(body: Body, name: str) -> np.ndarray:
    """Return the joints (A − 2,) of one of ``POSTURES``."""
    joints = body.rest[:-2].copy()
    for end, value in POSTURES[name].items():
        for k, one in enumerate(body.freedoms[:-2]):
            if one.name in (end, f"left_{end}", f"right_{end}"):
                joints[k] = np.clip(value, one.low, one.high)
    return joints


class JointsPanel:
    """The sliders of a body; empty until ``show`` is called with the name of the model's body."""

    def __init__(self, server: viser.ViserServer, put: Callable[[Request], None]):
        """Prepare the panel of a page; ``put`` receives the requests."""
        self._server, self._put = server, put
        self._body: Body | None = None
        self._lock = threading.Lock()
        self.sliders: list[Any] = []
        self.folder = server.gui.add_folder("Body")
        self.folder.visible = False

    def show(self, name: str) -> None:
        """Add the sliders of a body, once; nothing for a model without one."""
        with self._lock:
            if not name or self._body is not None:
                return
            body = self._body = BODIES[name]
        gui = self._server.gui
        self.folder.visible = True
        with self.folder:
            gui.add_html(
                "<div style='padding:0 12px 4px;opacity:.75;font-size:12.5px;line-height:1.45'>"
                "Move a slider, or press a button: the body moves there, step by step. It walks "
                "and turns by the keys above, and does not step aside.</div>"
            )
            group = gui.add_button_group("Posture", tuple(POSTURES))
            group.on_click(lambda event: self.take(event.target.value))
            self._add_sliders(gui, body)
        self.sliders.sort(key=lambda pair: pair[0])
        for posture_name, key in HOTKEYS.items():
            command = gui.add_command(f"{posture_name} ({key})", hotkey=key)  # type: ignore[arg-type]
            command.on_trigger(lambda _, name=posture_name: self.take(name))

    def _add_sliders(self, gui: Any, body: Body) -> None:
        for title, mark in (("Left arm", "left_"), ("Right arm", "right_"), ("Torso and legs", "")):
            with gui.add_folder(title, expand_by_default=False):
                for k, one in enumerate(body.freedoms[:-2]):
                    if mark == _side(one.name):
                        self._add(gui, k, one)

    def _add(self, gui: Any, number: int, one: Any) -> None:
        label = one.name.removeprefix(_side(one.name)).replace("_", " ")
        slider = gui.add_slider(
            label, min=one.low, max=one.high, step=0.01, initial_value=round(one.rest, 2)
        )
        slider.on_update(lambda event: event.client and self._send())
        self.sliders.append((number, slider))

    def take(self, name: str) -> None:
        """Request one of ``POSTURES``, and set the sliders to it."""
        assert self._body is not None
        self.set(posture(self._body, name))
        self._send()

    def set(self, joints: np.ndarray) -> None:
        """Set the sliders to the values (A − 2,) of the joints; nothing is requested."""
        for (_, slider), value in zip(self.sliders, joints, strict=True):
            slider.value = round(float(value), 2)

    def _send(self) -> None:
        self._put(session.Pose(tuple(float(slider.value) for _, slider in self.sliders)))


def _side(name: str) -> str:
    """Return the prefix of a joint of an arm, or ""."""
    return next((side for side in ("left_", "right_") if name.startswith(side)), "")
