"""A table model: curves over slope and class, and boosted trees over patch features for the curves' residuals.

Trees are constant outside the training range, and coarse with few samples; the curves continue as straight lines.
LightGBM (extra ``tables``) grows the trees; predicting needs only their arrays. The features come from the tensor
alone:

======== ==============================================================================================================
channel  features
======== ==============================================================================================================
height   slope along travel and steepness across it [rad], curvature along and across [1/m] of the best paraboloid,
         standard deviation from it (roughness) and highest minus lowest pixel (relief) [m]
terrain  share of the patch that each class has
band     mean and standard deviation of each band of a layer of several
others   mean, standard deviation (contrast), mean difference of neighbours along travel (texture)
======== ==============================================================================================================

Mirroring a patch across its travel changes none of them. A pixel without data counts as 0, as in the tensor.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Floats32, GenericArray, Ints, NamedArrays
from tcpipe.dataset.extra_features import ExtraFeatures, standardize_features
from tcpipe.errors import ModelError
from tcpipe.formats.weights import ArrayForm, check_arrays
from tcpipe.learning.fitting import TrainingTimes
from tcpipe.learning.physics_model import Curves, fit_curves, list_curve_arrays, read_curves
from tcpipe.learning.predictor import Fitted, Inputs, Job, Patches, Prediction, Predictor, Samples, require_folds
from tcpipe.recipe import TrainConfig
from tcpipe.terrain.layers import HEIGHT_RANGE_M

_OF_GROUND, _OF_BAND, _OF_OTHERS = 6, 2, 3  # features of a channel


def compute_patch_features(patches: Patches, *, channels: Sequence[str], class_count: int, patch_m: float) -> Floats:
    """Return the features of tensors of shape (N, px, px, channels), shape (N, features).

    Parameters
    ----------
    patches : values in [0, 1]; travel is along the columns.
    channels : channels of the last axis: `Inputs.planes`.
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
    return np.column_stack(parts).astype(float)


def find_slope_and_class(features: Floats, channels: Sequence[str], class_count: int) -> tuple[Floats, Ints]:
    """Return slope [rad] and most frequent class of patches by features, (N,) each; 0 without heights or classes."""
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


def _compute_ground_features(height_m: Patches, patch_m: float) -> Floats32:
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


def make_rules(config: TrainConfig) -> dict[str, str | float | bool]:
    """Return the settings of LightGBM: the same bytes on any number of cores; nothing random."""
    return {
        "objective": "regression", "metric": "l2", "learning_rate": config.tree_learning_rate,
        "num_leaves": config.tree_leaves, "max_depth": config.tree_depth,
        "min_data_in_leaf": config.leaf_samples, "lambda_l2": 1.0, "use_missing": False,
        "num_threads": 1, "deterministic": True, "force_col_wise": True, "verbosity": -1,
    }  # fmt: skip


_HEADER = (
    "tree\nversion=v4\nnum_class=1\nnum_tree_per_iteration=1\nlabel_index=0\nmax_feature_idx={last}\n"
    "objective=regression\nfeature_names={names}\nfeature_infos={infos}\n\n"
)
_TREE = re.compile(
    r"Tree=\d+\nnum_leaves=(\d+)\nnum_cat=0\nsplit_feature=([\d ]*)\n(?:split_gain=.*\n)?threshold=(.*)\n"
    r"decision_type=([2 ]*)\nleft_child=([\d -]*)\nright_child=([\d -]*)\n"
    r"leaf_value=(.*)\n(?:(?:leaf|internal)_.*\n)*is_linear=0\nshrinkage=.*\n+",
    re.ASCII,
)
_WRITTEN = (
    "Tree={}\nnum_leaves={}\nnum_cat=0\nsplit_feature={}\nthreshold={}\ndecision_type={}\n"
    "left_child={}\nright_child={}\nleaf_value={}\nis_linear=0\nshrinkage=1\n\n\n"
)
_END = "end of trees\n"


def clean_trees(text: str, features: int) -> str:
    """Return a LightGBM text model with only the lines that predictions need; `ModelError` for an invalid index."""
    body = text[text.find("Tree=") : text.rfind(_END)]
    found, parts = list(_TREE.finditer(body)), list[str]()
    if not found or sum(len(match[0]) for match in found) != len(body):
        raise ModelError("contains trees that training cannot produce; train the model again")
    for number, match in enumerate(found):
        leaves, (split, threshold, decision, left, right, value) = int(match[1]), match.groups()[1:]
        try:
            feature, children = np.array(split.split(), np.int64), np.array([left.split(), right.split()], np.int64)
            limits, values = (np.array(numbers.split(), float) for numbers in (threshold, value))
        except (ValueError, OverflowError):
            raise ModelError("contains trees with numbers that cannot be read; train the model again") from None
        nodes = np.arange(leaves - 1)
        sizes = len(feature), len(limits), len(decision.split()), children.shape[1], len(values) - 1
        if set(sizes) != {nodes.size} or (feature >= features).any():
            raise ModelError("contains trees with invalid nodes; train the model again")
        if ((children >= nodes.size) | (children < -leaves) | ((children >= 0) & (children <= nodes))).any():
            raise ModelError("contains trees with invalid nodes; train the model again")
        if not (np.isfinite(limits).all() and np.isfinite(values).all()):
            raise ModelError("contains trees with numbers that are not finite; train the model again")
        lines = feature, limits, np.full(nodes.size, 2), *children, values
        parts.append(_WRITTEN.format(number, leaves, *(" ".join(map(repr, line.tolist())) for line in lines)))
    names = " ".join(f"f{number}" for number in range(features))
    head = _HEADER.format(last=features - 1, names=names, infos=" ".join(["none"] * features))
    return head + "".join(parts) + _END


def grow(
    features: Floats, labels: Floats, folds: GenericArray, config: TrainConfig | None = None
) -> tuple[tuple[str, ...], Floats, int]:
    """Fit trees of every output, as many as are best where each fold is predicted by the others.

    Returns LightGBM's text of each output, these predictions, and the largest number of trees of an output.

    Parameters
    ----------
    features : finite, shape (N, features).
    labels : shape (N, outputs).
    folds : of each sample, shape (N,); at least two.
    config : settings of LightGBM.
    """
    config = config or TrainConfig()
    lightgbm, held_out, trees, largest = _load_lightgbm(), np.empty(labels.shape), list[str](), 1
    rules, most = make_rules(config), config.trees
    for number, label in enumerate(labels.T):
        errors, by_fold = np.zeros(most), []
        for fold in np.unique(folds):
            held = folds == fold
            scores: dict[str, dict[str, list[float]]] = {}
            data = lightgbm.Dataset(features[~held], label[~held])
            other = lightgbm.Dataset(features[held], label[held], reference=data)
            by_fold.append((held, lightgbm.train(
                rules, data, most, valid_sets=[other], callbacks=[lightgbm.record_evaluation(scores)]
            )))  # fmt: skip
            found = scores["valid_0"]["l2"]  # shorter if nothing can be split
            errors += held.sum() * np.array(found + found[-1:] * (most - len(found)))
        rounds = int(np.argmin(errors)) + 1
        for held, booster in by_fold:
            held_out[held, number] = booster.predict(features[held], num_iteration=rounds)
        whole = lightgbm.train(rules, lightgbm.Dataset(features, label), rounds)
        trees.append(clean_trees(whole.model_to_string(), features.shape[1]))
        largest = max(largest, whole.num_trees())
    return tuple(trees), held_out, largest


def _load_lightgbm() -> Any:
    try:
        import lightgbm  # noqa: PLC0415  asked for here alone
    except ImportError:
        raise ModelError("lightgbm not installed, required by boosting: pip install 'tcpipe[tables]'") from None
    except OSError as error:
        raise ModelError(f"lightgbm cannot be loaded ({error}); install the system's package libgomp1") from None
    return lightgbm


@dataclass(frozen=True)
class BoostingModel(Predictor):
    """Curves and trees over the features of patches."""

    curves: Curves
    trees: tuple[str, ...]
    """LightGBM's text of each output."""
    inputs: Inputs

    @cached_property
    def _boosters(self) -> list[Any]:
        return [_load_lightgbm().Booster(model_str=text) for text in self.trees]

    def predict_table(self, features: Floats) -> Floats:
        """Return outputs, shape (N, outputs), of features, shape (N, features)."""
        curves = self.curves.predict(*find_slope_and_class(features, self.inputs.planes, self.inputs.class_count))
        found = [np.asarray(booster.predict(features, num_threads=1)) for booster in self._boosters]
        return np.asarray(curves + np.column_stack(found))

    def predict(self, patches: Patches, features: ExtraFeatures) -> Floats:
        """Return outputs, shape (N, outputs)."""
        numbers = standardize_features(self.inputs.extra_features, features)
        out = np.empty((len(patches), len(self.inputs.outputs)))
        for first in range(0, len(patches), _TOGETHER):
            rows = slice(first, first + _TOGETHER)
            plain = _compute_features(patches[rows], self.inputs)
            out[rows] = self.predict_table(np.column_stack([plain, numbers[rows]]))
        return out

    def to_arrays(self) -> dict[str, GenericArray]:
        """Return curves and trees by name."""
        texts = {f"trees_{at}": np.frombuffer(text.encode(), np.uint8) for at, text in enumerate(self.trees)}
        return {**texts, **self.curves.arrays()}

    @classmethod
    def from_arrays(cls, arrays: NamedArrays, inputs: Inputs) -> BoostingModel:
        """Return the model of these arrays."""
        texts: dict[str, ArrayForm] = {f"trees_{at}": ("uint8", (f"bytes_{at}",)) for at in range(len(inputs.outputs))}
        check_arrays(arrays, {**texts, **list_curve_arrays(len(inputs.outputs))})
        curves, _ = read_curves(arrays)
        last = list(_locate_features((*inputs.planes, ""), inputs.class_count))[-1]
        known = last[1] + len(inputs.extra_features)
        trees = tuple(clean_trees(arrays[name].tobytes().decode(errors="replace"), known) for name in texts)
        return cls(curves, trees, inputs)

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
        parts, together = list[Floats](), samples.split.view.form.batch_rows
        for first in range(0, len(samples), together):
            patches = samples.split.batch(np.arange(first, min(first + together, len(samples))))[0]
            parts.append(_compute_features(patches, inputs))
        features = np.column_stack([np.concatenate(parts), numbers])
        model, held_out, trees = fit_table(features, samples.labels, samples.folds, inputs, samples.config)
        times = TrainingTimes(time.perf_counter() - began, len(samples))
        return Fitted(model, Prediction.without_covariance(held_out), trees, trees, training_times_s=times)


_TOGETHER = 256


def _compute_features(patches: Patches, inputs: Inputs) -> Floats:
    planes = inputs.planes
    return compute_patch_features(patches, channels=planes, class_count=inputs.class_count, patch_m=inputs.patch_m)


def fit_table(
    features: Floats, labels: Floats, folds: GenericArray, inputs: Inputs, config: TrainConfig | None = None
) -> tuple[BoostingModel, Floats, int]:
    """Fit curves, and trees to the residuals of curves of the other folds.

    Returns also each sample's prediction by the other folds, and the largest number of trees of an output.

    Parameters
    ----------
    features : finite, shape (N, features): those of the inputs' planes, then any others.
    labels : shape (N, outputs).
    folds : of each sample, shape (N,); at least two.
    inputs, config : inputs of the features, and settings of LightGBM.
    """
    slope_rad, class_id = find_slope_and_class(features, inputs.planes, inputs.class_count)
    curve_labels = np.empty_like(labels)
    for fold in np.unique(folds):
        held = folds == fold
        others = fit_curves(slope_rad[~held], class_id[~held], labels[~held])
        curve_labels[held] = others.predict(slope_rad[held], class_id[held])
    trees, held_out, count = grow(features, labels - curve_labels, folds, config)
    model = BoostingModel(fit_curves(slope_rad, class_id, labels), trees, inputs)
    return model, curve_labels + held_out, count
