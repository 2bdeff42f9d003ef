"""A table model: curves over slope and class, and boosted trees over features of a patch for the residuals of these curves.

Trees alone are constant outside the training range, and coarse with few samples; the curves continue as straight lines. LightGBM (extra
``tables``) grows the trees; predicting needs only their arrays. The features come from the tensor alone:

======== ==================================================================================================================
channel  features
======== ==================================================================================================================
height   slope along travel and steepness across it [rad], curvature along and across [1/m] of the best paraboloid, standard
         deviation of the ground from it (roughness) and highest minus lowest pixel (relief) [m]
terrain  share of the patch that each class has
band     mean and standard deviation of each band of a layer of several; the principal components of their means over the training
         samples, 8 at most, come after the features of all channels
others   mean, standard deviation (contrast), mean difference of neighbours along travel (texture)
======== ==================================================================================================================

Mirroring a patch across its travel changes none of them. A pixel without data counts as 0, as in the tensor.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import compile_kernel
from tcpipe.dataset import Split
from tcpipe.dataset.extra_features import ExtraFeatures, standardize_features
from tcpipe.errors import ModelError
from tcpipe.formats.weights import ArrayForm, check_arrays
from tcpipe.learning.fitting import TrainingTimes
from tcpipe.learning.physics_model import Curves, cross_fit_curves, fit_curves, list_curve_arrays, read_curves
from tcpipe.learning.predictor import Fitted, Inputs, Job, Patches, Prediction, Predictor, Samples, require_folds
from tcpipe.recipe import TrainConfig
from tcpipe.terrain.layers import HEIGHT_RANGE_M

Floats = NDArray[np.float64]

_OF_GROUND, _OF_BAND, _OF_OTHERS = 6, 2, 3
"""Features of a channel."""

MOST_COMPONENTS = 8
"""Principal components of a layer of several bands."""


def compute_patch_features(patches: Patches, *, channels: Sequence[str], class_count: int, patch_m: float) -> Floats:
    """Return the features of tensors of shape (N, px, px, channels), shape (N, features).

    Parameters
    ----------
    patches : values in [0, 1]; travel is along the columns.
    channels : what the last axis holds: `Inputs.planes`.
    class_count : largest class id of the table that the terrain channel is scaled by.
    patch_m : side of a patch [m].
    """
    parts: list[NDArray[np.floating]] = []
    for at, channel in enumerate(channels):
        values = np.ascontiguousarray(patches[..., at])
        if channel == "height":
            parts.append(_compute_ground_features(values * np.float32(HEIGHT_RANGE_M), patch_m))
        elif channel == "terrain":
            parts.append(_compute_class_shares(values, class_count))
        elif _is_band(channel):
            parts.append(np.column_stack([values.mean(axis=(1, 2)), values.std(axis=(1, 2))]))
        else:
            texture = np.abs(np.diff(values, axis=2)).mean(axis=(1, 2))
            parts.append(np.column_stack([values.mean(axis=(1, 2)), values.std(axis=(1, 2)), texture]))
    return np.column_stack(parts).astype(np.float64)


def find_slope_and_class(
    features: Floats, channels: Sequence[str], class_count: int
) -> tuple[Floats, NDArray[np.int64]]:
    """Return slope [rad] and most frequent class of patches by their features, shape (N,) each; 0 without heights, or classes."""
    slope, class_id = np.zeros(len(features)), np.zeros(len(features), np.int64)
    for channel, at in _locate_features(channels, class_count):
        if channel == "height":
            slope = features[:, at]
        elif channel == "terrain":
            class_id = features[:, at : at + class_count].argmax(axis=1) + 1
    return slope, class_id


def _is_band(channel: str) -> bool:
    return "[" in channel


def _locate_features(channels: Sequence[str], class_count: int) -> Iterator[tuple[str, int]]:
    """Yield each channel and the place of its first feature."""
    at = 0
    for channel in channels:
        yield channel, at
        known = {"height": _OF_GROUND, "terrain": class_count}
        at += _OF_BAND if _is_band(channel) else known.get(channel, _OF_OTHERS)


@dataclass(frozen=True, slots=True)
class Components:
    """Principal components of some features: ``(features - centre) @ axes.T``; ``axes`` has the shape (components, features)."""

    centre: Floats
    axes: Floats

    def append(self, features: Floats) -> Floats:
        """Return features with their components behind them."""
        return np.hstack([features, (features - self.centre) @ self.axes.T]) if len(self.axes) else features


def fit_components(features: Floats, channels: Sequence[str], class_count: int) -> Components:
    """Return the first principal components of the means of the bands of each layer, shape (N, features) of training samples."""
    columns: dict[str, list[int]] = {}
    for channel, at in _locate_features(channels, class_count):
        if _is_band(channel):
            columns.setdefault(channel.partition("[")[0], []).append(at)
    centre, rows = features.mean(axis=0), [np.empty((0, features.shape[1]))]
    for places in columns.values():
        _, _, axes = np.linalg.svd(features[:, places] - centre[places], full_matrices=False)
        axes = axes[:MOST_COMPONENTS]
        axes *= np.sign(axes[np.arange(len(axes)), np.abs(axes).argmax(axis=1)])[:, None]  # the sign is anyone's choice
        rows.append(np.zeros((len(axes), features.shape[1])))
        rows[-1][:, places] = axes
    return Components(centre, np.concatenate(rows))


def _compute_ground_features(height_m: Patches, patch_m: float) -> NDArray[np.float32]:
    px = height_m.shape[1]
    along = np.tile((np.arange(px) + 0.5) / px * patch_m - patch_m / 2.0, (px, 1))
    across = along.T
    form = np.stack([np.ones_like(along), along, across, along**2, across**2, along * across]).reshape(6, -1)
    flat = height_m.reshape(len(height_m), px * px)
    fitted = flat @ np.linalg.pinv(form).astype(np.float32)
    roughness = (flat - fitted @ form.astype(np.float32)).std(axis=1)
    slope, steepness = np.arctan(fitted[:, 1]), np.abs(np.arctan(fitted[:, 2]))
    return np.column_stack([slope, steepness, 2.0 * fitted[:, 3:5], roughness, np.ptp(flat, axis=1)])


def _compute_class_shares(values: Patches, class_count: int) -> Floats:
    ids = np.rint(values * np.float32(class_count - 1)).astype(np.int64)
    ids += np.arange(len(values))[:, None, None] * class_count
    counts = np.bincount(ids.ravel(), minlength=len(values) * class_count)
    return np.asarray(counts.reshape(len(values), class_count) / (values.shape[1] * values.shape[2]))


Indices = NDArray[np.uint32]


def make_rules(config: TrainConfig) -> dict[str, str | float | bool]:
    """Return the settings of LightGBM: the same bytes on any number of cores; nothing random."""
    return {
        "objective": "regression", "metric": "l2", "learning_rate": config.tree_learning_rate, "num_leaves": config.tree_leaves,
        "max_depth": config.tree_depth, "min_data_in_leaf": config.leaf_samples, "lambda_l2": 1.0, "use_missing": False,
        "num_threads": 1, "deterministic": True, "force_col_wise": True, "verbosity": -1,
    }  # fmt: skip


_ROWS_TOGETHER = 256


@dataclass(frozen=True, slots=True)
class Forest:
    """Trees whose nodes are stored one after another; an output is the sum of one leaf of each of its trees."""

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
        _descend(np.ascontiguousarray(features), *(getattr(self, entry.name) for entry in fields(self)), out)
        return out

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Return everything by name, as `read_forest` takes it."""
        return asdict(self)


_INDICES, _NUMBERS = ("uint32", ("nodes",)), ("float64", ("nodes",))
_FOREST_FORMS: Mapping[str, ArrayForm] = {
    "feature": _INDICES, "threshold": _NUMBERS, "child": ("uint32", ("nodes", 2)), "value": _NUMBERS,
    "root": ("uint32", ("trees",)), "depth": ("uint32", ("trees",)), "output": ("uint32", ("trees",)),
}  # fmt: skip
"""Types and shapes of a forest's arrays."""
_COMPONENT_FORMS: Mapping[str, ArrayForm] = {
    "centre": ("float64", ("features",)),
    "axes": ("float64", ("components", "features")),
}
_NO_COMPONENTS = {"centre": np.empty(0), "axes": np.empty((0, 0))}
_MOST_FEATURES, _MOST_DEPTH, _MOST_OUTPUTS = 100_000, 64, 1024


def read_forest(arrays: Mapping[str, NDArray[Any]]) -> Forest:
    """Return the forest of `Forest.arrays`, of these forms; `ModelError` if no training makes it."""
    made = Forest(**arrays)
    nodes = len(made.feature)
    most = {
        "child": nodes, "root": nodes, "feature": _MOST_FEATURES, "output": _MOST_OUTPUTS, "depth": _MOST_DEPTH,
    }  # fmt: skip
    if not made.root.size or any((getattr(made, name) >= bound).any() for name, bound in most.items()):
        raise ModelError("contains trees with invalid nodes; train the model again")
    if not (np.isfinite(made.threshold).all() and np.isfinite(made.value).all()):
        raise ModelError("contains trees with numbers that are not finite; train the model again")
    return made


def grow(
    features: Floats, labels: Floats, weights: Floats, folds: NDArray[np.generic], config: TrainConfig | None = None
) -> tuple[Forest, Floats]:
    """Fit trees of every output, as many as are best where each fold is predicted by the others; return these predictions, too.

    Parameters
    ----------
    features
        Shape (N, features), finite.
    labels, weights
        Shape (N, outputs).
    folds
        Of each sample, shape (N,); at least two.
    """
    config = config or TrainConfig()
    lightgbm, held_out, trees = _load_lightgbm(), np.empty(labels.shape), list[tuple[Mapping[str, Any], int]]()
    rules, most = make_rules(config), config.trees
    for number, (label, weight) in enumerate(zip(labels.T, weights.T, strict=True)):
        errors, by_fold = np.zeros(most), []
        for fold in np.unique(folds):
            held = folds == fold
            scores: dict[str, dict[str, list[float]]] = {}
            data = lightgbm.Dataset(features[~held], label[~held], weight=weight[~held])
            other = lightgbm.Dataset(features[held], label[held], weight=weight[held], reference=data)
            by_fold.append((held, lightgbm.train(
                rules, data, most, valid_sets=[other], callbacks=[lightgbm.record_evaluation(scores)]
            )))  # fmt: skip
            found = scores["valid_0"]["l2"]  # ends where nothing can be split
            errors += weight[held].sum() * np.array(found + found[-1:] * (most - len(found)))
        rounds = int(np.argmin(errors)) + 1
        for held, booster in by_fold:
            held_out[held, number] = booster.predict(features[held], num_iteration=rounds)
        whole = lightgbm.train(rules, lightgbm.Dataset(features, label, weight=weight), rounds)
        trees += [(tree["tree_structure"], number) for tree in whole.dump_model()["tree_info"]]
    return _make_forest(trees), held_out


def _make_forest(trees: Sequence[tuple[Mapping[str, Any], int]]) -> Forest:
    """Return trees of LightGBM's dump, each with its output, as arrays."""
    nodes: list[tuple[int, float, tuple[int, int], float]] = []

    def add_node(node: Mapping[str, Any]) -> int:
        """Append a node and all below it; return how many steps that goes down."""
        at = len(nodes)
        nodes.append((0, 0.0, (at, at), float(node.get("leaf_value", 0.0))))
        if "leaf_value" in node:
            return 0
        below = add_node(node["left_child"])
        second = len(nodes)
        below = max(below, add_node(node["right_child"]))
        nodes[at] = int(node["split_feature"]), float(node["threshold"]), (at + 1, second), 0.0
        return 1 + below

    roots = [(len(nodes), add_node(tree), output) for tree, output in trees]
    feature, threshold, child, value = zip(*nodes, strict=True)
    root, depth, output = np.array(roots, np.uint32).T.copy()
    indices = np.array(feature, np.uint32), np.array(child, np.uint32)
    return Forest(indices[0], np.array(threshold), indices[1], np.array(value), root, depth, output)


def _load_lightgbm() -> Any:
    try:
        import lightgbm  # noqa: PLC0415  asked for here alone
    except ImportError:
        raise ModelError("lightgbm not installed, required to train a table: pip install 'tcpipe[tables]'") from None
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
    """Add the leaf values of each row to ``out``, (N, outputs); all rows descend a tree together, without branches."""
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


@dataclass(frozen=True, slots=True)
class TableModel:
    """Curves and trees; ``channels`` and ``class_count`` say where slope and class stand in the features."""

    curves: Curves
    forest: Forest
    channels: tuple[str, ...]
    class_count: int

    def predict(self, features: Floats) -> Floats:
        """Return outputs, shape (N, outputs), of features, shape (N, features)."""
        slope_rad, class_id = find_slope_and_class(features, self.channels, self.class_count)
        return self.curves.predict(slope_rad, class_id) + self.forest.predict(features)

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Return curves and trees by name."""
        return {**self.forest.arrays(), **self.curves.arrays()}


def fit_table(
    features: Floats,
    labels: Floats,
    weights: Floats,
    folds: NDArray[np.generic],
    *,
    channels: Sequence[str],
    class_count: int,
    config: TrainConfig | None = None,
) -> tuple[TableModel, Floats]:
    """Fit curves, and trees to the residuals of curves of the other folds; return also each sample's prediction by the other folds.

    Parameters
    ----------
    features : finite, shape (N, features): those of the channels, then any others.
    labels, weights : shape (N, outputs).
    folds : of each sample, shape (N,); at least two.
    channels, class_count : what the features are of.
    config : settings of LightGBM.
    """
    slope_rad, class_id = find_slope_and_class(features, channels, class_count)
    curve_labels = cross_fit_curves(slope_rad, class_id, labels, folds)
    forest, held_out = grow(features, labels - curve_labels, weights, folds, config)
    curves = fit_curves("linear", slope_rad, class_id, labels)
    return TableModel(curves, forest, tuple(channels), class_count), curve_labels + held_out


@dataclass(frozen=True, slots=True)
class BoostingModel(Predictor):
    """A table model of patches: it computes their features."""

    table: TableModel
    inputs: Inputs
    components: Components

    about: ClassVar[str] = (
        "a curve over the slope of each class, and boosted trees over features of the patch (LightGBM), their number chosen by "
        "cross-validation over the folds of train"
    )
    optimizer: ClassVar[str] = "LightGBM"

    def predict(self, patches: Patches, features: ExtraFeatures) -> Floats:
        """Return outputs, shape (N, outputs)."""
        numbers = standardize_features(self.inputs.extra_features, features)
        out = np.empty((len(patches), len(self.inputs.outputs)))
        for first in range(0, len(patches), _TOGETHER):
            rows = slice(first, first + _TOGETHER)
            of_patches = self.components.append(self._compute_features(patches[rows]))
            out[rows] = self.table.predict(np.column_stack([of_patches, numbers[rows]]))
        return out

    def to_arrays(self) -> dict[str, NDArray[np.generic]]:
        """Return curves, trees and principal components by name."""
        return self.table.arrays() | (asdict(self.components) if len(self.components.axes) else {})

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], inputs: Inputs) -> BoostingModel:
        """Return the model of these arrays."""
        forms = {**_FOREST_FORMS, **list_curve_arrays(len(inputs.outputs))}
        check_arrays(arrays, {**forms, **_COMPONENT_FORMS}, optional=_COMPONENT_FORMS)
        components = {name: array for name, array in arrays.items() if name in _COMPONENT_FORMS}
        curves, rest = read_curves("linear", {name: array for name, array in arrays.items() if name not in components})
        table = TableModel(curves, read_forest(rest), inputs.planes, inputs.class_count)
        return cls(table, inputs, Components(**{**_NO_COMPONENTS, **components}))

    @classmethod
    def fit(cls, samples: Samples) -> Predictor:
        """Fit curves and trees."""
        return cls.fit_folds(samples).predictor

    @classmethod
    def fit_folds(cls, samples: Samples, job: Job | None = None) -> Fitted:
        """Fit curves and trees, as many trees as are best where each fold is predicted by the others."""
        del job
        require_folds(samples.folds)
        began, inputs = time.perf_counter(), samples.inputs
        numbers = standardize_features(inputs.extra_features, samples.features)
        plain = compute_features(samples.split, inputs.patch_m, inputs.class_count)
        components = fit_components(plain, inputs.planes, inputs.class_count)
        features = np.column_stack([components.append(plain), numbers])
        fed_s = time.perf_counter() - began
        table, held_out = fit_table(
            features,
            samples.labels,
            samples.weights,
            samples.folds,
            channels=inputs.planes,
            class_count=inputs.class_count,
            config=samples.config,
        )
        trees = int(np.bincount(table.forest.output).max())
        times = TrainingTimes(time.perf_counter() - began, fed_s, len(samples))
        return Fitted(
            cls(table, inputs, components),
            Prediction.without_covariance(held_out),
            trees,
            trees,
            training_times_s=times,
        )

    def _compute_features(self, patches: Patches) -> Floats:
        inputs = self.inputs
        return compute_patch_features(
            patches, channels=inputs.planes, class_count=inputs.class_count, patch_m=inputs.patch_m
        )


_TOGETHER = 256


def compute_features(split: Split, patch_m: float, class_count: int) -> Floats:
    """Return the features of all samples, shape (N, features); patches are formed some at a time."""
    parts, layout = list[Floats](), split.view.form
    for first in range(0, len(split), layout.batch_rows):
        patches = split.batch(np.arange(first, min(first + layout.batch_rows, len(split))))[0]
        parts.append(compute_patch_features(patches, channels=layout.planes, class_count=class_count, patch_m=patch_m))
    return np.concatenate(parts)
