"""Encode prompts with a pipeline's text encoder, once, at conversion: T5 is not needed afterwards.

As in the reference pipelines, prompts are padded with the pad token to the text length and
truncated there. For CogVideoX the encoder gets no mask; for Cosmos it gets one, and the tokens of
padding are zeros.
"""

from __future__ import annotations

import contextlib
import importlib
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.io import sources, tree

_UNREADABLE = (OSError, ValueError, KeyError, TypeError, ImportError, AttributeError, RuntimeError)
"""What transformers raises for a folder that it cannot read."""


def encode(
    src: Path, prompts: Sequence[str], length: int, width: int, *, masked: bool = False
) -> dict[str, np.ndarray]:
    """Encode prompts with the ``text_encoder/`` and ``tokenizer/`` of a pipeline's folder.

    Args:
        length: text tokens L of the transformer: 226 or 224, in Cosmos 512.
        width: channels of a text token.
        masked: whether padding is masked in the encoder, and its tokens are zeros (Cosmos).

    Returns:
        The tokens (L, width) in float32 by prompt; empty if the folder has no text encoder.

    Raises:
        UserError: only one of the two folders exists, a file is unusable, the width differs, or the
            libraries are not installed.
    """
    encoder, tokenizer = src / "text_encoder", src / "tokenizer"
    there = [folder.is_dir() for folder in (encoder, tokenizer)]
    if not any(there):
        return {}
    if not all(there):
        lone, other = (encoder, tokenizer) if there[0] else (tokenizer, encoder)
        raise UserError(f"{lone} exists and {other} does not; copy both or neither.")
    values = sources.read_config(encoder / "config.json", ["t5"], "model_type")
    if values.get("d_model") != width:
        raise UserError(
            f"{encoder}/config.json has d_model {values.get('d_model')} but the transformer takes "
            f"text of {width} channels; they are not from the same pipeline."
        )
    sources.open_folder(encoder)  # raises an error for an incomplete or damaged folder
    with tempfile.TemporaryDirectory(prefix="pewm-text-") as scratch:
        where = _placement(int(values.get("num_layers", 0)), scratch)
        return _encode(encoder, tokenizer, prompts, length, where, masked=masked)


def _placement(layers: int, scratch: str) -> dict[str, Any]:
    """Return the arguments of ``from_pretrained`` that leave the layers of a T5 encoder on disk.

    Each is read when it is computed, so that one layer is in memory. Without accelerate, the
    encoder is loaded as a whole.
    """
    try:
        utils: Any = importlib.import_module("transformers").utils
    except ImportError:  # refused where it is used
        return {}
    if not layers or not utils.is_accelerate_available():
        return {}
    ends = ("shared", "encoder.embed_tokens", "encoder.final_layer_norm")
    places = dict.fromkeys(ends, "cpu")
    places |= {f"encoder.block.{layer}": "disk" for layer in range(layers)}
    return {"device_map": places, "offload_folder": scratch}


def _encode(
    encoder: Path,
    tokenizer: Path,
    prompts: Sequence[str],
    length: int,
    where: Mapping[str, Any],
    *,
    masked: bool,
) -> dict[str, np.ndarray]:
    try:
        import torch  # noqa: PLC0415 - an extra
        import transformers  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise UserError(
            f"Prompts are encoded by torch and transformers, which cannot be imported ({error}); "
            "run pip install 'pewm-jax[convert]'."
        ) from None
    with _reading(tokenizer, "a tokenizer"):
        tokenize = transformers.AutoTokenizer.from_pretrained(tokenizer, local_files_only=True)
    with _reading(encoder, "a T5 encoder"):
        loaded: Any = transformers.T5EncoderModel.from_pretrained(
            encoder, local_files_only=True, dtype="auto", output_loading_info=True, **where
        )
        model, report = loaded
    wrong = {*report["missing_keys"], *report["unexpected_keys"]}
    if wrong:
        raise UserError(
            f"{encoder} does not contain a T5 encoder: missing or unused are "
            f"{tree.listing(map(str, wrong))}."
        )
    out: dict[str, np.ndarray] = {}
    with torch.inference_mode():
        for prompt in prompts:
            words = tokenize(
                prompt,
                padding="max_length",
                max_length=length,
                truncation=True,
                add_special_tokens=True,
                return_tensors="pt",
            )
            mask = words.attention_mask.bool() if masked else None
            tokens = model.eval()(words.input_ids, attention_mask=mask)[0][0].float()
            if mask is not None:
                tokens = tokens.masked_fill(~mask[0, :, None], 0)
            out[prompt] = tokens.numpy()
            if not np.isfinite(out[prompt]).all():
                raise UserError(
                    f"{encoder} in {model.dtype} overflows on the prompt {prompt!r}; save it in "
                    "bfloat16 or float32."
                )
    return out


@contextlib.contextmanager
def _reading(folder: Path, what: str) -> Iterator[None]:
    """Turn the errors of transformers into one sentence."""
    try:
        yield
    except _UNREADABLE as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        raise UserError(f"{folder} cannot be read as {what} ({lines[0].rstrip('.:')}).") from None
