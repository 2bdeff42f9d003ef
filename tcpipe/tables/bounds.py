"""The bounds of a number, stated in its annotation: ``Annotated[float, Bounds(ge=0, le=1)]``. msgspec checks and describes them."""

from msgspec import Meta as Bounds

__all__ = ["Bounds"]
