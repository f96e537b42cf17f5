"""Methods as parameters of a test."""

from collections.abc import Collection, Iterable
from typing import Any

import pytest

from rewire_jax.methods import METHODS


def each(quick: Collection[str], methods: Iterable[str] = METHODS) -> list[Any]:
    """The methods as parameters; all but the quick ones are slow tests."""
    marks = {name: () if name in quick else pytest.mark.slow for name in methods}
    return [pytest.param(name, marks=mark) for name, mark in marks.items()]
