"""Boosted trees over numbers, as plain arrays: made by LightGBM (extra ``tables``), asked without it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import compile_kernel
from tcpipe.errors import ModelError
from tcpipe.formats.weights import ArrayForm

Floats = NDArray[np.float64]
Indices = NDArray[np.uint32]

MOST_ROUNDS = 150
"""Trees of an output at most; how many of them, the folds say."""

_RULES: Mapping[str, str | float | bool] = {
    "objective": "regression", "metric": "l2", "learning_rate": 0.1, "num_leaves": 15, "max_depth": 6, "min_data_in_leaf": 10,
    "lambda_l2": 1.0, "use_missing": False, "num_threads": 1, "deterministic": True, "force_col_wise": True, "verbosity": -1,
}  # fmt: skip
"""Of LightGBM: small trees that few steps walk, and the same bytes on any number of cores; nothing is drawn."""

_ROWS_TOGETHER = 256


@dataclass(frozen=True, slots=True)
class Forest:
    """Trees whose nodes lie one after another; an output is the sum of the leaves that its trees lead to."""

    feature: Indices
    """What a node asks for."""
    threshold: Floats
    """Up to it the first child follows, else the second."""
    child: Indices
    """Both, shape (nodes, 2); a leaf has itself."""
    value: Floats
    """Of a leaf, in the output's unit."""
    root: Indices
    """First node of each tree."""
    depth: Indices
    """Steps to the farthest leaf of each tree."""
    output: Indices
    """That each tree adds to."""

    def predict(self, features: Floats) -> Floats:
        """Return outputs, shape (N, outputs), of features, shape (N, features); `ModelError` where a node asks for another one."""
        if self.feature.max(initial=0) >= features.shape[1]:
            raise ModelError(
                f"trees of {self.feature.max() + 1} features or more, got {features.shape[1]}; train the model again"
            )
        out = np.zeros((len(features), int(self.output.max()) + 1))
        _descend(np.ascontiguousarray(features), *(getattr(self, of.name) for of in fields(self)), out)
        return out

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Return everything by name, as `read_forest` takes it."""
        return asdict(self)


_INDICES, _NUMBERS = ("uint32", ("nodes",)), ("float64", ("nodes",))
FOREST_FORMS: Mapping[str, ArrayForm] = {
    "feature": _INDICES, "threshold": _NUMBERS, "child": ("uint32", ("nodes", 2)), "value": _NUMBERS,
    "root": ("uint32", ("trees",)), "depth": ("uint32", ("trees",)), "output": ("uint32", ("trees",)),
}  # fmt: skip
"""Types and shapes of a forest's arrays."""
_MOST_FEATURES, _MOST_DEPTH, _MOST_OUTPUTS = 100_000, 64, 1024


def read_forest(arrays: Mapping[str, NDArray[Any]], where: str) -> Forest:
    """Return the forest that `Forest.arrays` told of; `ModelError` if these are another model's."""
    if arrays.keys() != {of.name for of in fields(Forest)}:
        raise ModelError(f"{where}: holds the weights of another model; remove it and train the model again")
    made = Forest(**arrays)
    nodes = len(made.feature)
    most = {
        "child": nodes, "root": nodes, "feature": _MOST_FEATURES, "output": _MOST_OUTPUTS, "depth": _MOST_DEPTH,
    }  # fmt: skip
    if not made.root.size or any((getattr(made, name) >= bound).any() for name, bound in most.items()):
        raise ModelError(f"{where}: holds trees that lead nowhere; train the model again")
    if not (np.isfinite(made.threshold).all() and np.isfinite(made.value).all()):
        raise ModelError(f"{where}: holds trees with numbers that are not finite; train the model again")
    return made


@dataclass(frozen=True, slots=True)
class CrossFittedForest:
    """Trees of all samples, and what those of the other folds said of each sample, shape (N, outputs)."""

    forest: Forest
    held_out: Floats


def grow(features: Floats, labels: Floats, weights: Floats, folds: NDArray[np.generic]) -> CrossFittedForest:
    """Fit trees of every output, as many as are best where each fold is predicted by the others.

    Parameters
    ----------
    features
        Shape (N, features), finite.
    labels, weights
        Shape (N, outputs).
    folds
        Of each sample, shape (N,); at least two.

    Raises
    ------
    ModelError
        LightGBM is not installed, or cannot be loaded.

    """
    lightgbm, planted, held_out = _load_lightgbm(), _ForestBuilder(), np.empty(labels.shape)
    for number, (label, weight) in enumerate(zip(labels.T, weights.T, strict=True)):
        errors, by_fold = np.zeros(MOST_ROUNDS), []
        for fold in np.unique(folds):
            held = folds == fold
            told: dict[str, dict[str, list[float]]] = {}
            data = lightgbm.Dataset(features[~held], label[~held], weight=weight[~held])
            other = lightgbm.Dataset(features[held], label[held], weight=weight[held], reference=data)
            by_fold.append((held, lightgbm.train(
                _RULES, data, MOST_ROUNDS, valid_sets=[other], callbacks=[lightgbm.record_evaluation(told)]
            )))  # fmt: skip
            found = told["valid_0"]["l2"]  # ends where nothing can be split
            errors += weight[held].sum() * np.array(found + found[-1:] * (MOST_ROUNDS - len(found)))
        rounds = int(np.argmin(errors)) + 1
        for held, booster in by_fold:
            held_out[held, number] = booster.predict(features[held], num_iteration=rounds)
        whole = lightgbm.train(_RULES, lightgbm.Dataset(features, label, weight=weight), rounds)
        for tree in whole.dump_model()["tree_info"]:
            planted.plant(tree["tree_structure"], number)
    return CrossFittedForest(planted.forest(), held_out)


class _ForestBuilder:
    """Nodes and trees so far."""

    def __init__(self) -> None:
        self._nodes: list[tuple[int, float, tuple[int, int], float]] = []
        self._trees: list[tuple[int, int, int]] = []

    def plant(self, tree: Mapping[str, Any], output: int) -> None:
        """Add a tree of LightGBM's dump."""
        root = len(self._nodes)
        self._trees.append((root, self._add(tree), output))

    def forest(self) -> Forest:
        """Return everything as arrays."""
        feature, threshold, child, value = zip(*self._nodes, strict=True)
        root, depth, output = (np.array(values, np.uint32) for values in zip(*self._trees, strict=True))
        as_indices = (np.array(values, np.uint32) for values in (feature, child))
        return Forest(next(as_indices), np.array(threshold), next(as_indices), np.array(value), root, depth, output)

    def _add(self, node: Mapping[str, Any]) -> int:
        """Append a node and all below it; return how many steps that goes down."""
        at = len(self._nodes)
        self._nodes.append((0, 0.0, (at, at), float(node.get("leaf_value", 0.0))))
        if "leaf_value" in node:
            return 0
        below = self._add(node["left_child"])
        second = len(self._nodes)
        below = max(below, self._add(node["right_child"]))
        self._nodes[at] = int(node["split_feature"]), float(node["threshold"]), (at + 1, second), 0.0
        return 1 + below


def _load_lightgbm() -> Any:
    try:
        import lightgbm  # noqa: PLC0415  asked for here alone
    except ImportError:
        raise ModelError("lightgbm not installed, wanted to train a table: pip install 'tcpipe[tables]'") from None
    except OSError as error:
        raise ModelError(f"lightgbm cannot be loaded ({error}); install the system's package libgomp1") from None
    return lightgbm


@compile_kernel
def _descend(  # noqa: PLR0917
    features: Floats,
    feature: Indices,
    threshold: Floats,
    child: Indices,
    value: Floats,
    root: Indices,
    depth: Indices,
    output: Indices,
    out: Floats,
) -> None:
    """Add to ``out``, (N, outputs), the leaves that trees lead to; rows go down a tree side by side, none waiting for a branch."""
    at = np.empty(_ROWS_TOGETHER, np.uint32)
    for first in range(0, features.shape[0], _ROWS_TOGETHER):
        rows = features[first : first + _ROWS_TOGETHER]
        for tree in range(root.size):
            at[:] = root[tree]
            for _ in range(depth[tree]):
                for n in range(rows.shape[0]):
                    node = at[n]
                    at[n] = child[node, np.uint32(rows[n, feature[node]] > threshold[node])]
            for n in range(rows.shape[0]):
                out[first + n, output[tree]] += value[at[n]]
