"""Models as ONNX graphs: data, not code, so that a model folder keeps them and needs no more than ONNX Runtime (extra ``onnx``)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tcpipe.dataset.extra_features import ExtraFeatures
from tcpipe.errors import ModelError
from tcpipe.formats.weights import check_arrays
from tcpipe.learning.network_model import NetworkModel
from tcpipe.learning.predictor import Inputs, Labels, Patches, Predictor


class OnnxModel(Predictor):
    """A graph of patches, and where it has a second input of class, slope, turn and commanded speed, shape (N, 4), float32."""

    about: ClassVar[str] = "an ONNX graph that was given with --predictor"
    graph: bytes = b""

    @cached_property
    def session(self) -> Any:
        """Return the graph, ready to run."""
        _require("onnxruntime")
        import onnxruntime  # noqa: PLC0415  an extra

        try:
            return onnxruntime.InferenceSession(self.graph, providers=["CPUExecutionProvider"])
        except Exception as error:  # noqa: BLE001  its exceptions have no common base
            raise ModelError(f"no ONNX graph that can be run: {str(error).splitlines()[0]}") from None

    def predict(self, patches: Patches, features: ExtraFeatures) -> Labels:
        """Return the first output of the graph."""
        columns = features.class_id, features.slope_rad, features.turn_radpm, features.command_mps
        given = patches, np.column_stack(columns).astype(np.float32)
        names = [wanted.name for wanted in self.session.get_inputs()]
        return np.asarray(self.session.run(None, dict(zip(names, given, strict=False)))[0])

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the graph as bytes."""
        return {"onnx": np.frombuffer(self.graph, np.uint8)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], inputs: Inputs) -> OnnxModel:
        """Return the model of a graph."""
        del inputs
        check_arrays(arrays, {"onnx": ("uint8", ("bytes",))})
        model = cls()
        model.graph = arrays["onnx"].tobytes()
        return model


def export_network(predictor: Predictor, name: str) -> bytes:
    """Return a network as a graph from patches (N, px, px, channels) to its outputs in their units."""
    if not isinstance(predictor, NetworkModel) or predictor.inputs.extra_features:
        raise ModelError(f"{name}: expected a model of kind resnet18 without extra features to write as ONNX")
    _require("onnx")
    from tcpipe.learning.network import export_graph  # noqa: PLC0415  torch takes seconds

    inputs = predictor.inputs
    return export_graph(predictor.network, (inputs.patch_px, inputs.patch_px, len(inputs.planes)), inputs.scale)


def _require(package: str) -> None:
    if find_spec(package) is None:
        raise ModelError(f"{package} not installed, required for ONNX: pip install 'tcpipe[onnx]'")
