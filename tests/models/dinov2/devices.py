"""Run on eight simulated devices by ``test_model``: one batch on one and on all."""

import os

os.environ["XLA_FLAGS"] = " ".join(
    (os.environ.get("XLA_FLAGS", ""), "--xla_force_host_platform_device_count=8")
)

import jax
import numpy as np

from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.models.dinov2.config import DINOv2Config
from pewm_jax.nn import attention as blocked_attention

blocked_attention.LOGITS = 64  # a few tokens are cut like a thousand
config = DINOv2Config(layers=2, heads=2, width=16, pretrained_size=42, registers=1)
params = jax.jit(dinov2.init, static_argnums=0)(config, jax.random.key(0))
frames = np.random.default_rng(0).uniform(-1, 1, (16, 30, 40, 3)).astype(np.float32)


@jax.jit
def encode(params, rgb_BHWC):
    return dinov2.apply(config, params, dinov2.preprocess(rgb_BHWC, (28, 42)))


mesh = jax.make_mesh((8,), ("batch",), axis_types=(jax.sharding.AxisType.Auto,))
of_batch = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("batch"))
everywhere = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
one = encode(params, frames)
spread = jax.device_put(frames, of_batch)
program = encode.lower(jax.device_put(params, everywhere), spread).compile()
eight = program(jax.device_put(params, everywhere), spread)
assert eight.sharding.is_equivalent_to(of_batch, eight.ndim), eight.sharding
talk = [word for word in ("all-gather", "all-reduce", "all-to-all") if word in program.as_text()]
assert not talk, talk
np.testing.assert_allclose(eight, one, rtol=1e-5, atol=1e-5)
print(f"{len(eight.sharding.device_set)} devices, equal")
