"""Procedural images for walls, floors, ceilings, rugs and pictures.

Details are 5 cm and larger with soft contrast, so that images of 64 pixels do not flicker.
Surface textures tile; 64 texels are one metre.
"""

from __future__ import annotations

import colorsys

import cv2
import numpy as np

TEXELS_PER_M = 64
Rgb = np.ndarray
"""(3,) red, green, blue in [0, 1]."""


def hsv(hue: float, saturation: float, value: float) -> Rgb:
    """Return the RGB colour of hue (1 = full circle), saturation and value."""
    return np.array(colorsys.hsv_to_rgb(hue % 1.0, np.clip(saturation, 0, 1), np.clip(value, 0, 1)))


def shade(colour: Rgb, factor: float) -> Rgb:
    """Return a darker (< 1) or lighter (> 1) version of a colour."""
    return np.clip(np.asarray(colour) * factor, 0, 1)


def _bytes(image_HW3: np.ndarray) -> np.ndarray:
    return (np.clip(image_HW3, 0, 1) * 255 + 0.5).astype(np.uint8)


def _noise(rng: np.random.Generator, height: int, width: int, cells: int) -> np.ndarray:
    """Return (height, width) smooth tiling noise in about [−1, 1] with that many bumps across."""
    rows = max(2, round(cells * height / width))
    grid = np.pad(rng.uniform(-1, 1, (rows, cells)), 2, mode="wrap").astype(np.float32)
    step_y, step_x = height // rows, width // cells
    big = cv2.resize(
        grid, (grid.shape[1] * step_x, grid.shape[0] * step_y), interpolation=cv2.INTER_CUBIC
    )
    big = big[2 * step_y : -2 * step_y, 2 * step_x : -2 * step_x]
    return big if big.shape == (height, width) else cv2.resize(big, (width, height))


def _paint(image_HW3: np.ndarray, mask_HW: np.ndarray, colour: Rgb | float) -> np.ndarray:
    """Return an image that has another colour, or another image, in a mask."""
    return np.where(mask_HW[..., None], colour, image_HW3)


def _unit(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (y, x) of a square image from its top left, 0 to 1, texel centres."""
    y, x = (np.mgrid[0:side, 0:side] + 0.5) / side
    return y, x


def _grid(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (y, x) in metres from the top left, texel centres."""
    y, x = np.mgrid[0:height, 0:width]
    return (y + 0.5) / TEXELS_PER_M, (x + 0.5) / TEXELS_PER_M


def wall(rng: np.random.Generator, colour: Rgb, height_m: float, style: str) -> np.ndarray:
    """Return a wall covering 2 m wide that spans the room's height.

    The style is plaster, stripes, wainscot, diamonds, bricks or band.
    """
    height, width = round(height_m * TEXELS_PER_M), 2 * TEXELS_PER_M
    y, x = _grid(height, width)
    up = height_m - y
    image = np.broadcast_to(colour, (height, width, 3)) * (
        1 + 0.035 * _noise(rng, height, width, 6)[..., None]
    )
    darker, lighter = shade(colour, 0.74), np.clip(np.asarray(colour) * 0.55 + 0.45, 0, 1)
    if style == "stripes":
        mask = 0.5 + 0.5 * np.tanh(8 * np.sin(2 * np.pi * x / 0.5))
        image = image * (1 - 0.16 * mask[..., None])
    elif style == "wainscot":
        image = _paint(image, up < 0.95, image * darker / np.asarray(colour).clip(0.05))
        image = _paint(image, np.abs(up - 0.95) < 0.05, lighter)
    elif style == "band":
        image = _paint(image, up > 1.55, lighter * (0.2 * image + 0.8))
        image = _paint(image, np.abs(up - 1.55) < 0.06, darker)
    elif style == "diamonds":
        d = np.abs((x / 0.5) % 1 - 0.5) + np.abs((up / 0.65) % 1 - 0.5)
        image = image * (1 - 0.18 * (d < 0.26)[..., None])
    elif style == "bricks":
        row = np.floor(up / 0.2)
        along = x / 0.5 + 0.5 * (row % 2)
        tones = rng.uniform(0.86, 1.1, (64, 4))
        image = image * tones[row.astype(int) % 64, np.floor(along).astype(int) % 4][..., None]
        mortar = ((up % 0.2) < 0.03) | ((along % 1) < 0.06)
        image = _paint(image, mortar, 0.35 * image + 0.65 * lighter * 0.9)
    return _bytes(image)


def floor(rng: np.random.Generator, colour: Rgb, style: str) -> np.ndarray:
    """Return a 2 m × 2 m floor covering: planks, herringbone, tiles, checks or carpet."""
    side = 2 * TEXELS_PER_M
    y, x = _grid(side, side)
    if style == "planks":
        row = np.floor(x / 0.2).astype(int)
        along = y + rng.uniform(0, 2, 10)[row % 10]
        plank = np.floor(along).astype(int) % 2
        tone = rng.uniform(0.82, 1.1, (10, 2))[row % 10, plank]
        grain = 0.05 * cv2.resize(_noise(rng, side // 8, side, 32), (side, side))
        seam = ((x % 0.2) < 0.02) | ((along % 1) < 0.02)
        value = (tone + grain) * np.where(seam, 0.72, 1.0)
    elif style == "parquet":
        block = (np.floor(x / 0.5) + np.floor(y / 0.5)).astype(int) % 2
        strip = np.where(block == 0, np.floor(x / 0.125), np.floor(y / 0.125)).astype(int)
        cell = np.floor(x / 0.5).astype(int) + 4 * np.floor(y / 0.5).astype(int)
        value = rng.uniform(0.84, 1.1, (16, 16))[cell % 16, strip % 16]
        value = value * np.where(block == 0, 1.0, 0.9)
    elif style in {"tiles", "checks"}:
        size = 0.5 if style == "checks" else 0.4
        i, j = np.floor(x / size).astype(int), np.floor(y / size).astype(int)
        value = rng.uniform(0.94, 1.05, (5, 5))[i % 5, j % 5]
        if style == "checks":
            value = value * np.where((i + j) % 2 == 0, 1.0, 0.66)
        grout = ((x % size) < 0.025) | ((y % size) < 0.025)
        value = np.where(grout, value * 0.78, value)
    else:
        value = 1 + 0.05 * _noise(rng, side, side, 12) + 0.04 * _noise(rng, side, side, 5)
    return _bytes(np.asarray(colour) * value[..., None])


def ceiling(rng: np.random.Generator, colour: Rgb, style: str) -> np.ndarray:
    """Return a 2 m × 2 m ceiling: plain, panels or beams."""
    side = 2 * TEXELS_PER_M
    y, x = _grid(side, side)
    value = 1 + 0.02 * _noise(rng, side, side, 4)
    if style == "panels":
        value = value * np.where(((x % 1) < 0.05) | ((y % 1) < 0.05), 0.86, 1.0)
    elif style == "beams":
        value = value * np.where((x % 1) < 0.16, 0.7, 1.0)
    return _bytes(np.asarray(colour) * value[..., None])


def rug(rng: np.random.Generator, hue: float) -> np.ndarray:
    """Return a rug: a border around stripes, a medallion, a chequer or plain pile."""
    side = 96
    y, x = (np.mgrid[0:side, 0:side] + 0.5) / side * 2 - 1
    base = hsv(hue, rng.uniform(0.5, 0.8), rng.uniform(0.45, 0.8))
    other_hue = hue + rng.choice([0.08, 0.33, 0.5])
    second = hsv(other_hue, rng.uniform(0.3, 0.6), rng.uniform(0.75, 0.95))
    third = hsv(hue + 0.02, 0.7, 0.32)
    kind = rng.integers(4)
    if kind == 0:
        mask = (np.floor((y + 1) * rng.integers(3, 5)) % 2).astype(bool)
    elif kind == 1:
        mask = (x**2 + y**2 < 0.32) ^ (x**2 + y**2 < 0.1)
    elif kind == 2:
        mask = (np.abs(x) + np.abs(y)) % 0.7 < 0.35
    else:
        mask = np.zeros_like(x, bool)
    image = np.where(mask[..., None], second, base)
    edge = np.maximum(np.abs(x), np.abs(y))
    image = _paint(_paint(image, edge > 0.78, third), edge > 0.92, second)
    return _bytes(image * (1 + 0.04 * _noise(rng, side, side, 12)[..., None]))


def picture(rng: np.random.Generator) -> np.ndarray:
    """Return a framed painting: a landscape, blocks, circles, waves or a face."""
    side = 64
    y, x = _unit(side)
    hue = rng.uniform()
    kind = rng.integers(5)
    image = np.broadcast_to(hsv(hue, 0.35, 0.9), (side, side, 3)).copy()
    if kind == 0:
        sky_high, sky_low = hsv(0.58, 0.6, 0.85), hsv(rng.uniform(0, 0.15), 0.45, 1.0)
        image = sky_high + (sky_low - sky_high) * y[..., None]
        sun_x, sun_y = rng.uniform(0.2, 0.8), rng.uniform(0.2, 0.4)
        image[(x - sun_x) ** 2 + (y - sun_y) ** 2 < 0.012] = [1, 0.93, 0.6]
        for k, level in enumerate((0.5, 0.64, 0.8)):
            ridge = level + 0.09 * np.sin(2 * np.pi * (x * rng.uniform(0.6, 1.6) + rng.uniform()))
            image[y > ridge] = hsv(0.3 + 0.05 * k + 0.2 * hue, 0.5, 0.65 - 0.16 * k)
    elif kind == 1:
        for _ in range(5):
            x0, y0 = rng.uniform(0, 0.8, 2)
            w, h = rng.uniform(0.2, 0.6, 2)
            inside = (x > x0) & (x < x0 + w) & (y > y0) & (y < y0 + h)
            image[inside] = hsv(hue + rng.choice([0, 0.15, 0.5, 0.6]), 0.75, rng.uniform(0.3, 0.95))
    elif kind == 2:
        cx, cy = rng.uniform(0.35, 0.65, 2)
        ring = np.floor(np.hypot(x - cx, y - cy) / 0.13).astype(int) % 4
        image = np.stack([hsv(hue + 0.13 * k, 0.7, 0.9 - 0.15 * k) for k in range(4)])[ring]
    elif kind == 3:
        wave = y + 0.08 * np.sin(2 * np.pi * (x * 1.5 + rng.uniform()))
        bands = np.stack([hsv(hue + 0.09 * k, 0.6, 0.4 + 0.13 * k) for k in range(5)])
        image = bands[np.floor(wave * 5).astype(int) % 5]
    else:
        image[(y > 0.72) & (np.abs(x - 0.5) < 0.32)] = hsv(hue + 0.5, 0.7, 0.45)
        face = ((x - 0.5) / 0.17) ** 2 + ((y - 0.48) / 0.23) ** 2
        hair = ((x - 0.5) / 0.22) ** 2 + ((y - 0.42) / 0.27) ** 2
        image[hair < 1] = hsv(0.07, 0.7, rng.uniform(0.15, 0.5))
        image[face < 1] = hsv(0.07, rng.uniform(0.25, 0.5), rng.uniform(0.6, 0.95))
    frame = np.maximum(np.abs(x - 0.5), np.abs(y - 0.5)) > 0.44
    image[frame] = hsv(0.09, 0.55, rng.choice([0.2, 0.45, 0.75]))
    return _bytes(image)


def window_view(rng: np.random.Generator) -> np.ndarray:
    """Return the view out of a window: a bright sky over hills, behind a window cross."""
    side = 64
    y, x = _unit(side)
    above, below = np.array([0.62, 0.82, 1.0]), np.array([0.95, 0.98, 1.0])
    image = above + (below - above) * y[..., None]
    image = image + 0.12 * np.clip(0.5 * _noise(rng, side, side, 4), 0, 1)[..., None]
    ridge = 0.68 + 0.07 * np.sin(2 * np.pi * (x * rng.uniform(0.7, 1.4) + rng.uniform()))
    image = _paint(image, y > ridge, hsv(rng.uniform(0.22, 0.36), 0.45, 0.68))
    return _bytes(_paint(image, (np.abs(x - 0.5) < 0.03) | (np.abs(y - 0.45) < 0.03), 0.97))


def screen(rng: np.random.Generator) -> np.ndarray:
    """Return a television's picture: a dim gradient with a few bright shapes."""
    y, x = _unit(32)
    hue = rng.uniform()
    dim = hsv(hue, 0.7, 0.28)
    image = dim + (hsv(hue + 0.15, 0.6, 0.55) - dim) * (x + y)[..., None] / 2
    spot = (x - 0.4) ** 2 + (y - 0.5) ** 2 < 0.05
    return _bytes(_paint(image, spot, hsv(hue + 0.45, 0.4, 0.85)))
