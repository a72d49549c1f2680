"""The feed: in order, placed, honest about errors, and gone when training is over."""

import itertools
import threading

import jax
import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.train import sharding
from pewm_jax.train.feed import AHEAD, Feed

WHERE = sharding.of_batch(sharding.make_mesh(jax.devices()[:1]))


def test_batches_come_in_order_and_on_the_devices():
    with Feed(({"x": np.full((8,), n)} for n in itertools.count()), WHERE, 8) as feed:
        for number in range(20):
            batch = next(feed)
            assert batch["x"].sharding == WHERE
            assert batch["x"][0] == number


def test_an_error_of_the_source_is_raised_where_the_batch_would_have_been():
    def source():
        yield np.zeros(8)
        raise UserError("shard 3 is truncated")

    with Feed(source(), WHERE, 8) as feed:
        next(feed)
        with pytest.raises(UserError, match="shard 3"):
            next(feed)


def test_data_that_end_are_an_error():
    with Feed(iter([np.zeros(8)]), WHERE, 8) as feed:
        next(feed)
        with pytest.raises(UserError, match="ended"):
            next(feed)


def test_only_a_few_batches_are_read_ahead_and_the_thread_ends_with_training():
    read, closed = [], threading.Event()

    def source():
        try:
            for number in itertools.count():
                read.append(number)
                yield np.full((8,), number)
        finally:
            closed.set()

    with Feed(source(), WHERE, 8) as feed:
        next(feed)
    assert len(read) <= 1 + AHEAD + 1
    assert closed.is_set()
    assert not any(thread.name == "feed" for thread in threading.enumerate())
