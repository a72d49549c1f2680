"""What the tests of PERSIST's networks share."""

import jax
import jax.numpy as jnp
import numpy as np


def weights(module, config, seed=0, scale=0.3):
    """Return random parameters without compiling anything; nothing is zero, gates included."""
    shapes = jax.eval_shape(lambda: module.init(config, jax.random.key(0)))
    rng = np.random.default_rng(seed)

    def draw(path, leaf):
        low = 1.0 if jax.tree_util.keystr(path).endswith(("['scale']", "scale_C']")) else 0.0
        return jnp.asarray(low + scale * rng.normal(size=leaf.shape), jnp.float32)

    return jax.tree_util.tree_map_with_path(draw, shapes)


def normal(seed, *shape):
    """Return normal numbers."""
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)
