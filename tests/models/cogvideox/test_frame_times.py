"""A time, and a modulation, for each latent frame: what every token in time is told."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.models.cogvideox import model as dit
from pewm_jax.models.cogvideox import model as dit_block
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.interface import Conditioning, Readers
from pewm_jax.nn.tokens import TokenLayout
from pewm_jax.readers.memory_block import MemoryBlock
from pewm_jax.types import MemoryReadout
from pewm_jax.worlds import world_model
from tests.helpers import TINY, random_world, randomised, with_reader
from tests.models.cogvideox.test_model import CONFIG, inputs, random_params
from tests.worlds.test_world_model import setup as world

apply = jax.jit(dit.apply, static_argnums=0, static_argnames="memory_block")
denoise = jax.jit(DiTBackbone.apply, static_argnums=0)
FRAMES, PATCHES = 3, 6
WIDTH, TIME = CONFIG.width, CONFIG.time_dim
TWO = dataclasses.replace(CONFIG, patch_t=2)


def draw(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


@pytest.mark.parametrize("config", [CONFIG, TWO], ids=["one", "two"])
def test_equal_times_of_all_frames_are_one_time_of_the_clip(config):
    params = random_params(config)
    latents, text, times = inputs(config)
    given = Conditioning(tokens_BLC=text)
    one = denoise(config, params, latents, times, given)
    each = denoise(config, params, latents, jnp.tile(times[:, None], (1, FRAMES)), given)
    np.testing.assert_allclose(each, one, rtol=1e-5, atol=1e-5 * np.abs(one).max())
    other = denoise(config, params, latents, times[:, None] + jnp.arange(3) * 100, given)
    assert np.abs(other - one).max() > 1e-3


@pytest.mark.parametrize("config", [CONFIG, TWO], ids=["one", "two"])
def test_a_modulation_of_zero_is_none(config):
    params = random_params(config)
    latents, text, times = inputs(config)
    none = denoise(config, params, latents, times, Conditioning(tokens_BLC=text))
    zero = Conditioning(None, jnp.zeros((2, FRAMES, TIME)), text)
    found = denoise(config, params, latents, times, zero)
    np.testing.assert_allclose(found, none, rtol=1e-5, atol=1e-5 * np.abs(none).max())
    some = dataclasses.replace(zero, modulation_BtE=draw(0, 2, FRAMES, TIME))
    assert np.abs(denoise(config, params, latents, times, some) - none).max() > 1e-3


def show_time(_, video, time):
    """A memory block after which the video tokens hold nothing but the time that it was told."""
    told = jnp.repeat(time, video.shape[1] // time.shape[1], 1)
    return jnp.tile(told, (1, 1, WIDTH // TIME))


@pytest.mark.parametrize(
    ("config", "frame", "moved"),
    [(CONFIG, 0, [0]), (CONFIG, 1, [1]), (CONFIG, 2, [2]), (TWO, 0, [0]), (TWO, 2, [1, 2])],
)
def test_a_reader_and_the_last_layer_are_told_of_each_frame_its_own(config, frame, moved):
    """With two latent frames per token, the first stands twice in front, and 1 and 2 share one."""
    params = random_params(config)
    latents, text, times = inputs(config)
    modulation = draw(0, 2, FRAMES, TIME)
    readers = Readers(show_time, jnp.zeros(config.layers))

    @jax.jit
    def run(modulation):
        given = Conditioning(None, modulation, text)
        return config.apply(params, latents, times, given, readers)

    base, other = run(modulation), run(modulation.at[:, frame].add(1.0))
    changed = np.abs(other - base).max((0, 2, 3, 4)) > 0
    assert np.flatnonzero(changed).tolist() == moved


@pytest.mark.parametrize("parts", [1, 2])
def test_a_block_modulates_the_tokens_of_each_frame_by_its_own_time(parts):
    """The first row of times is the text's."""
    layout = TokenLayout(parts=parts, text=4, frames=FRAMES, patches=PATCHES)
    norm = dit_block.LayerNormZero()
    tokens = layout.arrange(draw(0, 2, 4 + FRAMES * PATCHES, WIDTH))
    times = draw(1, 2, 1 + FRAMES, TIME)
    params = randomised(norm.init, jax.random.key(0), tokens, times, layout)
    run = jax.jit(norm.apply, static_argnums=3)
    base = run(params, tokens, times, layout)
    for row in range(1 + FRAMES):
        other = run(params, tokens, times.at[:, row].add(1.0), layout)
        for a, b in zip(base, other, strict=True):
            text, video = layout.split(jnp.abs(a - b))
            frames = np.asarray(layout.gather(video)).reshape(2, FRAMES, -1).max((0, 2)) > 0
            assert bool(text.max() > 0) == (row == 0)
            assert np.flatnonzero(frames).tolist() == [row - 1] * (row > 0)
    same = jnp.tile(times[:, :1], (1, 1 + FRAMES, 1))
    one = run(params, tokens, times[:, 0], layout)
    for a, b in zip(run(params, tokens, same, layout), one, strict=True):
        np.testing.assert_allclose(a, jnp.broadcast_to(b, a.shape), rtol=1e-5, atol=1e-5)


def test_what_is_added_is_added_to_the_tokens_of_its_frame():
    params, (latents, text, times) = random_params(), inputs()
    added = draw(0, 2, FRAMES * PATCHES, WIDTH)
    plain = apply(CONFIG, params, latents, text, times)
    none = apply(CONFIG, params, latents, text, times, added_BND=added * 0)
    np.testing.assert_allclose(none, plain, atol=1e-6)
    assert np.abs(apply(CONFIG, params, latents, text, times, added_BND=added) - plain).max() > 1e-3


def memory_block():
    """A block of the reader with its parameters and all that goes into it but the time."""
    model = with_reader(TINY, positions="sinusoid")
    reader = model.memory.reader
    block = MemoryBlock(reader, 3, TokenLayout(1, 3, FRAMES, PATCHES))
    video, camera = draw(0, 2, FRAMES * PATCHES, WIDTH), draw(1, 2, FRAMES * PATCHES, 4)
    memory = draw(2, 2, 7, reader.width)
    rest = camera, memory, jnp.ones((2, 7), bool), None
    params = randomised(block.init, jax.random.key(0), video, draw(3, 2, TIME), *rest)
    return block, params, video, rest, reader.width


def test_the_memory_block_takes_a_time_for_each_frame():
    block, params, video, rest, inner = memory_block()
    run = jax.jit(lambda params, time: block.apply(params, video, time, *rest))
    times = draw(3, 2, FRAMES, TIME)
    one = run(params, times[:, 0])
    same = run(params, jnp.tile(times[:, :1], (1, FRAMES, 1)))
    np.testing.assert_allclose(same, one, rtol=1e-5, atol=1e-5 * np.abs(one).max())

    # The map's tokens, shared by all frames, hear of every frame: without their modulation, a
    # frame's time concerns that frame alone.
    linear = params["params"]["linear"]
    kernel = linear["kernel"].at[:, 2 * WIDTH : 2 * WIDTH + 2 * inner].set(0)
    deaf = {"params": {**params["params"], "linear": {**linear, "kernel": kernel}}}
    base = run(deaf, times)
    for frame in range(FRAMES):
        other = run(deaf, times.at[:, frame].add(1.0))
        changed = np.abs(other - base).reshape(2, FRAMES, -1).max((0, 2)) > 0
        assert np.flatnonzero(changed).tolist() == [frame]
    heard = np.abs(run(params, times.at[:, 1].add(1.0)) - run(params, times))
    assert (heard.reshape(2, FRAMES, -1).max((0, 2)) > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("positions", "patch_t"), [("projective", 1), ("sinusoid", 2), ("projective", 2)]
)
def test_a_world_with_memory_takes_a_time_for_each_latent_frame(positions, patch_t):
    _, conditioning, tokens, noisy, times = world(positions)
    backbone = dataclasses.replace(TINY.backbone, patch_t=patch_t)
    read = with_reader(TINY, positions=positions, heads=8)  # a token has up to 8 cameras
    model = dataclasses.replace(read, backbone=backbone)
    params = random_world(model)

    @jax.jit
    def run(times):
        return world_model.apply(model, params, noisy, conditioning, times, MemoryReadout(tokens))

    one = run(times)
    each = jnp.tile(times[:, None], (1, FRAMES))
    np.testing.assert_allclose(run(each), one, rtol=1e-4, atol=1e-5 * np.abs(one).max())
    moved = run(each + jnp.asarray([0, 0, 100]))
    assert np.isfinite(moved).all()
    assert np.abs(moved - one).max() > 1e-3
