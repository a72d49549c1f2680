"""The autoencoder of voxels: equal to torch, whatever the form, and what it refuses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from jax.sharding import PartitionSpec as P

from pewm_jax.config import ConfigError, UserError
from pewm_jax.io import tree
from pewm_jax.models.persist import voxel_vae
from pewm_jax.models.persist.config import VoxelVAEConfig
from tests.models.persist.networks import weights

LIKE_PUBLISHED = VoxelVAEConfig(
    side=4,
    classes=7,
    embed=4,
    widths=(4, 6),
    blocks=1,
    middle=1,
    latent_channels=3,
    convolution="xla",
)
FOLDED = VoxelVAEConfig(
    side=8, classes=7, patch=4, embed=3, widths=(12,), blocks=1, middle=1, kernel=1,
    middle_kernel=1, latent_channels=4, occupied_weight=3.0,
)  # fmt: skip


init = jax.jit(lambda config: voxel_vae.init(config, jax.random.key(0)), static_argnums=0)


@pytest.fixture(scope="module", params=[LIKE_PUBLISHED, FOLDED], ids=["published", "folded"])
def net(request):
    config = request.param
    params = weights(voxel_vae, config)
    params["latent_scale_C"] = jnp.abs(params["latent_scale_C"]) + 0.5
    return config, params


def grids(config, batch=2, seed=0):
    rng = np.random.default_rng(seed)
    return rng.integers(0, config.classes, (batch, *(config.side,) * 3)).astype(np.uint8)


class Torch:
    """The network in torch, one-hot ids and all."""

    def __init__(self, config, params):
        self.config = config
        self.leaf = {path: torch.tensor(np.asarray(x)) for path, x in tree.flatten(params).items()}

    def conv(self, path, x, stride=1):
        kernel = self.leaf[f"{path}/kernel"]
        kernel = kernel[None, None, None] if kernel.ndim == 2 else kernel
        bias = self.leaf.get(f"{path}/bias")
        return F.conv3d(x, kernel.permute(4, 3, 0, 1, 2), bias, stride, kernel.shape[0] // 2)

    def norm(self, path, x):
        scale, bias = self.leaf[f"{path}/scale"], self.leaf[f"{path}/bias"]
        moved = F.layer_norm(x.movedim(1, -1), scale.shape, scale, bias, 1e-5)
        return F.silu(moved).movedim(-1, 1)

    def blocks(self, path, count, x):
        for where in (f"{path}_{k}" for k in range(count)):
            inner = self.conv(f"{where}/one", self.norm(f"{where}/norm_one", x))
            inner = self.conv(f"{where}/two", self.norm(f"{where}/norm_two", inner))
            x = inner + (
                self.conv(f"{where}/past", x) if f"{where}/past/kernel" in self.leaf else x
            )
        return x

    def moments(self, ids):
        config, levels = self.config, len(self.config.widths)
        hot = F.one_hot(torch.tensor(ids.astype(np.int64)), config.classes).float()
        x = self.conv("encoder/embed", hot.movedim(-1, 1))
        if config.patch > 1:
            (b, c, n), p = x.shape[:3], config.patch
            x = x.reshape(b, c, n // p, p, n // p, p, n // p, p).permute(0, 1, 3, 5, 7, 2, 4, 6)
            x = self.conv("encoder/into", x.reshape(b, c * p**3, *(n // p,) * 3))
        for level in range(levels):
            x = self.blocks(f"encoder/level_{level}/block", config.blocks, x)
            if level < levels - 1:
                x = self.conv(f"encoder/level_{level}/down", x, 2)
        x = self.blocks("encoder/middle", config.middle, x)
        return self.conv("encoder/out", self.norm("encoder/norm", x)).movedim(1, -1).chunk(2, -1)

    def logits(self, latents):
        config = self.config
        x = latents * self.leaf["latent_scale_C"] + self.leaf["latent_mean_C"]
        x = self.blocks(
            "decoder/middle", config.middle, self.conv("decoder/into", x.movedim(-1, 1))
        )
        for level in reversed(range(len(config.widths))):
            x = self.blocks(f"decoder/level_{level}/block", config.blocks + 1, x)
            if level:
                x = self.conv(f"decoder/level_{level}/up", F.interpolate(x, scale_factor=2))
        x = self.norm("decoder/norm", x)
        if config.patch > 1:
            x, p = self.conv("decoder/out", x), config.patch
            (b, _, n), c = x.shape[:3], config.embed
            x = x.reshape(b, c, p, p, p, n, n, n).permute(0, 1, 5, 2, 6, 3, 7, 4)
            x = F.silu(x.reshape(b, c, *(n * p,) * 3))
        return self.conv("decoder/scores", x).movedim(1, -1)


def test_it_equals_torch_and_its_other_form(net):
    config, params = net
    ids = grids(config)
    reference = Torch(config, params)
    side = config.latent_side
    latents = np.random.default_rng(1).normal(size=(2, side, side, side, config.latent_channels))
    latents = latents.astype(np.float32)
    with torch.no_grad():
        wanted = [
            x.numpy() for x in (*reference.moments(ids), reference.logits(torch.tensor(latents)))
        ]
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


@pytest.mark.slow
def test_slabs_change_nothing_and_drawn_cells_are_a_sample():
    config, key = FOLDED, jax.random.key(1)
    params, ids = weights(voxel_vae, config), grids(config)

    def both(c):
        def run(p):
            def loss(scores):
                whole = {**p, "decoder": {**p["decoder"], "scores": scores}}
                return voxel_vae.loss(c, whole, ids, key)

            made = jax.value_and_grad(loss, has_aux=True)(p["decoder"]["scores"])
            latents = voxel_vae.encode(c, p, ids)
            return made, voxel_vae.logits(c, p, latents).argmax(-1), voxel_vae.decode(c, p, latents)

        return jax.jit(run)(params)

    ((loss, parts), slope), best, decoded = both(config)
    ((same, _), again), _, slabs = both(dataclasses.replace(config, slab=4))
    np.testing.assert_array_equal(decoded, best)
    np.testing.assert_array_equal(slabs, best)
    np.testing.assert_allclose(same, loss, rtol=1e-5)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), again, slope)
    wanted = parts["cross_entropy"] + config.kl * parts["divergence"]
    np.testing.assert_allclose(loss, wanted, rtol=1e-5)
    sampled = dataclasses.replace(config, compared=4096)
    _, some = jax.jit(lambda p: voxel_vae.loss(sampled, p, ids, key))(params)
    np.testing.assert_allclose(some["cross_entropy"], parts["cross_entropy"], rtol=0.05)


@pytest.mark.slow
def test_cubes_are_pieces_of_the_grid_with_something_in_them():
    config = dataclasses.replace(FOLDED, side=16, cube=8, cubes=64)
    side = config.side
    places = np.arange(side**3).reshape(1, side, side, side)  # every cell but one is occupied
    made = np.asarray(jax.jit(voxel_vae.cubes, static_argnums=0)(config, places, jax.random.key(0)))
    assert made.shape == (64, *(config.cube,) * 3)
    low = np.stack(np.unravel_index(made[:, 0, 0, 0], places.shape[1:]), -1)
    assert not (low % config.factor).any()
    assert len(np.unique(low, axis=0)) > 1
    for cube, (x, y, z) in zip(made, low, strict=True):
        size = config.cube
        np.testing.assert_array_equal(cube, places[0, x : x + size, y : y + size, z : z + size])
    rare = np.zeros_like(places).reshape(1, -1)
    rare[0, [0, -1, 77]] = 1  # two corners and a cell
    made = voxel_vae.cubes(config, rare.reshape(places.shape), jax.random.key(1))
    assert (made > 0).any((1, 2, 3)).all()
    assert not voxel_vae.cubes(config, jnp.zeros_like(places), jax.random.key(2)).any()
    _, parts = voxel_vae.loss(config, weights(voxel_vae, config), grids(config), jax.random.key(3))
    assert all(np.isfinite(x) for x in parts.values())
    with pytest.raises(ConfigError, match=r"voxel_vae\.cube is 3"):
        dataclasses.replace(config, cube=3)


def test_fitted_latents_have_mean_0_and_variance_1_and_decode_the_same():
    config, axes = FOLDED, (0, 1, 2, 3)
    params, ids = weights(voxel_vae, config), grids(config, 4)

    @jax.jit
    def both(p):
        latents = voxel_vae.encode(config, p, ids)
        return latents, voxel_vae.logits(config, p, latents)

    before, scores = both(params)
    fitted = voxel_vae.with_statistics(params, before.mean(axes), before.std(axes))
    after, same = both(fitted)
    np.testing.assert_allclose(after.mean(axes), 0, atol=1e-4)
    np.testing.assert_allclose(after.std(axes), 1, atol=1e-4)
    np.testing.assert_allclose(same, scores, atol=1e-3)


def test_with_kernels_of_one_place_a_latent_tells_of_its_own_patch_alone():
    config, params = FOLDED, weights(voxel_vae, FOLDED)
    ids = grids(config, 1)
    other = ids.copy()
    other[0, 5, 1, 2] = (ids[0, 5, 1, 2] + 1) % config.classes

    @jax.jit
    def run(ids):
        latents = voxel_vae.encode(config, params, ids)
        return latents, voxel_vae.logits(config, params, latents)

    (before, scores), (after, others) = run(ids), run(other)
    places = np.argwhere((np.asarray(before) != np.asarray(after)).any(-1))
    np.testing.assert_array_equal(places, [[0, 1, 0, 0]])
    cells = np.argwhere((np.asarray(scores) != np.asarray(others)).any(-1))
    assert len(cells) > 32
    np.testing.assert_array_equal(cells // [1, 4, 4, 4], np.tile(places, (len(cells), 1)))


@pytest.mark.slow
def test_residual_blocks_change_nothing_at_first_and_it_learns():
    import optax

    config = dataclasses.replace(FOLDED, widths=(24,), classes=4)
    params = init(config)
    _, log_variance = jax.jit(lambda p, ids: voxel_vae.moments(config, p, ids))(
        params, grids(config)
    )
    deviation = np.exp(np.asarray(log_variance).mean() / 2)
    np.testing.assert_allclose(deviation, voxel_vae.FIRST_DEVIATION, rtol=0.3)
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
    assert right[-1] > 0.98


@pytest.mark.slow
def test_published_size_and_sharding():
    config = VoxelVAEConfig()
    params = jax.eval_shape(lambda: voxel_vae.init(config, jax.random.key(0)))
    count = sum(x.size for x in jax.tree.leaves(params))
    assert abs(count / 138e6 - 1) < 0.005
    assert (config.latent_side, config.latent_channels) == (12, 48)
    grids = jax.ShapeDtypeStruct((1, 48, 48, 48), jnp.uint16)
    key = jax.eval_shape(lambda: jax.random.key(0))
    slabs = dataclasses.replace(config, slab=4)
    loss, _ = jax.eval_shape(
        lambda p, x, k: voxel_vae.loss(slabs, p, x, k, jnp.bfloat16), params, grids, key
    )
    assert (loss.shape, loss.dtype) == ((), jnp.float32)
    specs = tree.assign(voxel_vae.SHARDING, {"voxel_vae": params})
    assert any(spec != P() for spec in jax.tree.leaves(specs, is_leaf=lambda x: isinstance(x, P)))


@pytest.mark.parametrize(
    "wrong",
    [{"side": 46}, {"embed": 16}, {"kernel": 2}, {"middle_kernel": 5}, {"widths": ()}, {"slab": 5},
     {"classes": 1}, {"compared": -1}],
)  # fmt: skip
def test_settings_that_cannot_work_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        VoxelVAEConfig(**wrong)


def test_other_grids_are_refused():
    with pytest.raises(UserError, match="takes \\(batch, 8, 8, 8\\)"):
        voxel_vae.moments(FOLDED, {}, np.zeros((2, 8, 8, 4), int))
    with pytest.raises(UserError, match="not integers"):
        voxel_vae.moments(FOLDED, {}, np.zeros((2, 8, 8, 8), np.float32))
