"""tcpipe: from raw robot logs to datasets that a terrain-cost model can be trained on.

The commands are functions here too: `read_log`, `ingest`, `add_map`, `build_dataset`, `open_dataset`.
They are loaded when first asked for, so that ``import tcpipe`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.8.0"

_HOMES = {
    "read_log": ("tcpipe.formats.logs.log_file", "open_log"),
    "ingest": ("tcpipe.pipeline.ingest", "ingest"),
    "add_map": ("tcpipe.pipeline.maps", "add_map"),
    "build_dataset": ("tcpipe.pipeline.dataset.build", "build_dataset"),
    "open_dataset": ("tcpipe.dataset", "open_dataset"),
}

__all__ = ["__version__", "add_map", "build_dataset", "ingest", "open_dataset", "read_log"]


def __getattr__(name: str) -> Any:
    """Load a public function from its home on first use."""
    if name not in _HOMES:
        raise AttributeError(f"module 'tcpipe' has no attribute {name!r}")
    module, attribute = _HOMES[name]
    return getattr(import_module(module), attribute)
