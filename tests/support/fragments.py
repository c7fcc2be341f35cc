"""Structs with only those fields that a rule under test reads."""

from typing import Any, TypeVar

Struct = TypeVar("Struct")


def fragment(struct: type[Struct], **fields: Any) -> Struct:
    """A struct that lacks all other fields, so that reading one of them fails."""
    incomplete = object.__new__(struct)
    incomplete.__dict__.update(fields)
    return incomplete
