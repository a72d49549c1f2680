"""The parts of ``cogvideox_gpu.py`` done by diffusers, with ``torch.compile``."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from diffusers import AutoencoderKLCogVideoX, CogVideoXDDIMScheduler, CogVideoXTransformer3DModel

from pewm_jax.models.cogvideox.convert import TRANSFORMER


def timed(job: Callable[[], Any], repeats: int) -> dict[str, float]:
    """Return milliseconds (median) of a job, and the seconds of its first, compiling, call."""

    def once() -> float:
        torch.cuda.synchronize()
        start = time.perf_counter()
        job()
        torch.cuda.synchronize()
        return time.perf_counter() - start

    first = once()
    once()
    return {
        "ms": statistics.median(once() for _ in range(repeats)) * 1e3,
        "compile_s": first,
        "peak_gb": torch.cuda.max_memory_allocated() / 1e9,
    }


def network(setting: Any, dtype: torch.dtype) -> Any:
    """Return the reference transformer, random weights, on the GPU."""
    values = TRANSFORMER.write_config(setting.dit)
    settings = {k: v for k, v in values.items() if not k.startswith("_")}
    with torch.device("cuda"):
        return CogVideoXTransformer3DModel(**settings).to(dtype)


def inputs(setting: Any, batch: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return latents, text and times."""
    t, h, w, channels = setting.latents
    config = setting.dit
    like = {"device": "cuda", "dtype": torch.bfloat16}
    return (
        torch.randn(batch, t, channels, h, w, **like),
        torch.randn(batch, config.text_length, config.text_dim, **like),
        torch.full((batch,), 500, device="cuda"),
    )


def autoencoder() -> Any:
    """Return the reference autoencoder, random weights, on the GPU."""
    with torch.device("cuda"):
        return AutoencoderKLCogVideoX().to(torch.bfloat16).eval()


def measure(name: str, setting: Any) -> dict[str, float]:
    """Run one part."""
    return {"forward": forward, "train": train, "clip": clip, "decode": decode}[name](setting)


@torch.no_grad()
def forward(setting: Any) -> dict[str, float]:
    """Time the transformer on one batch."""
    run = torch.compile(network(setting, torch.bfloat16).eval())
    given = inputs(setting, setting.batch)
    found = timed(lambda: run(*given, return_dict=False), setting.repeats)
    return {**found, "flops": setting.batch * setting.flops, "batch": setting.batch}


def train(setting: Any) -> dict[str, float]:
    """Time one step of AdamW on float32 weights under autocast."""
    model = network(setting, torch.float32).train()
    run = torch.compile(model)
    adam = torch.optim.AdamW(model.parameters(), lr=1e-5, fused=True)
    latents, text, times = inputs(setting, setting.batch)

    def job() -> None:
        with torch.autocast("cuda", torch.bfloat16):
            out = run(latents, text, times, return_dict=False)[0]
        (out.float() - latents.float()).square().mean().backward()
        adam.step()
        adam.zero_grad(set_to_none=True)

    found = timed(job, setting.repeats)
    return {**found, "flops": 3 * setting.batch * setting.flops, "batch": setting.batch}


@torch.no_grad()
def clip(setting: Any) -> dict[str, float]:
    """Time one clip: encode its first frame, sample without guidance, decode."""
    run, codec = torch.compile(network(setting, torch.bfloat16).eval()), autoencoder()
    noise, text, times = inputs(setting, 1)
    scheduler = CogVideoXDDIMScheduler(
        prediction_type="v_prediction",
        rescale_betas_zero_snr=True,
        snr_shift_scale=3.0,
        timestep_spacing="trailing",
    )
    side = setting.pixels
    frame = torch.zeros(1, 3, 1, side, side, device="cuda", dtype=torch.bfloat16)

    def job() -> Any:
        x = noise.clone()
        x[:, :1] += codec.encode(frame).latent_dist.mode().transpose(1, 2)
        scheduler.set_timesteps(setting.steps, device="cuda")
        for step in scheduler.timesteps:
            out = run(x, text, step.expand(len(times)), return_dict=False)[0]
            x = scheduler.step(out, step, x, return_dict=False)[0].to(x.dtype)
        return codec.decode(x.transpose(1, 2), return_dict=False)[0]

    found = timed(job, max(1, setting.repeats // 3))
    return {**found, "flops": setting.steps * setting.flops, "batch": 1}


@torch.no_grad()
def decode(setting: Any) -> dict[str, float]:
    """Time the decoding of one clip."""
    codec = autoencoder()
    run = torch.compile(codec.decode)
    latents = inputs(setting, 1)[0].transpose(1, 2).contiguous()
    return {**timed(lambda: run(latents, return_dict=False), setting.repeats), "batch": 1}
