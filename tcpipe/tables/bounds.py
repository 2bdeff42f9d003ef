"""Bounds of a number in its annotation, ``Annotated[float, Bounds(ge=0, le=1)]``, checked and described by msgspec."""

from msgspec import Meta as Bounds

__all__ = ["Bounds"]
