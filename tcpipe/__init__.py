"""tcpipe: from raw robot logs to datasets that a terrain-cost model can be trained on.

The commands are functions here too: `read_log`, `ingest`, `add_map`, `build_dataset`, `open_dataset`,
`train`, `evaluate`, `predict_path`, `plan_path`. They are loaded at first use, so that ``import tcpipe`` is fast;
``__init__.pyi`` gives editors and type checkers the module of each.
"""

from importlib import import_module
from typing import Any

__version__ = "2.0.0"

_HOMES = {
    "read_log": ("tcpipe.api", "read_log"),
    "ingest": ("tcpipe.pipeline.ingest", "ingest"),
    "add_map": ("tcpipe.pipeline.maps", "add_map"),
    "build_dataset": ("tcpipe.pipeline.dataset.build", "build_dataset"),
    "open_dataset": ("tcpipe.dataset", "open_dataset"),
    "train": ("tcpipe.api", "train"),
    "evaluate": ("tcpipe.api", "evaluate"),
    "predict_path": ("tcpipe.api", "predict_path"),
    "plan_path": ("tcpipe.api", "plan_path"),
}

__all__ = [
    "__version__",
    "add_map",
    "build_dataset",
    "errors",
    "evaluate",
    "ingest",
    "open_dataset",
    "plan_path",
    "predict_path",
    "read_log",
    "train",
]


def __getattr__(name: str) -> Any:
    """Load a public function from its home on first use."""
    if name == "errors":
        return import_module("tcpipe.errors")
    if name not in _HOMES:
        raise AttributeError(f"module 'tcpipe' has no attribute {name!r}")
    module, attribute = _HOMES[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    """List the public names; all other loaded names are private."""
    return __all__
