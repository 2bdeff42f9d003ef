from tcpipe import errors
from tcpipe.api import evaluate, plan_path, predict_path, read_log, train
from tcpipe.dataset import open_dataset
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.maps import add_map

__version__: str

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
