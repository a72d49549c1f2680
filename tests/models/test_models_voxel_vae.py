"""The autoencoder of voxels: equal to torch, whatever the form, and what it refuses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from jax.sharding import PartitionSpec as P

from pewm_jax import tree
from pewm_jax.config import ConfigError, UserError, VoxelVAEConfig
from pewm_jax.models import voxel_vae, voxel_vae_shapes
from pewm_jax.models.costs import Share
from tests.helpers import randomise

LIKE_PUBLISHED = VoxelVAEConfig(
    side=8,
    classes=7,
    embed=4,
    widths=(4, 6, 8),
    blocks=1,
    middle=1,
    latent_channels=3,
    convolution="xla",
)
FOLDED = VoxelVAEConfig(
    side=8, classes=7, patch=4, embed=3, widths=(12,), blocks=1, middle=1, kernel=1,
    latent_channels=4, occupied_weight=3.0,
)  # fmt: skip


@pytest.fixture(scope="module", params=[LIKE_PUBLISHED, FOLDED], ids=["published", "folded"])
def net(request):
    config = request.param
    params = randomise(jax.jit(voxel_vae.init, static_argnums=0)(config, jax.random.key(0)))
    params["latent_scale_C"] = jnp.abs(params["latent_scale_C"]) + 0.5
    return config, params


def grids(config, batch=2, seed=0):
    rng = np.random.default_rng(seed)
    return rng.integers(0, config.classes, (batch, *(config.side,) * 3)).astype(np.uint8)


def torch_blocks(config, params):
    """The network in torch, one-hot ids and all; returns (moments, logits) as functions."""
    leaf = {path: torch.tensor(np.asarray(x)) for path, x in tree.flatten(params).items()}

    def conv(path, x, stride=1):
        kernel = leaf[f"{path}/kernel"]
        kernel = kernel[None, None, None] if kernel.ndim == 2 else kernel
        bias = leaf.get(f"{path}/bias")
        return F.conv3d(x, kernel.permute(4, 3, 0, 1, 2), bias, stride, kernel.shape[0] // 2)

    def norm(path, x):
        scale, bias = leaf[f"{path}/scale"], leaf[f"{path}/bias"]
        moved = F.layer_norm(x.movedim(1, -1), scale.shape, scale, bias, 1e-5)
        return F.silu(moved).movedim(-1, 1)

    def block(path, x):
        inner = conv(f"{path}/one", norm(f"{path}/norm_one", x))
        inner = conv(f"{path}/two", norm(f"{path}/norm_two", inner))
        return inner + (conv(f"{path}/past", x) if f"{path}/past/kernel" in leaf else x)

    def fold(x, p):
        b, c, n = x.shape[:3]
        x = x.reshape(b, c, n // p, p, n // p, p, n // p, p)
        return x.permute(0, 1, 3, 5, 7, 2, 4, 6).reshape(b, c * p**3, *(n // p,) * 3)

    def unfold(x, p):
        b, c, n = x.shape[:3]
        x = x.reshape(b, c // p**3, p, p, p, n, n, n)
        return x.permute(0, 1, 5, 2, 6, 3, 7, 4).reshape(b, c // p**3, *(n * p,) * 3)

    levels, last = len(config.widths), len(config.widths) - 1

    def moments(ids):
        hot = F.one_hot(torch.tensor(ids.astype(np.int64)), config.classes).float()
        x = conv("encoder/embed", hot.movedim(-1, 1))
        if config.patch > 1:
            x = conv("encoder/into", fold(x, config.patch))
        for level in range(levels):
            for k in range(config.blocks):
                x = block(f"encoder/level_{level}/block_{k}", x)
            if level < last:
                x = conv(f"encoder/level_{level}/down", x, 2)
        for k in range(config.middle):
            x = block(f"encoder/middle_{k}", x)
        return conv("encoder/out", norm("encoder/norm", x)).movedim(1, -1).chunk(2, -1)

    def logits(latents):
        x = latents * leaf["latent_scale_C"] + leaf["latent_mean_C"]
        x = conv("decoder/into", x.movedim(-1, 1))
        for k in range(config.middle):
            x = block(f"decoder/middle_{k}", x)
        for level in reversed(range(levels)):
            for k in range(config.blocks + 1):
                x = block(f"decoder/level_{level}/block_{k}", x)
            if level:
                x = conv(f"decoder/level_{level}/up", F.interpolate(x, scale_factor=2))
        x = norm("decoder/norm", x)
        if config.patch > 1:
            x = F.silu(unfold(conv("decoder/out", x), config.patch))
        return conv("decoder/scores", x).movedim(1, -1)

    return moments, logits


def test_it_equals_torch_and_its_other_form(net):
    config, params = net
    ids = grids(config)
    moments, logits = torch_blocks(config, params)
    side = config.latent_side
    latents = np.random.default_rng(1).normal(size=(2, side, side, side, config.latent_channels))
    latents = latents.astype(np.float32)
    with torch.no_grad():
        wanted = [x.numpy() for x in (*moments(ids), logits(torch.tensor(latents)))]
    for form in ("xla", "products"):
        other = dataclasses.replace(config, convolution=form)
        made = jax.jit(
            lambda ids, latents, c=other: (
                *voxel_vae.moments(c, params, ids),
                voxel_vae.logits(c, params, latents),
            )
        )(ids, latents)
        for a, b in zip(made, wanted, strict=True):
            scale = max(1.0, float(np.abs(b).max()))
            np.testing.assert_allclose(a / scale, b / scale, atol=1e-5)
    made = voxel_vae.encode(config, params, ids)
    back = made * params["latent_scale_C"] + params["latent_mean_C"]
    np.testing.assert_allclose(back, wanted[0], atol=1e-4)
    best = voxel_vae.decode(config, params, latents)
    np.testing.assert_array_equal(best, wanted[2].argmax(-1))


def test_slabs_change_nothing_and_drawn_cells_are_a_sample(net):
    config, params = net
    ids, key = grids(config), jax.random.key(1)

    def both(c):
        return jax.jit(jax.value_and_grad(lambda p: voxel_vae.loss(c, p, ids, key), has_aux=True))

    (loss, parts), slope = both(config)(params)
    (same, _), again = both(dataclasses.replace(config, slab=4))(params)
    np.testing.assert_allclose(same, loss, rtol=1e-5)
    for a, b in zip(jax.tree.leaves(slope), jax.tree.leaves(again), strict=True):
        scale = float(jnp.abs(a).max()) + 1e-6
        np.testing.assert_allclose(a / scale, b / scale, atol=1e-4)
    wanted = parts["cross_entropy"] + config.kl * parts["divergence"]
    np.testing.assert_allclose(loss, wanted, rtol=1e-5)
    latents = voxel_vae.encode(config, params, ids)
    slabs = voxel_vae.decode(dataclasses.replace(config, slab=4), params, latents)
    np.testing.assert_array_equal(slabs, voxel_vae.decode(config, params, latents))
    sampled = dataclasses.replace(config, compared=4096)
    _, some = jax.jit(lambda: voxel_vae.loss(sampled, params, ids, key))()
    np.testing.assert_allclose(some["cross_entropy"], parts["cross_entropy"], rtol=0.05)


def test_fitted_latents_have_mean_0_and_variance_1_and_decode_the_same(net):
    config, params = net
    ids = grids(config, 4)
    encode = jax.jit(lambda p: voxel_vae.encode(config, p, ids))
    before = encode(params)
    axes = (0, 1, 2, 3)
    fitted = voxel_vae.fitted(params, before.mean(axes), before.std(axes))
    after = encode(fitted)
    np.testing.assert_allclose(after.mean(axes), 0, atol=1e-4)
    np.testing.assert_allclose(after.std(axes), 1, atol=1e-4)
    scores = jax.jit(lambda p, z: voxel_vae.logits(config, p, z))
    np.testing.assert_allclose(scores(fitted, after), scores(params, before), atol=1e-3)


def test_residual_blocks_change_nothing_at_first_and_it_learns():
    import optax

    config = dataclasses.replace(FOLDED, widths=(24,), classes=4)
    params = jax.jit(voxel_vae.init, static_argnums=0)(config, jax.random.key(0))
    assert not params["encoder"]["middle_0"]["two"]["kernel"].any()
    assert not params["decoder"]["level_0"]["block_1"]["two"]["kernel"].any()
    ids = np.zeros((2, 8, 8, 8), np.uint8)
    ids[:, :, :, :2] = 1
    ids[0, 2:4, 3:7] = 2
    ids[1, 5:, :2, :5] = 3
    optimizer = optax.adam(1e-2)

    @jax.jit
    def train(params):
        def step(held, key):
            params, state = held
            (_, parts), slope = jax.value_and_grad(
                lambda p: voxel_vae.loss(config, p, ids, key), has_aux=True
            )(params)
            change, state = optimizer.update(slope, state)
            return (optax.apply_updates(params, change), state), parts["occupied_right"]

        keys = jax.random.split(jax.random.key(1), 150)
        (params, _), right = jax.lax.scan(step, (params, optimizer.init(params)), keys)
        return params, right

    params, right = train(params)
    assert right[0] < 0.9
    made = voxel_vae.decode(config, params, voxel_vae.encode(config, params, ids))
    assert (np.asarray(made) == ids)[ids > 0].mean() > 0.98


def test_published_size_sharding_and_costs():
    config = VoxelVAEConfig()
    params = jax.eval_shape(lambda: voxel_vae.init(config, jax.random.key(0)))
    count = sum(x.size for x in jax.tree.leaves(params))
    assert abs(count / 138e6 - 1) < 0.005
    assert (config.latent_side, config.latent_channels) == (12, 48)
    specs = tree.assign(voxel_vae_shapes.SHARDING, {"voxel_vae": params})
    assert any(spec != P() for spec in jax.tree.leaves(specs, is_leaf=lambda x: isinstance(x, P)))
    for small in (LIKE_PUBLISHED, dataclasses.replace(FOLDED, convolution="xla")):
        weights = jax.eval_shape(lambda c=small: voxel_vae.init(c, jax.random.key(0)))
        ids = jax.ShapeDtypeStruct((1, *(small.side,) * 3), jnp.uint8)
        ran = jax.jit(
            lambda p, x, c=small: voxel_vae.logits(c, p, voxel_vae.encode(c, p, x))
        ).lower(weights, ids)
        (product,) = voxel_vae_shapes.costs(small, Share(), 1, trained=True).products
        assert product.macs > 0
        assert abs(ran.cost_analysis()["flops"] / (2 * product.macs) - 1) < 0.5


@pytest.mark.parametrize(
    "wrong",
    [{"side": 46}, {"embed": 16}, {"kernel": 2}, {"widths": ()}, {"slab": 5}, {"classes": 1},
     {"compared": -1}],
)  # fmt: skip
def test_settings_that_cannot_work_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        VoxelVAEConfig(**wrong)


def test_other_grids_are_refused():
    with pytest.raises(UserError, match="takes \\(batch, 8, 8, 8\\)"):
        voxel_vae.moments(FOLDED, {}, np.zeros((2, 8, 8, 4), int))
    with pytest.raises(UserError, match="no integers"):
        voxel_vae.moments(FOLDED, {}, np.zeros((2, 8, 8, 8), np.float32))
