"""Properties that hold for whatever hypothesis draws, and shrinks where they fail.

The test run takes a few examples of each property, always the same; `-m slow` takes thousands, others every time.
EXAMPLES=20000 pytest -n0 -m "" tests/test_properties.py  takes as many of each.
"""

import os

import pytest
from hypothesis import HealthCheck, given, settings

FEW, MANY = 40, 3000

few_or_many = pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)], ids=["few", "many"])


def for_all(check, strategy, count):
    """Run check(value) for `count` values; a failure is shown with the smallest value that fails."""
    options = settings(
        max_examples=int(os.environ.get("EXAMPLES", count)), derandomize=count < MANY and "EXAMPLES" not in os.environ,
        deadline=None, database=None, suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    options(given(strategy)(check))()
