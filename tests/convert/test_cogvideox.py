"""A CogVideoX checkpoint comes in, is widened, and goes out again, tensor for tensor."""

import dataclasses
import json
import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.torch
import torch
from diffusers import (
    AutoencoderKLCogVideoX,
    CogVideoXDPMScheduler,
    CogVideoXImageToVideoPipeline,
    CogVideoXTransformer3DModel,
)
from diffusers.models.embeddings import get_3d_rotary_pos_embed
from transformers import AutoTokenizer, T5EncoderModel

import pewm_jax
from pewm_jax import config as configuration
from pewm_jax import presets, registry
from pewm_jax.cli import main as program
from pewm_jax.convert import cogvideox, pipeline, schedulers, widen
from pewm_jax.io import sources, tensor_files, weights
from pewm_jax.io.published import LINEAR, Entry
from pewm_jax.models.cogvideox import model as dit
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.interface import Conditioning
from pewm_jax.types import Camera, Control, MapTokens, MemoryReadout
from pewm_jax.worlds import world_model
from tests.convert import pipelines
from tests.helpers import random_frames

WORLD = ["--rgbd", "--camera", "--memory", "--frames", "9", "--height", "32", "--width", "32"]


def run(*argv):
    assert program.main(["convert", *(str(word) for word in argv)]) == 0


def bits(module):
    return {k: v.contiguous().view(-1).view(torch.uint8) for k, v in module.state_dict().items()}


def require_equal(module, other):
    mine, theirs = bits(module), bits(other)
    assert mine.keys() == theirs.keys()
    assert all(torch.equal(mine[name], theirs[name]) for name in mine)
    assert module.dtype == other.dtype


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """An image-to-video pipeline in shards, with a text encoder and a card."""
    folder = pipelines.save(tmp_path_factory.mktemp("i2v"), "5b-I2V", shard="40KB", sampler="dpm")
    (folder / "README.md").write_text("---\nlicense: other\nlicense_name: tiny\n---\n# Tiny")
    return pipelines.save_text(folder)


@pytest.fixture(scope="module")
def imported(images, tmp_path_factory):
    dst = tmp_path_factory.mktemp("imported") / "dst"
    run("import", "cogvideox", images, dst, "--prompt", "a room", "--prompt=")
    return dst


@pytest.fixture(scope="module")
def widened(images, tmp_path_factory):
    dst = tmp_path_factory.mktemp("widened") / "dst"
    run("import", "cogvideox", images, dst, *WORLD, "--prompt", "a room with a chair")
    return dst


@pytest.mark.parametrize(
    ("variant", "dtype", "shard"),
    [
        ("2b", torch.float16, "10GB"),
        ("5b", torch.bfloat16, "40KB"),
        ("1.5-5B-I2V", torch.float32, "40KB"),
    ],
)
def test_there_and_back_is_bit_for_bit_the_same(tmp_path, variant, dtype, shard):
    src = pipelines.save(tmp_path / "src", variant, dtype, shard)
    run("import", "cogvideox", src, tmp_path / "ours")
    run("export", "diffusers", tmp_path / "ours", tmp_path / "back")
    for kind, part in (
        (CogVideoXTransformer3DModel, "transformer"),
        (AutoencoderKLCogVideoX, "vae"),
    ):
        before, after = (
            kind.from_pretrained(folder / part, torch_dtype=dtype)
            for folder in (src, tmp_path / "back")
        )
        require_equal(after, before)
        assert dict(after.config) == {**before.config, "_name_or_path": after.config._name_or_path}
    assert (tmp_path / "back/scheduler/scheduler_config.json").read_text().split() == (
        src / "scheduler/scheduler_config.json"
    ).read_text().split()


def test_the_exported_folder_is_a_pipeline(imported, images, tmp_path):
    without, whole = tmp_path / "without", tmp_path / "whole"
    run("export", "diffusers", imported, without)
    run("export", "diffusers", imported, whole, "--original", images)
    absent = {"text_encoder": None, "tokenizer": None}
    for folder, given in ((without, absent), (whole, {})):
        pipeline = CogVideoXImageToVideoPipeline.from_pretrained(folder, **given)
        require_equal(pipeline.transformer, pipelines.dit("5b-I2V"))
        require_equal(pipeline.vae, pipelines.vae())
        assert isinstance(pipeline.scheduler, CogVideoXDPMScheduler)
        assert (pipeline.text_encoder is None) == bool(given)


def test_the_entry_points_read_what_the_commands_store(imported, images):
    for read, load in (
        (cogvideox.read_transformer, cogvideox.load_transformer),
        (cogvideox.read_vae, cogvideox.load_vae),
    ):
        (config, params), (stored_config, stored) = read(images), load(imported)
        assert config == stored_config
        jax.tree.map(np.testing.assert_array_equal, params, stored)
    assert cogvideox.read_transformer(images / "transformer")[0].positions == "rope_learned"
    assert cogvideox.read_scheduler(images) == cogvideox.load_scheduler(imported)
    assert cogvideox.read_scheduler(images / "scheduler").sampler == "dpm"
    half = cogvideox.read_vae(images / "vae", "float16")[1]
    assert {leaf.dtype.name for leaf in jax.tree.leaves(half)} == {"float16"}


def test_of_several_precisions_the_plain_one_is_read(images, tmp_path):
    tensors = dict(pipelines.vae().state_dict())
    (tmp_path / "vae").mkdir()
    (tmp_path / "vae/config.json").write_text((images / "vae/config.json").read_text())
    for name, dtype in (("", torch.float32), (".fp16", torch.float16)):
        path = tmp_path / f"vae/diffusion_pytorch_model{name}.safetensors"
        safetensors.torch.save_file({k: v.to(dtype) for k, v in tensors.items()}, path)
    kinds = [{x.dtype.name for x in jax.tree.leaves(cogvideox.read_vae(tmp_path)[1])}]
    (tmp_path / "vae/diffusion_pytorch_model.safetensors").unlink()
    kinds += [{x.dtype.name for x in jax.tree.leaves(cogvideox.read_vae(tmp_path)[1])}]
    assert kinds == [{"float32"}, {"float16"}]


def test_the_record_says_where_it_came_from(imported, images):
    record = cogvideox.load_base(imported)
    assert record["licence"] == "tiny"
    assert record["prompts"] == ["a room", ""]
    for part in ("transformer", "vae"):
        assert record[part] == json.loads((images / part / "config.json").read_text())


@pytest.mark.slow
def test_prompts_are_encoded_as_the_pipeline_does(imported, images, widened):
    tokenizer = AutoTokenizer.from_pretrained(images / "tokenizer")
    encoder = T5EncoderModel.from_pretrained(images / "text_encoder")

    def reference(prompt):
        ids = tokenizer(
            prompt, padding="max_length", max_length=6, truncation=True, return_tensors="pt"
        )
        with torch.no_grad():
            return encoder(ids.input_ids)[0][0].numpy()

    stored = weights.load(imported / "text" / cogvideox.WEIGHTS)["prompts_PLC"]
    for prompt, tokens in zip(("a room", ""), stored, strict=True):
        np.testing.assert_allclose(tokens, reference(prompt), atol=1e-6)
    config, params = pewm_jax.load(widened)
    assert config.model.backbone.prompt == "stored"
    expected = reference("a room with a chair")
    np.testing.assert_allclose(params["text"]["prompt_LC"], expected, atol=1e-6)
    assert not np.allclose(expected, stored[0])


def inputs(config, plan):
    """Random inputs of a world model, and what the video model inside is given of them."""
    rng = np.random.default_rng(0)

    def normal(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    model = config.model
    frames, height, width = model.latent_shape
    noisy, first = (normal(2, frames, height, width, plan.new.out_channels) for _ in range(2))
    rays = normal(2, frames, height, width, model.control.channels(model))
    pose = jnp.broadcast_to(jnp.eye(4), (2, model.clip.frames, 4, 4))
    camera = Camera(jnp.full((2, model.clip.frames, 4), 16.0), pose)
    text_BLC = normal(2, *model.backbone.text_shape)
    given = Conditioning(jnp.concatenate([first, rays], -1), None, text_BLC)
    conditioning = world_model.ClipConditioning(given, camera, rays)
    points = normal(2, 24, 3) + jnp.array([0.0, 0.0, 3.0])
    features = 9 * normal(2, 24, model.memory.encoder.channels)
    tokens = MapTokens(features, points, jnp.ones((2, 24), bool))
    split = plan.old.out_channels
    video = noisy[..., :split]
    if plan.old.in_channels > split:
        video = jnp.concatenate([video, first[..., :split]], -1)
    video = jnp.concatenate([video[:, :1]] * (-frames % model.backbone.patch_t) + [video], 1)
    return noisy, conditioning, tokens, video


@pytest.mark.slow(but="2b-projective")
@pytest.mark.parametrize(
    ("variant", "kind"),
    [("2b", "projective"), ("5b-I2V", "sinusoid"), ("1.5-5B-I2V", "projective")],
)
def test_a_fresh_world_model_gives_the_colours_of_the_original(variant, kind):
    network = cogvideox.TRANSFORMER
    source = {k: v.numpy() for k, v in pipelines.dit(variant).state_dict().items()}
    old = network.config(dict(pipelines.dit(variant).config), variant)
    params = pipeline.read_tensors(
        network.entries(old), sources.in_memory(source, variant), network.like(old), "float32"
    )
    vae = cogvideox.VAE.config(dict(pipelines.vae().config), "vae")
    config = cogvideox.config_of(
        old, vae, schedulers.cogvideox_from_diffusers(
            {"_class_name": "CogVideoXDDIMScheduler", **pipelines.SCHEDULER}
        ), (9, 32, 32), "float32",
    )  # fmt: skip
    cameras = config.model.codec.temporal * old.patch_t
    memory = config.model.memory
    reader = dataclasses.replace(memory.reader, positions=kind, heads=cameras)
    config = config.with_model(memory=dataclasses.replace(memory, reader=reader))
    plan = widen.plan(old, 4, config.model.control.channels(config.model))
    wide = {
        "backbone": widen.widen(plan, params),
        "memory": jax.jit(
            lambda: config.model.memory.reader.init(config.model, jax.random.key(0))
        )(),
    }
    noisy, conditioning, tokens, video = inputs(config, plan)
    times = jnp.array([999, 40])
    apply = jax.jit(world_model.apply, static_argnums=0)
    got = apply(config.model, wide, noisy, conditioning, times, MemoryReadout(tokens))[
        ..., : old.out_channels
    ]
    want = jax.jit(dit.apply, static_argnums=0)(
        old, params, video, conditioning.backbone.tokens_BLC, times
    )
    want = want[:, -got.shape[1] :]
    assert np.abs(want).max() > 0.1
    assert np.abs(got - want).max() <= 1e-6 * np.abs(want).max()

    narrow = widen.narrow(plan, wide["backbone"])
    jax.tree.map(np.testing.assert_array_equal, narrow, params)


@pytest.mark.slow
def test_the_video_model_in_a_training_run_is_exported(widened, tmp_path):
    """All that a run changed goes back, the new channels and the memory blocks apart."""
    config, params = pewm_jax.load(widened)
    trained = {
        **params,
        "backbone": jax.tree.map(lambda x: (x + 0.5).astype(x.dtype), params["backbone"]),
    }
    (tmp_path / "run").mkdir()
    started = dataclasses.replace(config.train, start=str(widened))
    configuration.save(dataclasses.replace(config, train=started), tmp_path / "run/config.json")
    weights.save(tmp_path / "run/weights.safetensors", trained)
    run("export", "diffusers", tmp_path / "run", tmp_path / "back", "--dtype", "bfloat16")
    moved = pipelines.dit("5b-I2V")
    with torch.no_grad():
        for tensor in moved.state_dict().values():
            tensor.add_(0.5)
    got = CogVideoXTransformer3DModel.from_pretrained(
        tmp_path / "back/transformer", torch_dtype=torch.bfloat16
    )
    require_equal(got, moved.to(torch.bfloat16))
    vae = AutoencoderKLCogVideoX.from_pretrained(tmp_path / "back/vae", torch_dtype=torch.bfloat16)
    require_equal(vae, pipelines.vae().to(torch.bfloat16))

    run("export", "diffusers", widened, tmp_path / "at_once")
    plain = CogVideoXTransformer3DModel.from_pretrained(tmp_path / "at_once/transformer")
    require_equal(plain, pipelines.dit("5b-I2V"))


def test_with_actions_it_is_the_original_until_they_are_trained(images, tmp_path):
    dst = tmp_path / "dst"
    run("import", "cogvideox", images, dst, "--actions")
    config, params = pewm_jax.load(dst)
    model = config.model
    assert set(params) == {"backbone", "codec", "control", "text"}
    assert (model.latent_shape, model.in_channels) == ((3, 4, 4), 8)
    rng = np.random.default_rng(0)
    observed = jax.tree.map(lambda x: jnp.asarray(x)[None], random_frames(rng, 1, 32, 32))
    actions = jnp.asarray(rng.normal(size=(1, 8, 3)), jnp.float32)
    camera = jax.tree.map(lambda x: jnp.repeat(x, 9, 1), observed.camera)
    noisy = jnp.asarray(rng.normal(size=(1, 3, 4, 4, 4)), jnp.float32)
    times = jnp.array([700])

    @jax.jit
    def predict(params, actions):
        given = world_model.condition(model, params, observed, Control(camera, actions))
        return world_model.apply(model, params, noisy, given, times), given.backbone

    got, given = predict(params, actions)
    torch_input = torch.from_numpy(np.array(jnp.concatenate([noisy, given.joined_BthwC], -1)))
    with torch.no_grad():
        want = pipelines.dit("5b-I2V")(
            torch_input.permute(0, 1, 4, 2, 3),
            torch.from_numpy(np.array(given.tokens_BLC)),
            torch.tensor([700]),
            image_rotary_emb=get_3d_rotary_pos_embed(16, ((0, 0), (2, 2)), (2, 2), 3),
        ).sample.permute(0, 1, 3, 4, 2)
    assert not np.any(given.joined_BthwC[:, 1:])
    np.testing.assert_allclose(got, want.numpy(), atol=1e-4)

    trained = jax.tree.map(lambda x: x + 0.1, params["control"])
    steered = [predict({**params, "control": trained}, a)[0] for a in (actions, -actions)]
    assert np.abs(steered[0] - steered[1]).max() > 1e-3
    run("export", "diffusers", dst, tmp_path / "back")
    back = CogVideoXTransformer3DModel.from_pretrained(tmp_path / "back/transformer")
    require_equal(back, pipelines.dit("5b-I2V"))


def test_the_preset_with_actions_takes_the_published_network_as_it_is():
    preset = presets.load("egowm_cogvideox")
    settings = dataclasses.replace(preset.model.backbone, learned="interpolate", remat=False)
    published = DiTBackbone.published("5b-I2V")
    made = cogvideox.actions_config_of(
        settings, preset.model.codec, preset.model.noise, (None,) * 3, "bfloat16", run="a"
    )
    assert without(made.train, "run") == without(preset.train, "run")
    assert made.model == preset.model
    assert preset.model.in_channels == published.in_channels
    assert preset.model.codec.channels == published.out_channels


@pytest.mark.slow
def test_settings_of_the_world_model_can_be_given(images, tmp_path):
    settings = tmp_path / "settings.json"
    settings.write_text('{"memory": {"tokens": 32, "heads": 4, "head_dim": 8}}')
    dst = tmp_path / "dst"
    run("import", "cogvideox", images, dst, *WORLD, "--config", settings, "--dtype", "bfloat16")
    config, params = pewm_jax.load(dst)
    assert (config.model.memory.tokens, config.model.clip.height) == (32, 32)
    assert config.model.memory.reader.heads == 4
    assert config.model.dtype == "bfloat16"
    assert {leaf.dtype.name for leaf in jax.tree.leaves(params)} == {"bfloat16"}
    assert config.model.noise.target == "v"


def without(settings, *names):
    """Settings as a table, less what the checkpoint decides."""
    return {k: v for k, v in configuration.to_dict(settings).items() if k not in names}


@pytest.mark.parametrize(("variant", "billions"), [("2b", 0.94), ("5b", 2.84)])
def test_an_imported_checkpoint_starts_from_the_preset_of_its_size(variant, billions):
    """All but the features of the map, which come with --encoder."""
    preset = presets.load(f"pewm_{variant}")
    noise = preset.model.noise
    backbone, codec = DiTBackbone.published(variant), preset.model.codec
    made = cogvideox.config_of(backbone, codec, noise, (None, None, None), "bfloat16")
    assert without(made.train, "run") == without(preset.train, "run")
    assert (made.data, made.evaluate) == (preset.data, preset.evaluate)
    assert without(made.model, "memory", "backbone") == without(preset.model, "memory", "backbone")
    assert without(made.model.backbone, "prompt") == without(preset.model.backbone, "prompt")
    assert without(made.model.memory, "encoder") == without(preset.model.memory, "encoder")
    assert registry.of(made.model.memory.encoder).name == "patch_colours"
    encoder = preset.model.memory.encoder
    made = cogvideox.config_of(backbone, codec, noise, (None,) * 3, "bfloat16", encoder=encoder)
    assert made.model.memory == preset.model.memory
    blocks = jax.eval_shape(lambda: made.model.memory.reader.init(made.model, jax.random.key(0)))
    count = sum(leaf.size for leaf in jax.tree.leaves(blocks))
    assert abs(count / 1e9 - billions) < 0.01


def test_an_imported_world_has_the_paper_s_training_and_small_blocks(widened):
    config, params = pewm_jax.load(widened)
    assert config.train.run == "runs/dst"
    assert (config.train.stage1.learning_rate, config.train.stage1.steps) == (1e-4, 20_000)
    assert config.model.backbone.remat
    backbone, reader = config.model.backbone, config.model.memory.reader
    assert (reader.heads, reader.head_dim) == (backbone.heads, backbone.head_dim)
    assert set(params) == {"backbone", "memory", "codec", "text"}


@pytest.mark.slow(but="drop")
@pytest.mark.parametrize("learned", ["interpolate", "drop", "reference"])
def test_learned_positions_are_for_other_clips_by_choice(images, tmp_path, learned, capsys):
    small = ["--rgbd", "--camera", "--frames", "17"]
    square = ["--height", "32", "--width", "32"]
    wide = square if learned == "reference" else ["--height", "32", "--width", "48"]
    dst = tmp_path / "dst"
    argv = ["import", "cogvideox", images, dst, *small, *wide]
    assert program.main(["convert", *(str(word) for word in argv)]) == 2
    assert "--positions" in capsys.readouterr().err
    run(*argv, "--positions", learned)
    config, params = pewm_jax.load(dst)
    assert config.model.backbone.learned == learned
    assert json.loads((dst / "config.json").read_text())["model"]["backbone"]["learned"] == learned
    shape = (1, *config.model.latent_shape, config.model.in_channels)
    backbone = dataclasses.replace(config.model.backbone, in_channels=shape[-1], out_channels=8)
    text = jnp.zeros((1, *backbone.text_shape))
    apply = jax.jit(dit.apply, static_argnums=0)
    out = apply(backbone, params["backbone"], jnp.ones(shape), text, jnp.array([3]))
    assert np.isfinite(out).all()
    run("export", "diffusers", dst, tmp_path / "back")
    back = CogVideoXTransformer3DModel.from_pretrained(tmp_path / "back/transformer")
    require_equal(back, pipelines.dit("5b-I2V"))


def test_no_more_than_the_network_and_one_tensor_is_in_memory(tmp_path):
    """Measured on 24 layers of 1 MiB in 24 shards; a second copy would be 24 MiB more."""
    layer, layers = (512, 512), 24
    entries = [Entry(f"l.{i}", "w", LINEAR, i) for i in range(layers)]
    spec = {f"l.{i}": jax.ShapeDtypeStruct(layer, np.float32) for i in range(layers)}
    for i, name in enumerate(spec):
        one = {name: spec[name]}
        pairs = [(name, np.full(layer, i, np.float32))]
        tensor_files.write(tmp_path / f"m-{i}.safetensors", one, pairs, {})
    table = {"weight_map": {name: f"m-{i}.safetensors" for i, name in enumerate(spec)}}
    (tmp_path / "m.safetensors.index.json").write_text(json.dumps(table))
    like = {"w": jax.ShapeDtypeStruct((layers, *layer), np.float32)}
    for dtype, each in (("float32", 1 << 20), ("bfloat16", 1 << 19)):
        tracemalloc.start()
        params = pipeline.read_tensors(entries, sources.open_folder(tmp_path), like, dtype)
        weights.save(tmp_path / "out" / "w.safetensors", params)
        specs = pipeline.published_specs(entries, params)
        tensor_files.write(tmp_path / "back", specs, pipeline.write_tensors(entries, params), {})
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert layers * each < peak < layers * each + 2.5 * (1 << 20)
        saved = weights.load(tmp_path / "out" / "w.safetensors")
        np.testing.assert_array_equal(saved["w"][:, 0, 0], np.arange(layers))
        del params, saved
