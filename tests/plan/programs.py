"""Run on eight virtual devices by ``test_sums``: compiles small steps that could run.

Prints as JSON, for each, what the compiled program does and needs, and what is expected of it from
jaxpr and shapes.
"""

import json
import sys
from typing import Literal

from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import ClipConfig, Config, DataConfig, MeshConfig, StageConfig, TrainConfig
from pewm_jax.encoders.simple import PatchColoursConfig
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.models.cogvideox import model as dit
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.cogvideox.vae import VAECodec
from pewm_jax.models.dinov2.config import DINOv2Config
from pewm_jax.models.dinov2.model import DINOv2EncoderConfig
from pewm_jax.plan import measure, suggest
from pewm_jax.plan.measure import MeshSizes
from pewm_jax.plan.program import COLLECTIVES
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.readers.render import BothConfig
from pewm_jax.train import chips
from pewm_jax.worlds.pewm.world import PEWM, STAGES

DINOV2 = DINOv2Config(layers=2, heads=2, width=64, pretrained_size=56)
ENCODERS = {
    "codec": VAECodec(widths=(16, 16, 32, 32), groups=16, resnets=1),
    "encoder": DINOv2EncoderConfig(size=56, network=DINOV2),
}
FSDP = MeshConfig(fsdp=8)
TENSOR = MeshConfig(fsdp=4, tensor=2)
CONTEXT = MeshConfig(fsdp=2, context=4)

VARIANTS = {
    "stage 1, deeper and narrower, kept": (
        1,
        {"layers": 4, "heads": 8, "batch": 16, "remat": False},
    ),
    "stage 2 with VAE and DINOv2": (2, {"size": 64, "batch": 4, **ENCODERS}),
    "stage 2, fsdp 8, bfloat16": (2, {"mesh": FSDP, "batch": 16, "layers": 4, "dtype": "bfloat16"}),
    "stage 2, tensor 2 × fsdp 4": (2, {"mesh": TENSOR, "batch": 16}),
    "stage 2, both readers": (2, {"layers": 4, "both": True}),
    "stage 1, context 4 × fsdp 2": (1, {"mesh": CONTEXT, "batch": 16, "heads": 8}),
}
"""Name → stage and what differs from the defaults of ``experiment``."""


def experiment(
    layers=2,
    heads=16,
    batch=8,
    remat=True,
    mlp=2,
    tokens=64,
    size=32,
    dtype: Literal["float32", "bfloat16"] = "float32",
    mesh=None,
    codec=None,
    encoder=None,
    both=False,
):
    """Return a small experiment."""
    stage = StageConfig(batch=batch)
    kind = BothConfig if both else AttentionConfig
    reader = kind(heads=8, head_dim=16, mlp_ratio=mlp, positions="sinusoid")
    memory = VoxelConfig(tokens=tokens, encoder=encoder or PatchColoursConfig(), reader=reader)
    backbone = DiTBackbone(
        layers=layers,
        heads=heads,
        head_dim=32,
        text_length=16,
        text_dim=64,
        time_dim=64,
        remat=remat,
    )
    return Config(
        model=PEWM(
            clip=ClipConfig(frames=9, height=size, width=size),
            codec=codec or PixelConfig(spatial=2),
            backbone=backbone,
            memory=memory,
            dtype=dtype,
        ),
        data=DataConfig(context=2),
        train=TrainConfig(stage1=stage, stage2=stage, mesh=mesh or MeshConfig()),
    )


def compare(number, settings, devices):
    """Compile a variant; returns what was counted and what was expected."""
    config = experiment(**settings)
    stage = STAGES[number - 1]
    used = devices if "mesh" in settings else devices[:1]
    mesh = MeshSizes(*config.train.mesh.shape(len(used)))
    traced = measure.trace(config, stage, used)
    compiled = measure.compile_traced(traced, mesh)
    work = measure.work_of(config, stage, traced, None)
    sent = suggest.Job(config, stage, chips.named("h200"), work, compiled).traffic(mesh)
    return {
        "flops": compiled.program.flops,
        "flops_expected": sum(work.on_device(mesh).values()),
        "sent": {kind: compiled.program.sent(kind) for kind in COLLECTIVES},
        "sent_expected": {
            kind: sum(size for (one, _), size in sent.items() if one == kind)
            for kind in COLLECTIVES
        },
        "unknown": compiled.program.unknown,
        "state": compiled.arguments,
        "state_expected": suggest.memory_of(config, stage, mesh).state,
    }


def main(names):
    # Only on a CPU are small networks unrolled; XLA then drops work of the first layer that the
    # loop on other chips does, and that the count includes.
    dit.UNROLLED = 0
    devices = measure.virtual(8)
    chosen = {name: VARIANTS[name] for name in names or VARIANTS}
    measured = {
        name: compare(number, dict(settings), devices)
        for name, (number, settings) in chosen.items()
    }
    print(json.dumps(measured))


if __name__ == "__main__":
    main(sys.argv[1:])
