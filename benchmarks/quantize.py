"""What 8-bit weights cost in quality and save in memory: ``python benchmarks/quantize.py``.

The model imagines clips in held-out generated houses, after a look around, with its weights as they
are, in int8 and in fp8, with the same noise. Quality is PSNR and LPIPS (AlexNet's, if installed)
against the renderer, and PSNR against the frames of the model's own weights. ``--record`` rewrites
the section of ``RESULTS.md``.
"""

from __future__ import annotations

import argparse

import jax
import numpy as np
from record import machine, record, table

import pewm_jax
from pewm_jax.codecs.signals import rgb_from_signal
from pewm_jax.eval.metrics.images import clip_psnr
from pewm_jax.eval.metrics.perceptual import select_lpips
from pewm_jax.planning.house import HouseEnv
from pewm_jax.planning.house_config import HouseConfig
from pewm_jax.worlds import quantized

PRECISIONS = ("", "int8", "fp8")
WALK = (0, 0, 1, 0, 0, 2, 0, 1)
"""The actions of a clip: forward, turn left, turn right."""


def clips(size: tuple[int, int], houses: int) -> list[tuple]:
    """Return, for each held-out house, the observed frames and the true colours of the walk."""
    made = []
    for number in range(houses):
        env = HouseEnv(HouseConfig(house=2 + 3 * number, height=size[0], width=size[1]))
        env.reset(seed=0)
        seen, true, free = env.look_around(), [], []
        for action in WALK:
            observation, *_, info = env.step(action)
            true.append(observation["rgb"])
            free.append(not info["collision"])
        if all(free):
            made.append((seen, np.stack(true)))
    return made


def measure(model: str, houses: int) -> list[tuple[str, ...]]:
    """Return the rows of the table."""
    config, params = pewm_jax.load(model)
    size = config.model.clip.height, config.model.clip.width
    lpips, why = select_lpips("", *size)
    print(why)
    shown = clips(size, houses)
    rows, own = [], None
    for precision in PRECISIONS:
        weights = quantized.quantize(config.model, params, precision)
        share = {name: quantized.bytes_of(weights[name]) for name in weights}
        denoiser = sum(size for name, size in share.items() if name not in quantized.WHOLE)
        weights, found = jax.device_put(weights), []
        for seen, _ in shown:
            state = pewm_jax.start(config, weights, seen)
            frames = pewm_jax.imagine(config, weights, state, np.array(WALK), jax.random.key(0))[1]
            found.append(np.asarray(rgb_from_signal(frames.rgb_THWC)))
        imagined, true = np.stack(found), np.stack([true for _, true in shown])
        own = imagined if own is None else own
        distance = "" if lpips is None else f"{float(np.mean(lpips(imagined, true))):.4f}"
        rows.append(
            (
                precision or f"as stored ({config.model.dtype})",
                f"{sum(share.values()) / 1e6:.2f}",
                f"{denoiser / 1e6:.2f}",
                f"{float(np.mean(clip_psnr(imagined, true))):.2f}",
                distance,
                "" if not precision else f"{float(np.mean(clip_psnr(imagined, own))):.1f}",
            )
        )
        print(*rows[-1], sep="  ", flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="small")
    parser.add_argument("--houses", type=int, default=8)
    parser.add_argument("--record", action="store_true")
    given = parser.parse_args()
    rows = measure(given.model, given.houses)
    heads = ("weights", "MB", "of these the denoiser", "PSNR, dB", "LPIPS", "PSNR to its own, dB")
    text = table(heads, rows)
    print(text)
    if given.record:
        about = f"{given.model}, clips of {len(WALK)} frames in held-out houses. {machine('jax')}"
        record("quantize", f"{about}\n\n{text}")


if __name__ == "__main__":
    main()
