"""`pewm-jax show`: what a model imagines beside what was recorded, for other tools."""

import av
import jax
import numpy as np
import pytest
import trimesh

from pewm_jax import config as configuration
from pewm_jax import presets
from pewm_jax.cli import main as program
from pewm_jax.io import weights
from pewm_jax.worlds import init
from tests.data import two_rooms

pytest.importorskip("rerun", reason="rerun-sdk is not installed")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("show")
    config = presets.load("tiny")
    size = config.model.clip.height
    split = folder / "data" / config.evaluate.split
    two_rooms.split(split, 2, 1, frames=14, size=size, width=config.model.clip.width)
    (folder / "run").mkdir()
    configuration.save(config, folder / "run/config.json")
    shapes = jax.eval_shape(lambda key: init(config.model, key), jax.random.key(0))
    random = np.random.default_rng(0)
    params = jax.tree.map(lambda x: 0.1 * random.normal(size=x.shape).astype(x.dtype), shapes)
    weights.save(folder / "run/weights.safetensors", params, {"stage": "2", "step": "1"})
    return folder


@pytest.mark.slow
def test_a_recording_a_map_and_a_video_are_written(run, capsys):
    flags = ["--data", run / "data", "--episode", 1, "--context", 4, "--frames", 9]
    files = {"rerun": run / "r.rrd", "map": run / "m.ply", "video": run / "v.mp4"}
    named = [word for name, file in files.items() for word in (f"--{name}", file)]
    assert program.main(["show", *map(str, (run / "run", *flags, *named))]) == 0
    content = files["rerun"].read_bytes()
    for source in ("true", "imagined"):
        for entity in ("camera/rgb", "camera/depth", "path"):
            assert f"/world/{source}/{entity}".encode() in content
    assert b"/world/map" in content
    assert len(trimesh.load(files["map"]).vertices) > 10
    with av.open(str(files["video"])) as video:
        assert len(list(video.decode(video=0))) == 9
    assert program.main(["show", str(run / "run"), "--video", str(files["video"])]) == 2
    assert "exists already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ([], "Nothing is to be written: give --rerun, --map or --video a file"),
        (["--rerun", "a.txt"], "--rerun is a.txt: name a file that ends in .rrd"),
        (["--map", "a.obj"], "name a file that ends in .ply or .glb"),
        (["--video", "a.mp4", "--frames", "0"], "must be above 0"),
        (["--video", "a.mp4", "--data", "DATA", "--episode", "5"], "has 0 to 1"),
        (["--video", "a.mp4", "--data", "DATA", "--context", "14"], "too few for --context 14"),
    ],
)
def test_what_cannot_be_shown_is_one_sentence(run, flags, said, capsys):
    flags = [str(run / "data") if flag == "DATA" else flag for flag in flags]
    assert program.main(["show", str(run / "run"), *flags]) == 2
    assert said in capsys.readouterr().err
