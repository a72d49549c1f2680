"""How many examples a property test draws: few in ``make test``, all in ``make test-all``."""

from hypothesis import settings

QUICK = 8
"""Examples of each property under the profile ``quick``."""

# No test has a deadline: a busy machine is not a defect.
settings.register_profile("quick", deadline=None, max_examples=QUICK, derandomize=True)
settings.register_profile("all", deadline=None)


def examples(count: int) -> settings:
    """Draw ``count`` examples, or fewer under the profile ``quick``."""
    return settings(max_examples=min(count, QUICK) if _is_quick() else count)


def _is_quick() -> bool:
    return settings.default.max_examples == QUICK
