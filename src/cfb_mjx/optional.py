"""Values whose type says optional where the code knows they are there."""

from typing import TypeVar

T = TypeVar("T")


def not_none(value: T | None) -> T:
    """`value`, which is known to be there; an AssertionError where it is not."""
    assert value is not None, "a value that is known to be there is missing"
    return value
