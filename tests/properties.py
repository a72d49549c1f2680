"""How much of a test runs in ``make test``: few examples and cases, all in ``make test-all``."""

import itertools
from collections.abc import Iterable, Iterator
from typing import TypeVar

import pytest
from hypothesis import settings

Case = TypeVar("Case")

QUICK = 8
"""Examples of each property under the profile ``quick``."""

# No test has a deadline: a busy machine is not a defect.
settings.register_profile("quick", deadline=None, max_examples=QUICK, derandomize=True)
settings.register_profile("all", deadline=None)


def examples(count: int) -> settings:
    """Draw ``count`` examples, or fewer under the profile ``quick``."""
    return settings(max_examples=min(count, QUICK) if _is_quick() else count)


def cases(every: Iterable[Case], step: int) -> Iterator[Case]:
    """Yield all cases, or one of ``step`` under the profile ``quick``."""
    return itertools.islice(every, 0, None, step if _is_quick() else 1)


def first(values: Iterable[Case], count: int) -> list:
    """Return parameters of a test of which those after the first ``count`` are slow."""
    return [
        value if number < count else pytest.param(value, marks=pytest.mark.slow)
        for number, value in enumerate(values)
    ]


def _is_quick() -> bool:
    return settings.default.max_examples == QUICK
