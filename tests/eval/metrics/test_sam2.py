"""SAM 2 of the user's files as the segmenter of SCS: a tiny one with random weights."""

import importlib
import re

import numpy as np
import pytest
import torch
import transformers

from pewm_jax.config import UserError
from pewm_jax.eval.metrics import sam2, selection
from pewm_jax.eval.metrics.structure import structural_consistency

SIDE, WIDTH = 64, 128


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    torch.manual_seed(0)
    trunk = transformers.Sam2HieraDetConfig(
        hidden_size=8,
        num_attention_heads=1,
        image_size=[SIDE, SIDE],
        blocks_per_stage=[1, 1, 2, 1],
        embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 2, 4, 8],
        window_size_per_stage=[4, 2, 2, 2],
        global_attention_blocks=[3],
        window_positional_embedding_background_size=[4, 4],
    )
    vision = transformers.Sam2VisionConfig(
        backbone_config=trunk,
        backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=[[16, 16], [8, 8], [4, 4]],
        fpn_hidden_size=WIDTH,
    )
    config = transformers.Sam2VideoConfig(
        vision_config=vision,
        prompt_encoder_config={"hidden_size": WIDTH, "image_size": SIDE, "patch_size": 16},
        mask_decoder_config={"hidden_size": WIDTH, "mlp_dim": 32, "iou_head_hidden_dim": WIDTH},
        image_size=SIDE,
        memory_attention_hidden_size=WIDTH,
        memory_attention_feed_forward_hidden_size=32,
        memory_attention_num_layers=1,
        memory_attention_rope_feat_sizes=[4, 4],
        memory_encoder_hidden_size=WIDTH,
        mask_downsampler_embed_dim=WIDTH,
        memory_fuser_embed_dim=WIDTH,
        memory_fuser_intermediate_dim=32,
        memory_fuser_num_layers=1,
    )
    path = tmp_path_factory.mktemp("sam2")
    model = transformers.Sam2VideoModel(config)
    # Random weights would say that no thing is in view, and then draw no mask.
    torch.nn.init.constant_(model.mask_decoder.pred_obj_score_head.proj_out.bias, 10.0)
    model.save_pretrained(path)
    return path


def clip(size):
    """A video of noise, and the masks of two things in its first frame."""
    video = np.random.default_rng(0).integers(0, 256, (4, size, size, 3), np.uint8)
    first = np.zeros((2, size, size), bool)
    first[0, : size // 2, : size // 2] = True
    first[1, size // 2 :, size // 4 :] = True
    return video, first


@pytest.mark.slow
@pytest.mark.parametrize("size", [SIDE, 48])
def test_it_is_given_the_exact_masks_of_the_first_frame(folder, size):
    video, first = clip(size)
    masks = sam2.read(folder)(video, first)
    assert masks.shape == (2, 4, size, size)
    assert masks.dtype == np.bool_
    both, either = (masks[:, 0] & first).sum((1, 2)), (masks[:, 0] | first).sum((1, 2))
    assert (both / either).min() > 0.8  # the network's masks are a quarter as large


@pytest.mark.slow
def test_it_follows_as_the_reference_does(folder):
    video, first = clip(SIDE)  # of its own size, so that nothing is resized before it
    network = transformers.Sam2VideoModel.from_pretrained(folder).eval()
    colours = torch.tensor(video).permute(0, 3, 1, 2) / 255
    mean, std = (torch.tensor(x)[:, None, None] for x in (sam2.MEAN, sam2.STD))
    session = transformers.Sam2VideoInferenceSession(
        video=(colours - mean) / std, video_height=SIDE, video_width=SIDE, dtype=torch.float32
    )
    for thing in (1, 2):
        mask = torch.tensor(first[thing - 1][None, None], dtype=torch.float32)
        session.add_mask_inputs(session.obj_id_to_idx(thing), 0, mask)
    session.obj_with_new_inputs = [1, 2]
    with torch.inference_mode():
        network(inference_session=session, frame_idx=0)
        wanted = [
            torch.nn.functional.interpolate(
                torch.as_tensor(each.pred_masks),
                size=(SIDE, SIDE),
                mode="bilinear",
                align_corners=False,
            )[:, 0].numpy()
            for each in network.propagate_in_video_iterator(session)
        ]
    found = np.stack(list(sam2._track(network, video, first)))
    np.testing.assert_allclose(found, np.stack(wanted), rtol=1e-4, atol=1e-4)
    assert np.ptp(found[1]) > 0


@pytest.mark.slow
def test_it_scores_a_clip(folder):
    video, first = clip(48)
    true = np.repeat(first[:, None], len(video), 1)
    score = structural_consistency(video, video, true, np.ones(len(video), bool), sam2.read(folder))
    assert score.value == score.ceiling
    assert score.objects == 2


@pytest.mark.slow
def test_a_report_measures_scs_with_it_where_it_is_named(folder):
    measure, about = selection.select_scs(str(folder), ids=True)
    assert measure is not None
    assert measure.name == "SCS[sam2]"
    assert len(measure.sha256) == 64
    assert about.endswith(f"SAM 2 of {folder} propagates the masks.")
    video, first = clip(48)
    true = np.repeat(first[:, None], len(video), 1)
    assert measure(video, true, np.ones(len(video), bool)).shape == (2, len(video) - 1)
    with pytest.raises(UserError, match="no instance ids"):
        selection.select_scs(str(folder), ids=False)


def test_what_is_no_sam_2_is_refused(folder, tmp_path, monkeypatch):
    with pytest.raises(UserError, match=r"contains no SAM 2.*give a folder"):
        sam2.read(tmp_path)
    (tmp_path / "config.json").write_text('{"model_type": "sam2"}')
    with pytest.raises(UserError, match="not of a sam2_video model"):
        sam2.read(tmp_path)
    (tmp_path / "config.json").write_bytes((folder / "config.json").read_bytes())
    with pytest.raises(UserError, match=re.escape("has no model.safetensors")):
        sam2.read(tmp_path)
    whole = (folder / "model.safetensors").read_bytes()
    (tmp_path / "model.safetensors").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match="cannot be read as SAM 2"):
        sam2.read(tmp_path)

    def absent(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(UserError, match=re.escape("pip install 'pewm-jax[sam2]'")):
        sam2.read(folder)
