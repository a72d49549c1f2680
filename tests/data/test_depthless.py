"""Episodes without depth or poses go where these are not needed, and are refused elsewhere."""

from __future__ import annotations

import dataclasses
import types

import numpy as np
import pytest

from pewm_jax import presets
from pewm_jax.config import ConfigError, UserError
from pewm_jax.data import loader
from pewm_jax.data.checks import check_episode
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.episodes import encode_png, pack_encoded, read_episode
from pewm_jax.data.record_format import DamagedError, new_header
from pewm_jax.data.validate import ValidateConfig, validate
from pewm_jax.worlds.egowm.world import EgoWM
from pewm_jax.worlds.nomad import NomadTask
from tests.data.two_rooms import arrays, write_split

FRAMES, SIZE = 24, 16


def record(depth=True, per_metre=1000.0, info=None):
    made = arrays(frames=FRAMES, size=SIZE, seed=3)
    streams = {"rgb": [encode_png(image[..., ::-1]) for image in made.rgb_THWC]}
    about = {}
    if depth:
        stored = np.rint(made.depth_THW * per_metre).astype(np.uint16)
        streams["depth"] = [encode_png(image) for image in stored]
        about = {"depth": {"per_metre": per_metre}}
    small = {
        "intrinsics": made.intrinsics_4,
        "world_from_camera": made.world_from_camera,
        "actions": made.actions,
    }
    header = new_header("walk", "box", (FRAMES, SIZE, SIZE), info or {})
    return made, pack_encoded(header, small, streams, about)


def split(folder, *records, **listed):
    settings = {"made_by": "import", "actions": {"x": True}, **listed}
    return write_split(folder, list(records), settings, frames=FRAMES * len(records))


@pytest.mark.parametrize("per_metre", [1000.0, 5000.0, 6553.5])
def test_depth_keeps_the_unit_in_which_it_was_stored(per_metre):
    made, code = record(per_metre=per_metre)
    episode = read_episode(code)
    assert episode.header["version"] == (1 if per_metre == 1000 else 2)
    stored = np.rint(made.depth_THW * per_metre) / per_metre
    np.testing.assert_allclose(episode.frames().depth_THW, stored, atol=1e-6)
    assert episode.has_depth
    assert check_episode(episode, "x") == []


def test_an_episode_without_depth_is_whole_and_valid(tmp_path):
    _, code = record(depth=False)
    episode = read_episode(code)
    assert (episode.header["version"], episode.has_depth) == (2, False)
    assert not episode.frames([1, 2]).depth_THW.any()
    split(tmp_path / "train", code)
    assert validate(ValidateConfig(tmp_path), lambda _: None).problems == []
    old = code.replace(b'"version":2', b'"version":1')
    with pytest.raises(DamagedError, match="0 images for 24 frames"):
        read_episode(old)


def config(model, path):
    settings = presets.load("tiny")
    clip = dataclasses.replace(model.clip, height=SIZE, width=SIZE)
    data = dataclasses.replace(settings.data, path=str(path), stride_max=1, context=2)
    model = dataclasses.replace(model, clip=clip)
    return dataclasses.replace(settings, model=model, data=data, train=model.TRAIN())


def without_depth():
    ego = presets.load("egowm_tiny").model
    assert isinstance(ego, EgoWM)
    assert not ego.batch_spec.depth
    assert not ego.batch_spec.poses
    return {"egowm": ego, "nomad": NomadTask()}


@pytest.mark.parametrize("name", ["egowm", "nomad"])
def test_worlds_that_need_no_depth_train_without_it(tmp_path, name):
    _, code = record(depth=False)
    split(tmp_path / "train", code)
    model = without_depth()[name]
    model = dataclasses.replace(model, clip=dataclasses.replace(model.clip, frames=20))
    if name == "egowm":
        model = dataclasses.replace(model, clip=dataclasses.replace(model.clip, frames=9))
        model = dataclasses.replace(model, actions=dataclasses.replace(model.actions, step_m=0.25))
    settings = config(model, tmp_path)
    batch = next(loader.clips(settings, seed=0, batch=2))
    assert batch.frames.rgb_THWC.shape[0] == 2
    assert not np.asarray(batch.frames.depth_THW).any()


def test_other_worlds_refuse_and_say_why(tmp_path):
    (_, deep), (_, code) = record(), record(depth=False)
    pewm = presets.load("tiny").model
    assert pewm.batch_spec.depth
    split(tmp_path / "a" / "train", code)
    with pytest.raises(ConfigError, match="without depth, and PEWM needs it"):
        loader.dataset(config(pewm, tmp_path / "a"), "train", 0, 1)
    split(tmp_path / "b" / "train", deep, code, depth={"x": True, "y": False})
    with pytest.raises(ConfigError, match="without depth"):
        loader.dataset(config(pewm, tmp_path / "b"), "train", 0, 1)


def test_drawn_arms_need_the_body_that_recorded(tmp_path):
    _, code = record(info={"body": {"name": "another", "scale": 1.0}})
    source = EpisodeSource(split(tmp_path / "train", code))
    world = presets.load("egowm_humanoid").model
    states = types.SimpleNamespace(
        states=np.zeros((2, 25)), has_depth=True, info=source[0].info, name="x"
    )
    with pytest.raises(
        ConfigError, match=r"by the body another, and control\.drawn draws the arms"
    ):
        loader.require_recorded(world, source, states)
    states.info = {}
    with pytest.raises(ConfigError, match=r"by an unknown body, .*--model\.control\.no_drawn"):
        loader.require_recorded(world, source, states)
    states.info = {"body": {"name": "humanoid", "scale": 1.0}}
    loader.require_recorded(world, source, states)


def test_unknown_poses_are_refused_where_poses_are_needed(tmp_path):
    _, code = record(info={"poses": "unknown"})
    source = EpisodeSource(split(tmp_path / "train", code))
    worlds = without_depth()
    loader.require_recorded(worlds["egowm"], source)
    egowm = worlds["egowm"]
    rays = dataclasses.replace(egowm, control=dataclasses.replace(egowm.control, rays=True))
    for world in (worlds["nomad"], presets.load("tiny").model, rays):
        with pytest.raises(UserError, match="camera poses are unknown"):
            loader.require_recorded(world, source)
