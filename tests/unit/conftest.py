"""What unit tests share; a fixture imported by each module would be made for each."""

from object_gateway import gateway, served

__all__ = ["gateway", "served"]
