"""PERSIST's transformers: a cache is as good as all frames at once, and nothing sees the future."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec as P

from pewm_jax.config import ConfigError, UserError
from pewm_jax.io import tree
from pewm_jax.models.persist import blocks as frame_blocks
from pewm_jax.models.persist import camera_model, voxel_dit, voxel_renderer
from pewm_jax.models.persist.config import (
    BlocksConfig,
    CameraModelConfig,
    VoxelDiTConfig,
    VoxelRendererConfig,
)
from pewm_jax.nn import layers
from tests.models.persist.networks import normal, weights

BLOCKS = BlocksConfig(layers=2, heads=2, head_dim=8, mlp_ratio=2, context=3)
DIT = VoxelDiTConfig(
    latent_side=2, latent_channels=3, patch=1, actions=4, pixel_channels=5, blocks=BLOCKS
)
CAMERA = CameraModelConfig(classes=6, inner=2, embed=4, actions=4, blocks=BLOCKS)
RENDERER = VoxelRendererConfig(
    classes=6, height=4, width=6, latent_channels=3, layers=8, kernel=3, stride=2, embed=4,
    fold=2, sides=True, blocks=dataclasses.replace(BLOCKS, remat=True),
)  # fmt: skip
FRAMES = 6
"""Twice as many as a frame sees."""


def ids(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).integers(0, 6, shape))


def run_dit(params, inputs, cache=None, config=DIT):
    latents, times, actions, pixels, camera, shown = inputs
    return voxel_dit.apply(
        config, params, latents, times, actions, pixels,
        camera_BTN=camera, shown_BT=shown, cache=cache,
    )  # fmt: skip


def run_camera(params, inputs, cache=None, config=CAMERA):
    return camera_model.apply(config, params, *inputs, cache=cache)


def run_renderer(params, inputs, cache=None, config=RENDERER):
    return voxel_renderer.apply(config, params, *inputs, cache=cache)


@pytest.mark.parametrize("sides", [(5,), (3, 4), (3, 2, 4), (4, 4, 1)])
def test_rotated_attention_depends_on_distances_along_each_axis(sides):
    angles = frame_blocks.position_angles(sides, 12)
    assert angles.shape == (np.prod(sides), 6)
    q, k = normal(0, 12), normal(1, 12)
    rotated = [layers.rotate_halves(jnp.broadcast_to(x, (len(angles), 12)), angles) for x in (q, k)]
    logits = np.asarray(rotated[0] @ rotated[1].T)
    places = np.argwhere(np.ones(sides))
    distance = places[:, None] - places
    by_distance = {}
    for at, value in zip(distance.reshape(-1, len(sides)), logits.reshape(-1), strict=True):
        by_distance.setdefault(tuple(at), []).append(value)
    for values in by_distance.values():
        np.testing.assert_allclose(values, values[0], atol=1e-4)
    firsts = np.sort([values[0] for values in by_distance.values()])
    assert np.diff(firsts).min() > 1e-6  # every distance has its own logit


NETS = {
    "voxel_dit": (
        voxel_dit,
        DIT,
        run_dit,
        (
            normal(0, 2, FRAMES, 2, 2, 2, 3),
            1000 * jax.nn.sigmoid(normal(1, 2, FRAMES)),
            normal(2, 2, FRAMES, 4),
            normal(3, 2, FRAMES, 2, 4, 5),
            normal(4, 2, FRAMES, 10),
            normal(5, 2, FRAMES) > -0.5,
        ),
    ),
    "camera_model": (
        camera_model,
        CAMERA,
        run_camera,
        (ids(0, 2, FRAMES, 4, 4, 4), normal(1, 2, FRAMES, 10), normal(2, 2, FRAMES, 4)),
    ),
    "renderer": (
        voxel_renderer,
        RENDERER,
        run_renderer,
        (
            normal(0, 2, FRAMES, 4, 6, 3),
            1000 * jax.nn.sigmoid(normal(1, 2, FRAMES)),
            normal(2, 2, FRAMES, 4, 6, RENDERER.features),
        ),
    ),
}


JITTED = {name: jax.jit(run) for name, (_, _, run, _) in NETS.items()}


@pytest.fixture(scope="module", params=NETS)
def net(request):
    module, config, _, inputs = NETS[request.param]
    params, run = weights(module, config), JITTED[request.param]
    return module, config, run, params, inputs, run(params, inputs)[0]


@pytest.mark.slow(but="renderer")
def test_frame_by_frame_with_a_cache_is_all_at_once(net):
    module, config, run, params, inputs, whole = net
    cache = module.empty_cache(config, 2)
    made = []
    for t in range(FRAMES):
        one = jax.tree.map(lambda x, t=t: x[:, t : t + 1], inputs)
        out, cache = run(params, one, cache)
        made.append(out)
    np.testing.assert_allclose(jnp.concatenate(made, 1), whole, atol=1e-5)
    assert int(cache.count) == FRAMES


def test_a_frame_depends_on_all_it_may_see_and_on_nothing_later(net):
    _, config, run, params, inputs, whole = net
    for at in (1, 4):
        other = jax.tree.map(lambda x, at=at: x.at[:, at].set(jnp.roll(x[:, at], 1, 0)), inputs)
        changed = np.asarray(run(params, other)[0] != whole)
        changed = changed.reshape(2, FRAMES, -1).any((0, 2))
        assert not changed[:at].any()
        assert changed[at : at + config.blocks.context].all()


def test_gradients_of_a_frame_reach_no_later_action():
    params, inputs = weights(voxel_dit, DIT), NETS["voxel_dit"][3]

    @jax.jit
    def slope(actions, latents):
        def of(actions, latents):
            out, _ = run_dit(params, (latents, inputs[1], actions, *inputs[3:]))
            return jnp.square(out[:, 3]).sum()

        return jax.grad(of, (0, 1))(actions, latents)

    for x in slope(inputs[2], inputs[0]):
        by_frame = np.abs(np.asarray(x)).reshape(2, FRAMES, -1).max((0, 2))
        assert (by_frame[4:] == 0).all()
        assert (by_frame[1:4] > 0).all()


def test_later_frames_do_not_read_unknown_tokens():
    x, condition = normal(2, 2, FRAMES, 5, BLOCKS.width), normal(3, 2, 1, BLOCKS.width)
    params = {"blocks": {"time": weights(voxel_dit, DIT)["blocks"]["time"]}}
    known = jnp.ones((2, FRAMES, 5), bool).at[:, 1, 2].set(False)

    @jax.jit
    def run(x, known, cache=None):
        return frame_blocks.run(
            BLOCKS, ("time",), params, x, condition, known_BTN=known, cache=cache
        )

    whole = run(x, known)[0]
    other = run(x.at[:, 1, 2].add(1.0), known)[0]
    assert bool((whole[:, 1, 2] != other[:, 1, 2]).any())  # a token always reads itself
    np.testing.assert_array_equal(whole.at[:, 1, 2].set(0), other.at[:, 1, 2].set(0))
    assert bool((run(x, jnp.ones_like(known))[0][:, 2, 2] != whole[:, 2, 2]).any())
    cache = frame_blocks.empty_cache(BLOCKS, 2, 5)
    half = FRAMES // 2
    first, cache = run(x[:, :half], known[:, :half], cache)
    np.testing.assert_allclose(first, whole[:, :half], atol=1e-5)
    later, _ = run(x[:, half:], known[:, half:], cache)
    np.testing.assert_allclose(later, whole[:, half:], atol=1e-5)


def test_a_hidden_picture_does_not_matter_and_a_shown_one_does():
    inputs, run = NETS["voxel_dit"][3], JITTED["voxel_dit"]
    params = weights(voxel_dit, DIT)
    for shown in (True, False):
        kept = jnp.full((2, FRAMES), shown)
        one = run(params, (*inputs[:5], kept))[0]
        other = run(params, (*inputs[:3], -inputs[3], inputs[4] + 1, kept))[0]
        assert bool((one == other).all()) != shown


def test_networks_begin_at_zero_and_blocks_as_the_identity():
    x, condition = normal(0, 1, 2, 3, 16), normal(1, 1, 2, 16)
    ends = list(frame_blocks.end_shapes(16, 5))

    @jax.jit
    def both(key):
        made = []
        for gates in ("zero", "open"):
            config = dataclasses.replace(BLOCKS, gates=gates)
            params = frame_blocks.init(config, ("time",), ends, key)
            moved, _ = frame_blocks.run(config, ("time",), params, x, condition)
            made.append((moved, frame_blocks.project(params, moved, condition)))
        return made

    (same, nothing), (moved, still) = both(jax.random.key(0))
    np.testing.assert_array_equal(same, x)
    assert not nothing.any()
    assert not still.any()
    assert bool((moved != x).any())


PUBLISHED = {
    "voxel_dit": (voxel_dit, VoxelDiTConfig(), 686e6, 216),
    "voxel_dit fine": (voxel_dit, VoxelDiTConfig(patch=1), 686e6, 1728),
    "camera_model": (camera_model, CameraModelConfig(), 234e6, 1),
    "renderer": (voxel_renderer, VoxelRendererConfig(), 460e6, 576),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PUBLISHED)
def test_published_sizes_and_sharding(name):
    module, config, published, tokens = PUBLISHED[name]
    params = jax.eval_shape(lambda: module.init(config, jax.random.key(0)))
    count = sum(x.size for x in jax.tree.leaves(params))
    assert abs(count / published - 1) < 0.005
    assert getattr(config, "tokens", 1) == tokens
    specs = tree.flatten(tree.assign(module.SHARDING, {name.split()[0]: params}))
    leaves = tree.flatten({name.split()[0]: params})
    whole = sum(leaves[path].size for path in leaves if specs[path] == P())
    assert whole < 0.001 * count


@pytest.mark.slow
@pytest.mark.parametrize("name", NETS)
def test_published_sizes_run_in_bfloat16_with_a_cache(name):
    module, config, *_ = PUBLISHED[name]
    params = jax.eval_shape(lambda: module.init(config, jax.random.key(0)))
    front, half = (1, 2), jnp.bfloat16

    def array(*shape, dtype=half):
        return jax.ShapeDtypeStruct((*front, *shape), dtype)

    inputs = {
        "voxel_dit": lambda: (array(12, 12, 12, 48), array(), array(23), array(36, 64, 16)),
        "camera_model": lambda: (array(48, 48, 48, dtype=jnp.int32), array(10), array(23)),
        "renderer": lambda: (array(36, 64, 16), array(), array(36, 64, 752)),
    }[name]()
    options = {"dtype": half} if name == "camera_model" else {}
    cache = jax.eval_shape(lambda: module.empty_cache(config, 1, half))
    made, after = jax.eval_shape(
        lambda p, x, c: module.apply(config, p, *x, cache=c, **options), params, inputs, cache
    )
    wanted = (*front, 6) if name == "camera_model" else inputs[0].shape
    assert made.shape == wanted
    assert made.dtype == (jnp.float32 if name == "camera_model" else half)
    same = jax.tree.map(lambda a, b: (a.shape, a.dtype) == (b.shape, b.dtype), after, cache)
    assert all(jax.tree.leaves(same))


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: BlocksConfig(head_dim=7),
        lambda: BlocksConfig(context=0),
        lambda: VoxelDiTConfig(patch=5),
        lambda: CameraModelConfig(units=(1.0,) * 5),
        lambda: VoxelRendererConfig(layers=4),
        lambda: VoxelRendererConfig(shortest_m=0),
        lambda: VoxelRendererConfig(height=35),
        lambda: VoxelRendererConfig(embed=3),
    ],
)
def test_settings_that_cannot_work_are_refused(wrong):
    with pytest.raises(ConfigError):
        wrong()


def test_arrays_of_other_shapes_are_refused():
    latents, times, actions, pixels, camera, _ = NETS["voxel_dit"][3]
    with pytest.raises(UserError, match="voxel frames' latents"):
        voxel_dit.apply(DIT, {}, latents[..., :2], times, actions, pixels)
    with pytest.raises(UserError, match="actions have shape"):
        voxel_dit.apply(DIT, {}, latents, times, actions[:, 1:], pixels)
    with pytest.raises(UserError, match="pictures' latents"):
        voxel_dit.apply(DIT, {}, latents, times, actions, pixels[:, :, :1])
    with pytest.raises(UserError, match="cameras have shape"):
        voxel_dit.apply(DIT, {}, latents, times, actions, pixels, camera_BTN=camera[..., 1:])
    voxels, before, actions = NETS["camera_model"][3]
    with pytest.raises(UserError, match="innermost 2"):
        camera_model.apply(CAMERA, {}, voxels[..., :1], before, actions)
    with pytest.raises(UserError, match="cameras have shape"):
        camera_model.apply(CAMERA, {}, voxels, before[..., 1:], actions)
    latents, times, seen = NETS["renderer"][3]
    with pytest.raises(UserError, match="voxels' features"):
        voxel_renderer.apply(RENDERER, {}, latents, times, seen[..., 1:])
    with pytest.raises(UserError, match="takes actions of 0 numbers"):
        voxel_renderer.apply(RENDERER, {}, latents, times, seen, actions_BTA=actions)


def test_with_no_earlier_frames_each_is_computed_as_if_it_were_alone():
    alone = dataclasses.replace(DIT, blocks=dataclasses.replace(BLOCKS, context=1))
    params, inputs = weights(voxel_dit, DIT), NETS["voxel_dit"][3]
    together = run_dit(params, inputs, config=alone)[0]
    for frame in range(FRAMES):
        one = tuple(x[:, frame : frame + 1] for x in inputs)
        np.testing.assert_allclose(
            run_dit(params, one)[0][:, 0], together[:, frame], atol=1e-5, rtol=1e-5
        )
