"""A process reads its own rows of a batch and no others, and they are the batch's."""

import jax
import numpy as np
import pytest
from data_world import split
from hypothesis import given, settings
from hypothesis import strategies as st

from pewm_jax.config import ClipConfig, Config, DataConfig, ModelConfig
from pewm_jax.data import loader

BATCH = 6


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    split(root / "train", episodes=4, frames=16)
    clip = ClipConfig(frames=5, height=16, width=16)
    return Config(
        model=ModelConfig(clip=clip), data=DataConfig(path=str(root), stride_max=3, context=3)
    )


@given(st.integers(0, BATCH - 1), st.integers(1, BATCH), st.integers(0, 9))
@settings(max_examples=20, deadline=None)
def test_rows_are_those_of_the_whole_batch_at_every_step(config, first, count, step):
    rows = slice(first, min(first + count, BATCH))
    whole = next(loader.clips(config, seed=5, batch=BATCH, start_step=step))
    part = next(loader.clips(config, seed=5, batch=BATCH, start_step=step, rows=rows))
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[rows], b), whole, part)


def test_only_the_rows_asked_for_are_decoded(config):
    decoded = []

    def features(episode, frames):
        decoded.append(episode.name)
        return np.zeros((len(frames), 1, 1, 1))

    batches = loader.dataset(config, "train", 5, BATCH, features, rows=slice(2, 4))
    for step in (0, 7):
        decoded.clear()
        assert len(batches[step].context_valid_S) == len(decoded) == 2
