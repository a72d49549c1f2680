"""The image of a step: the imagined frame, the ground truth and the frame without memory."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from PIL import Image, ImageDraw

from pewm_jax.play import places
from pewm_jax.play.engine import Engine
from pewm_jax.play.session import Session, pose
from pewm_jax.report.pictures import as_bytes, write
from pewm_jax.types import Camera

DARK, TILE, LIGHT, QUIET, ACCENT = (
    (17, 20, 26),
    (28, 33, 42),
    (236, 240, 246),
    (140, 150, 166),
    (96, 200, 255),
)
"""Colours of the background, empty images, text, secondary text, and of imagined frames."""
WIDTH, GAP, LINE = 720, 12, 30
"""Width of a board, space between images, and height of a caption, pixels."""


@dataclasses.dataclass(frozen=True, eq=False)
class Pictures:
    """The frames of a step; uint8 (H, W, 3).

    Attributes:
        imagined: the frame imagined with memory.
        truth: the ground truth; None if it is unknown.
        blind: the frame imagined without memory; None for a model that has no memory.
        observed: whether ``imagined`` is an observed frame, before the first step.
    """

    imagined: np.ndarray
    truth: np.ndarray | None
    blind: np.ndarray | None
    observed: bool


def pictures(engine: Engine, session: Session) -> Pictures:
    """Return the present frames of a drive."""
    camera = session.world.frame.camera
    here = Camera(np.asarray(camera.intrinsics_4), pose(session)[None])
    posture = None if session.state_A is None else (session.planar_3, session.state_A)
    real = places.truth(session.place, here, *engine.size, posture)
    blind = as_bytes(np.asarray(session.blind.frame.rgb_THWC[0])) if engine.has_memory else None
    return Pictures(
        as_bytes(np.asarray(session.world.frame.rgb_THWC[0])),
        None if real is None else real.rgb_THWC[0],
        blind,
        session.observed,
    )


def board(shown: Pictures, name: str) -> np.ndarray:
    """Draw a step of a model as one uint8 image with even sides."""
    tall, wide = shown.imagined.shape[:2]
    below = [("truth", shown.truth), ("without memory", shown.blind)]
    below = [(caption, image) for caption, image in below if image is not None]
    half = (WIDTH - GAP) // 2
    high, low = round(WIDTH * tall / wide), round(half * tall / wide) if below else 0
    height = LINE + high + (LINE + low if below else 0)
    canvas = Image.new("RGB", (WIDTH, height + height % 2), DARK)
    draw = ImageDraw.Draw(canvas)
    title = "observed" if shown.observed else f"imagined by {name}"
    draw.ellipse([4, LINE / 2 - 5, 14, LINE / 2 + 5], fill=QUIET if shown.observed else ACCENT)
    write(draw, (24, LINE / 2), title, size=18, colour=LIGHT)
    canvas.paste(_large(shown.imagined, (WIDTH, high)), (0, LINE))
    for number, (caption, image) in enumerate(below):
        left, top = number * (half + GAP), LINE + high
        write(draw, (left + 2, top + LINE / 2), caption, size=16, colour=QUIET)
        canvas.paste(_large(image, (half, low)), (left, top + LINE))
    return np.asarray(canvas)


def waiting(text: str) -> np.ndarray:
    """Draw a board with a waiting message."""
    canvas = Image.new("RGB", (WIDTH, LINE + WIDTH), DARK)
    draw = ImageDraw.Draw(canvas)
    draw.rectangle([0, LINE, WIDTH, LINE + WIDTH], fill=TILE)
    write(draw, (WIDTH / 2, LINE + WIDTH / 2), text, size=22, colour=QUIET, anchor="mm")
    return np.asarray(canvas)


def _large(image: np.ndarray, size: tuple[int, int]) -> Image.Image:
    """Enlarge an image smoothly and sharpen it a little."""
    big = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)
    soft = cv2.GaussianBlur(big, (0, 0), size[0] / image.shape[1] / 2)
    return Image.fromarray(cv2.addWeighted(big, 1.4, soft, -0.4, 0))
