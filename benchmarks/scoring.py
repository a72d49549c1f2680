"""Where the time of an evaluation goes: the sampler or the measures; and LPIPS beside torch's.

`python benchmarks/scoring.py` takes the model that comes with the library and walks through houses
made here, and times the pieces of a report in turn: imagining a batch of clips with the map and
without, reading it with its masks of what was seen before, PSNR, SSIM, errors of depth and LPIPS of
it, and, beside what a report has by default, the features of I3D for FVD. Goal: at least 90 % of
the time in the sampler with PSNR, SSIM and LPIPS on.

LPIPS (AlexNet) is timed on the same pairs of frames beside the same network in torch, with the same
weights; both must agree. ``--smoke`` shows with few clips that it runs.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import torch
from record import machine, record, table

import pewm_jax
from pewm_jax.config import Config, UserError
from pewm_jax.data.episodes import Episode, read_episode
from pewm_jax.data.make_episode import CollectConfig, make_episode
from pewm_jax.eval import metrics
from pewm_jax.eval.clips import choose
from pewm_jax.eval.metrics import VideoDistance
from pewm_jax.eval.metrics.videos import read_i3d as read_video
from pewm_jax.eval.reproject import ReprojectSettings
from pewm_jax.eval.runner import Methods, ModelRunner
from pewm_jax.eval.scoring import load_batch
from pewm_jax.io import tree
from pewm_jax.models.i3d import convert as i3d_weights
from pewm_jax.models.i3d import model as i3d
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.types import Params

SAMPLER, EMPTY = "sampler, with the map", "sampler, without"
READING, PLAIN = "reading clips and masks", "PSNR, SSIM, depth"
TRUTH, LPIPS = "LPIPS (AlexNet), the truth's pass", "LPIPS (AlexNet), of a method"
I3D = "I3D for FVD and KVD (off by default on processors)"
USES = {SAMPLER: 3, EMPTY: 3, READING: 1, PLAIN: 2 * 3 + 2, TRUTH: 1, LPIPS: 2 * 3 + 2}
"""How often each is done for a batch of clips in a report by default: three sampling seeds with the
map and without, two methods without a network; clips are read once, and their truth passes LPIPS's
network once."""
VIDEOS = 5
"""How often clips pass I3D where FVD is asked for: those of two methods with a network and of two
without, of the first sampling seed, and the truth."""
CUTS = (2, 5, 8, 10, 12)
"""Where torchvision's AlexNet is cut (lpips/pretrained_networks.py)."""


class TorchLPIPS(torch.nn.Module):
    """``lpips.LPIPS(net="alex")``, version 0.1, with our parameters."""

    def __init__(self, params: Params):
        super().__init__()
        nn = torch.nn
        sizes = [(3, 64, 11, 4, 2), (64, 192, 5, 1, 2), (192, 384, 3, 1, 1)]
        sizes += [(384, 256, 3, 1, 1), (256, 256, 3, 1, 1)]
        self.slices = nn.ModuleList()
        for k, (inward, outward, side, stride, around) in enumerate(sizes):
            layer = nn.Conv2d(inward, outward, side, stride=stride, padding=around)
            part = params["net"][f"conv_{k}"]
            with torch.no_grad():
                layer.weight.copy_(torch.tensor(np.array(part["kernel"]).transpose(3, 2, 0, 1)))
                layer.bias.copy_(torch.tensor(np.array(part["bias"])))
            pool = [nn.MaxPool2d(3, 2)] if k in (1, 2) else []
            self.slices.append(nn.Sequential(*pool, layer, nn.ReLU(inplace=True)))
        self.lins = [
            torch.tensor(np.array(params["lin"][f"layer_{k}"]))[None, :, None, None]
            for k in range(len(CUTS))
        ]
        self.shift = torch.tensor([-0.030, -0.088, -0.188])[None, :, None, None]
        self.scale = torch.tensor([0.458, 0.448, 0.450])[None, :, None, None]

    def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        """Return the distances of pictures (N, 3, H, W) in [−1, 1], (N,)."""
        total = torch.zeros(len(a))
        a, b = ((x - self.shift) / self.scale for x in (a, b))
        for part, lin in zip(self.slices, self.lins, strict=True):
            a, b = part(a), part(b)
            one, two = (x / (torch.sqrt((x**2).sum(1, keepdim=True)) + 1e-10) for x in (a, b))
            total = total + (lin * (one - two) ** 2).sum(1).mean((1, 2))
        return total


def houses(config: Config, count: int) -> list[Episode]:
    """Return walks through houses, each out and back."""
    size, frames = config.model.clip.height, 2 * (config.data.context + config.model.clip.frames)
    settings = CollectConfig(Path("unused"), frames=max(frames, 48), size=size)
    return [read_episode(make_episode(settings, "revisit", index)) for index in range(count)]


def parts(clips: int) -> tuple[dict[str, Callable[[], object]], Any, Any]:
    """Return what is timed of one batch of clips, and its imagined and true frames."""
    config, params = pewm_jax.load("small")
    evaluate = dataclasses.replace(config.evaluate, batch=clips)
    config = dataclasses.replace(config, evaluate=evaluate)
    episodes = houses(config, 2)
    choices = choose(config, episodes, clips, 1)
    model = ModelRunner(config, params, clips, config.data.context)
    methods = Methods(model, ReprojectSettings())
    methods.prepare(["memory", "empty"])
    batch = load_batch(config, episodes, choices, 0, cameras=False)
    frames = batch.imagine(methods, "memory", 0)[2]
    lpips = metrics.load("lpips_alex")
    assert isinstance(lpips, LPIPS)

    def read() -> Any:
        """Read a batch, and wait for what has been seen before."""
        made = load_batch(config, episodes, choices, 0, cameras=False)
        return made.seen, made.unseen

    apart = lpips.towards(batch.targets.rgb_THWC)

    def described() -> Any:
        return lpips.described(batch.targets.rgb_THWC)

    runs: dict[str, Callable[[], object]] = {
        SAMPLER: lambda: batch.imagine(methods, "memory", 0),
        EMPTY: lambda: batch.imagine(methods, "empty", 0),
        READING: read,
        PLAIN: lambda: batch.sums(frames, None),
        TRUTH: described,
        LPIPS: lambda: apart(frames.rgb_THWC),
    }
    distance, whole = _i3d(), batch.whole(frames.rgb_THWC)
    runs[I3D] = lambda: distance.features(whole)
    return runs, frames.rgb_THWC, batch.targets.rgb_THWC


def _i3d() -> VideoDistance:
    """Return FVD with the installed weights, or, for the time alone, with ones of its shapes."""
    path = i3d_weights.installed()
    if path is not None:
        return read_video(path, "fvd")
    params = {name: np.full(shape, 0.01, np.float32) for name, shape in i3d.shapes().items()}
    return VideoDistance("fvd", tree.unflatten(params))


def peers(imagined: Any, truth: Any) -> dict[str, Callable[[], object]]:
    """Return LPIPS of the same pairs of frames, ours and torch's, which agree."""
    net, params = lpips_weights.read(lpips_weights.find("alex"), "alex")
    ours = LPIPS(net, jax.device_put(params))
    reference = TorchLPIPS(params).eval()
    flat = [np.asarray(x).reshape(-1, *x.shape[-3:]) for x in (imagined, truth)]
    flat = [x / 127.5 - 1 if x.dtype == np.uint8 else np.clip(x, -1, 1) for x in flat]
    pairs = [np.float32(x) for x in flat]
    tensors = [torch.tensor(x.transpose(0, 3, 1, 2)) for x in pairs]
    clips = [x[None] for x in pairs]

    def theirs() -> np.ndarray:
        with torch.no_grad():
            return reference(*tensors).numpy()

    def mine() -> np.ndarray:
        return np.asarray(ours.frames(*clips))[0]

    np.testing.assert_allclose(mine(), theirs(), rtol=1e-3, atol=1e-5)
    return {"pewm_jax": mine, "torch": theirs}


def timed(runs: dict[str, Callable[[], object]], repeats: int) -> dict[str, list[float]]:
    """Return the seconds of every run of everything, in turn; the first, which compiles, not."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(repeats + 1):
        for name, run in runs.items():
            begin = time.perf_counter()
            jax.block_until_ready(run())
            if turn:
                times[name].append(time.perf_counter() - begin)
    return times


def main() -> None:
    """Measure, print, and record if asked."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--batch", type=int, default=16, help="clips imagined at once")
    parser.add_argument("--smoke", action="store_true", help="few clips, once; nothing is kept")
    parser.add_argument("--record", action="store_true", help="rewrite this section of RESULTS.md")
    options = parser.parse_args()
    if lpips_weights.installed("alex") is None:
        raise UserError(f"no weights of LPIPS are installed: {lpips_weights.INSTALL}.")
    clips, repeats = (2, 1) if options.smoke else (options.batch, max(5, options.repeats))
    runs, imagined, truth = parts(clips)
    spent = {name: statistics.median(each) for name, each in timed(runs, repeats).items()}
    whole = {name: USES[name] * spent[name] for name in USES}
    total = sum(whole.values())
    rows = [
        [
            name,
            f"{1e3 * seconds:.0f} ms",
            str(USES.get(name, "–")),
            f"{whole[name] / total:.1%}" if name in USES else "–",
        ]
        for name, seconds in spent.items()
    ]
    frames = clips * imagined.shape[1]
    head = [f"{clips} clips, {frames} frames", "once", "times in a report", "share of its time"]
    first = table(head, rows)
    share = (whole[SAMPLER] + whole[EMPTY]) / total
    asked = (whole[SAMPLER] + whole[EMPTY]) / (total + VIDEOS * spent[I3D])
    words = (
        f"In the sampler: {share:.1%} (goal ≥ 90 %). Where FVD is asked for on these processors "
        f"({VIDEOS} times I3D a batch: four methods and the truth), {asked:.1%}."
    )
    both = timed(peers(imagined, truth), repeats)
    ratio = statistics.median(b / a for a, b in zip(both["pewm_jax"], both["torch"], strict=True))
    middle = {name: statistics.median(each) for name, each in both.items()}
    second = table(
        [f"LPIPS of {frames} pairs of frames", "pewm_jax", "torch", "torch over pewm_jax"],
        [["AlexNet", *(f"{1e3 * middle[name]:.0f} ms" for name in middle), f"{ratio:.2f}×"]],
    )
    print(first, words, second, sep="\n\n", flush=True)
    if options.record and not options.smoke:
        how = (
            f"`python benchmarks/scoring.py --record`: the shipped model, medians of {repeats} in "
            f"turn; torch on {torch.get_num_threads()} threads. {machine('jax', 'torch', 'numpy')}."
        )
        record(
            "scoring",
            "\n\n".join(["## Where an evaluation's time goes", how, first, words, second]),
        )


if __name__ == "__main__":
    main()
