"""Marks that tests share."""

import pytest


def some_later(names, values, *first):
    """Parametrize over all values, those that are not among the `first` with `-m slow`."""
    whole = "," in names  # else a value is one argument
    slow = [pytest.param(*(value if whole else (value,)), marks=pytest.mark.slow) for value in values]
    return pytest.mark.parametrize(names, [v if v in first else p for v, p in zip(values, slow, strict=True)])
