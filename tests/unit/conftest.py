"""One real object store for all tests that ask for it: a fixture imported by each module would start its own."""

from object_gateway import gateway

__all__ = ["gateway"]
