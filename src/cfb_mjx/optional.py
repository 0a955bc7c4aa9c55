"""Optional values that are known to be present."""

from typing import TypeVar

T = TypeVar("T")


def not_none(value: T | None) -> T:
    """Return ``value``, which must not be None; an AssertionError otherwise."""
    assert value is not None, "a required value is None"
    return value
