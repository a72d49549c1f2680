"""Whatever is wrong with a checkpoint is said in one sentence, and nothing is left half-written."""

import json
import shutil
import sys

import ml_dtypes
import numpy as np
import pytest
import safetensors.numpy

from pewm_jax.cli import main as program
from tests.convert import pipelines

WEIGHTS = "diffusion_pytorch_model"
INDEX = f"{WEIGHTS}.safetensors.index.json"


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    folder = pipelines.save(tmp_path_factory.mktemp("pipeline"), "5b", shard="60KB")
    return pipelines.save_text(folder)


@pytest.fixture
def src(pristine, tmp_path):
    """A copy of the pipeline to spoil."""
    shutil.copytree(pristine, tmp_path / "src")
    return tmp_path / "src"


def refused(capsys, *argv):
    """The one sentence that a refused command prints on stderr."""
    assert program.main(["convert", *map(str, argv)]) == 2
    lines = [x for x in capsys.readouterr().err.splitlines() if x and not x.startswith("Loading")]
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: ")
    assert lines[0].endswith((".", "?"))
    return lines[0]


def edit(path, **changes):
    """Change the keys of a JSON file; None drops one."""
    values = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({k: v for k, v in values.items() if v is not None}))


def first_shard(folder):
    return min(folder.glob("*-of-*.safetensors"))


def change_first_shard(folder, change):
    path = first_shard(folder)
    tensors = safetensors.numpy.load_file(path)
    safetensors.numpy.save_file(change(tensors), path)
    return next(iter(tensors))


def drop_shard(src):
    first_shard(src / "transformer").unlink()


def cut_short(src):
    path = first_shard(src / "vae")
    path.write_bytes(path.read_bytes()[:-10])


def cut_header(src):
    first_shard(src / "vae").write_bytes(b"\x00\x10\x00\x00\x00\x00\x00\x00{")


def not_safetensors(src):
    first_shard(src / "transformer").write_bytes(b"\x04\x00\x00\x00\x00\x00\x00\x00nope")


def drop_index(src):
    (src / "transformer" / INDEX).unlink()


def break_index(src):
    (src / "transformer" / INDEX).write_text("{")


def empty_index(src):
    (src / "transformer" / INDEX).write_text("{}")


def index_of_other_tensors(src):
    path = src / "transformer" / INDEX
    table = json.loads(path.read_text())["weight_map"]
    edit(path, weight_map={**table, "proj_out.other": min(table.values())})


def index_leads_away(src):
    path = src / "transformer" / INDEX
    table = json.loads(path.read_text())["weight_map"]
    edit(path, weight_map={**table, "proj_out.bias": "../vae/config.json"})


def orphan_shard(src):
    shutil.copy(first_shard(src / "vae"), src / f"vae/{WEIGHTS}-00099-of-00099.safetensors")


def adapter(src):
    shutil.copy(first_shard(src / "vae"), src / "pytorch_lora_weights.safetensors")


def extra_tensor(src):
    """A tensor that shard and index both have and the network has not."""
    path = src / "transformer" / INDEX
    table = json.loads(path.read_text())["weight_map"]
    edit(path, weight_map={**table, "lora.down": first_shard(src / "transformer").name})
    change_first_shard(src / "transformer", lambda t: {**t, "lora.down": np.zeros(3, np.float32)})


def deeper(src):
    edit(src / "transformer" / "config.json", num_layers=3)


def wider(src):
    edit(src / "transformer" / "config.json", text_embed_dim=16)


def whole_numbers(src):
    change_first_shard(src / "transformer", lambda t: {k: v.astype(np.int8) for k, v in t.items()})


def pickled(src):
    shutil.rmtree(src / "vae")
    (src / "vae").mkdir()
    (src / f"vae/{WEIGHTS}.bin").write_bytes(b"")
    (src / "vae/config.json").write_text(json.dumps({"_class_name": "AutoencoderKLCogVideoX"}))


def drop_vae(src):
    shutil.rmtree(src / "vae")


def drop_tokenizer(src):
    shutil.rmtree(src / "tokenizer")


def narrow_text(src):
    edit(src / "text_encoder/config.json", d_model=16)


def cut_text(src):
    path = src / "text_encoder/model.safetensors"
    path.write_bytes(path.read_bytes()[:-10])


def no_tokenizer_files(src):
    for path in (src / "tokenizer").iterdir():
        path.write_text("{}")


def class_of(part, file, name):
    return lambda src: edit(src / part / file, _class_name=name)


FAULTS = {
    "missing shard": (drop_shard, "names files that do not exist: diffusion_pytorch_model-00001"),
    "truncated": (cut_short, "is damaged or truncated (incomplete metadata, file not"),
    "truncated in its header": (cut_header, "invalid header length"),
    "no safetensors": (not_safetensors, "invalid JSON in header"),
    "no index": (drop_index, "no *.safetensors.index.json"),
    "broken index": (break_index, "is not valid JSON"),
    "empty index": (empty_index, "has no table weight_map"),
    "index names a tensor that is not there": (index_of_other_tensors, "lacks proj_out.other"),
    "index leads out of its folder": (index_leads_away, "../vae/config.json"),
    "a shard too many": (orphan_shard, "00099-of-00099.safetensors besides the weights of"),
    "an adapter": (adapter, "cannot be used: pytorch_lora_weights.safetensors"),
    "another pipeline": (class_of("", "model_index.json", "WanPipeline"), "'WanPipeline'"),
    "a tensor too many": (extra_tensor, "1 unexpected tensors (lora.down)"),
    "tensors too few": (deeper, "lacks 24 tensors (transformer_blocks.2.attn1.norm_k.bias"),
    "another shape": (wider, "patch_embed.text_proj.weight (32, 12) instead of (32, 16)"),
    "whole numbers": (whole_numbers, "int8 and 16 more: weights of float32"),
    "pickled weights": (pickled, "only diffusion_pytorch_model.bin, which can run code"),
    "no vae": (drop_vae, "has no folder vae/"),
    "unknown transformer": (
        class_of("transformer", "config.json", "WanTransformer3DModel"),
        "is of class 'WanTransformer3DModel'",
    ),
    "unknown vae": (class_of("vae", "config.json", "AutoencoderKL"), "is of class 'AutoencoderKL'"),
    "unknown scheduler": (
        class_of("scheduler", "scheduler_config.json", "DDIMScheduler"),
        "is of class 'DDIMScheduler'",
    ),
    "no class": (class_of("vae", "config.json", None), "is of class None"),
    "unknown setting": (
        lambda src: edit(src / "transformer/config.json", window=3),
        "settings that are not known: window",
    ),
    "unsupported value": (
        lambda src: edit(src / "transformer/config.json", norm_eps=1e-6),
        "norm_eps is 1e-06; only 1e-05 is supported",
    ),
    "no tokenizer": (drop_tokenizer, "src/tokenizer does not; copy both or neither"),
    "another text encoder": (narrow_text, "d_model 16 but the transformer takes text of 12"),
    "truncated text encoder": (cut_text, "is damaged or truncated"),
    "unreadable tokenizer": (no_tokenizer_files, "cannot be read as a tokenizer"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_spoilt_checkpoint_is_refused_in_a_sentence(fault, src, capsys):
    spoil, says = FAULTS[fault]
    spoil(src)
    before = sorted(p.name for p in src.parent.iterdir())
    assert says in refused(capsys, "import", "cogvideox", src, src.parent / "dst")
    assert sorted(p.name for p in src.parent.iterdir()) == before, "something was left behind"


def test_a_failure_in_the_middle_leaves_nothing(src, capsys):
    """A tensor of the VAE does not fit float16: the transformer was written aside by then."""
    change_first_shard(src / "vae", lambda t: {k: v * np.float32(1e6) for k, v in t.items()})
    argv = ["import", "cogvideox", src, src.parent / "dst", "--dtype"]
    assert "beyond float16's 65504" in refused(capsys, *argv, "float16")
    assert [p.name for p in src.parent.iterdir()] == ["src"]
    assert program.main(["convert", *map(str, argv), "bfloat16"]) == 0


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["--rgbd"], "--rgbd was given without --camera"),
        (["--camera"], "--camera was given without --rgbd"),
        (["--memory"], "--memory was given without --rgbd --camera"),
        (["--frames", "9"], "--frames is a setting of a world model"),
        (["--rgbd", "--camera", "--frames", "12"], "4k + 1 frames"),
        (["--rgbd", "--camera", "--frames", "13"], "8k + 1"),
        (["--rgbd", "--camera", "--height", "40"], "multiples of"),
        (["--rgbd", "--camera", "--prompt", "a", "b"], "a world model takes one"),
        (["--positions", "drop"], "--positions is a setting of a world model"),
        (["--actions", "--memory"], "--actions was given with --memory"),
        (["--actions"], "import an image-to-video checkpoint"),
        (["--rgbd", "--camera", "--positions", "drop"], "this transformer has none"),
        (["--dtype", "float8"], "float8"),
        (["--memmory"], "did you mean --memory?"),
        (["--rgbd", "--camera", "--config", "absent.json"], "cannot be read"),
    ],
)
def test_flags_that_cannot_work_are_refused(argv, says, pristine, tmp_path, capsys):
    sentence = refused(capsys, "import", "cogvideox", pristine, tmp_path / "dst", *argv)
    assert says in sentence
    assert not list(tmp_path.iterdir())


def test_an_existing_destination_is_refused(pristine, tmp_path, capsys):
    (tmp_path / "dst").mkdir()
    (tmp_path / "dst" / "mine").write_text("mine")
    for argv in (["import", "cogvideox", pristine], ["export", "diffusers", pristine]):
        assert "exists already" in refused(capsys, *argv, tmp_path / "dst")
    assert (tmp_path / "dst" / "mine").read_text() == "mine"


def test_wrong_folders_are_named(pristine, tmp_path, capsys):
    dst = tmp_path / "dst"
    absent = tmp_path / "absent"
    assert "is not a folder" in refused(capsys, "import", "cogvideox", absent, dst)
    assert "is not a folder" in refused(capsys, "export", "diffusers", absent, dst)
    assert "base.json does not exist" in refused(capsys, "export", "diffusers", pristine, dst)
    assert not dst.exists()


def test_an_import_without_the_libraries_says_what_to_install(
    pristine, tmp_path, capsys, monkeypatch
):
    monkeypatch.setitem(sys.modules, "transformers", None)
    sentence = refused(capsys, "import", "cogvideox", pristine, tmp_path / "dst")
    assert "pip install 'pewm-jax[convert]'" in sentence


def test_the_help_explains_every_command(capsys):
    assert program.main(["convert", "--help"]) == 0
    text = capsys.readouterr().out
    assert program.main(["convert"]) == 2
    assert program.main(["convert", "import"]) == 2
    capsys.readouterr()
    for command in (name for name in program.COMMANDS if name.startswith("convert ")):
        assert f"\n  {command.removeprefix('convert ')} " in text
        with pytest.raises(SystemExit) as leave:
            program.main([*command.split(), "--help"])
        assert leave.value.code == 0
        assert "Folder to create" in capsys.readouterr().out
    assert "did you mean import?" in refused(capsys, "imprt")
    assert "did you mean cogvideox?" in refused(capsys, "import", "cogvideo")


def test_a_bfloat16_file_of_another_writer_is_read(tmp_path):
    from pewm_jax.io import weights

    values = np.linspace(-3, 3, 7).astype(ml_dtypes.bfloat16)
    safetensors.numpy.save_file({"a/b": values}, tmp_path / "w")
    assert weights.load(tmp_path / "w")["a"]["b"].tobytes() == values.tobytes()
    weights.save(tmp_path / "v", {"a": {"b": values}})
    assert safetensors.numpy.load_file(tmp_path / "v")["a/b"].tobytes() == values.tobytes()
