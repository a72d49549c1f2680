"""Tiny CogVideoX pipelines with random weights, saved by the reference itself."""

import json

import torch
from diffusers import (
    AutoencoderKLCogVideoX,
    CogVideoXDDIMScheduler,
    CogVideoXDPMScheduler,
    CogVideoXTransformer3DModel,
)

torch.set_num_threads(2)
DIT = {
    "num_attention_heads": 2,
    "attention_head_dim": 16,
    "num_layers": 2,
    "time_embed_dim": 24,
    "text_embed_dim": 12,
    "max_text_seq_length": 6,
    "in_channels": 4,
    "out_channels": 4,
    "sample_height": 4,
    "sample_width": 4,
    "sample_frames": 9,
}
IMAGE = {"in_channels": 8}
NEWER = {"patch_size_t": 2, "patch_bias": False, "use_rotary_positional_embeddings": True}
VARIANTS = {
    "2b": {},
    "5b": {"use_rotary_positional_embeddings": True},
    "5b-I2V": {
        **IMAGE,
        "use_rotary_positional_embeddings": True,
        "use_learned_positional_embeddings": True,
    },
    "1.5-5B": {**NEWER, "sample_height": 300, "sample_width": 300, "sample_frames": 81},
    "1.5-5B-I2V": {
        **NEWER,
        **IMAGE,
        "sample_height": 300,
        "sample_width": 300,
        "sample_frames": 81,
        "ofs_embed_dim": 24,
    },
}
VAE = {
    "block_out_channels": (8, 8, 8, 8),
    "latent_channels": 4,
    "layers_per_block": 1,
    "norm_num_groups": 4,
    "sample_height": 32,
    "sample_width": 32,
}
SCHEDULER = {
    "prediction_type": "v_prediction",
    "rescale_betas_zero_snr": True,
    "timestep_spacing": "trailing",
    "snr_shift_scale": 1.0,
}


def randomise(network, seed):
    """Draw every tensor at random, norms and biases too: ones and zeros hide faults."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, tensor in network.state_dict().items():
            centre = 1.0 if "norm" in name and name.endswith("weight") else 0.0
            tensor.copy_(centre + 0.2 * torch.randn(tensor.shape, generator=generator))
    return network.eval()


def dit(variant, seed=0):
    return randomise(CogVideoXTransformer3DModel(**{**DIT, **VARIANTS[variant]}), seed)


def vae(seed=1):
    return randomise(AutoencoderKLCogVideoX(**VAE), seed)


def save(folder, variant="5b", dtype=torch.float32, shard="10GB", sampler="ddim"):
    """Write a pipeline's folder as the published ones are laid out, without a text encoder."""
    options = {"max_shard_size": shard}
    for part, network in (("transformer", dit(variant)), ("vae", vae())):
        stored = network if dtype == torch.float32 else network.to(dtype)
        stored.save_pretrained(folder / part, **options)
    kind = {"ddim": CogVideoXDDIMScheduler, "dpm": CogVideoXDPMScheduler}[sampler]
    kind(**SCHEDULER).save_pretrained(folder / "scheduler")
    image = "in_channels" in VARIANTS[variant]
    index = {
        "_class_name": "CogVideoXImageToVideoPipeline" if image else "CogVideoXPipeline",
        "_diffusers_version": "0.36.0",
        "scheduler": ["diffusers", kind.__name__],
        "text_encoder": ["transformers", "T5EncoderModel"],
        "tokenizer": ["transformers", "PreTrainedTokenizerFast"],
        "transformer": ["diffusers", "CogVideoXTransformer3DModel"],
        "vae": ["diffusers", "AutoencoderKLCogVideoX"],
    }
    (folder / "model_index.json").write_text(json.dumps(index))
    return folder


def save_text(folder, width=12):
    """Add a tiny T5 encoder and a tokenizer of a few words; nothing is fetched."""
    from tokenizers import Tokenizer, models, pre_tokenizers, processors
    from transformers import PreTrainedTokenizerFast, T5Config, T5EncoderModel

    words = ["<pad>", "</s>", "<unk>", "a", "room", "with", "chair"]
    model = models.WordLevel({word: i for i, word in enumerate(words)}, unk_token="<unk>")
    tokenizer = Tokenizer(model)
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.post_processor = processors.TemplateProcessing(
        single="$A </s>", special_tokens=[("</s>", 1)]
    )
    PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", eos_token="</s>", unk_token="<unk>"
    ).save_pretrained(folder / "tokenizer")
    config = T5Config(
        vocab_size=len(words),
        d_model=width,
        d_kv=4,
        d_ff=16,
        num_layers=1,
        num_heads=2,
        feed_forward_proj="gated-gelu",
    )
    randomise(T5EncoderModel(config), 2).save_pretrained(folder / "text_encoder")
    return folder
