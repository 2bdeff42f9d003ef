"""What a model says of whole drives that were recorded and ingested, beside what they took."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.cost.prediction_errors import COVERAGE, Errors, fit_errors
from tcpipe.dataset import Dataset
from tcpipe.dataset.energies import ENERGIES
from tcpipe.errors import ModelError, UsageError
from tcpipe.formats.stored_runs import RunDirectory
from tcpipe.planning.cost_model import CostModel, check_model
from tcpipe.planning.no_cost_reasons import Reason
from tcpipe.planning.segment_predictions import SegmentPredictions, iterate_batches, join_predictions, predict_segments
from tcpipe.splits.neighbours import CLOSE, PLACES, are_near, compute_middles_deg
from tcpipe.store import Store
from tcpipe.tables.bits import flag_names
from tcpipe.tables.columns import read_lonlat_deg, to_floats
from tcpipe.terrain.patches import patch_frames
from tcpipe.terrain.tiles import MapReader, find_map_projection

Floats = NDArray[np.float64]

UNCERTAIN, UNLABELLED = "position_uncertain", "no_label"
"""Why a metre is not compared, beside `Reason`."""

_POINTS = 60
"""Of a curve along a drive."""


@dataclass(frozen=True, slots=True)
class IntervalComparison:
    """A drive's sum as it was measured and predicted, and the ends of its interval, None where the model tells no errors."""

    measured: float
    predicted: float
    low: float | None
    high: float | None

    @property
    def off_percent(self) -> float:
        """Return how far the prediction is off."""
        return 100.0 * (self.predicted / self.measured - 1.0) if self.measured else float("nan")

    @property
    def held(self) -> bool | None:
        """Return whether the interval holds what was measured."""
        return None if self.low is None or self.high is None else self.low <= self.measured <= self.high


@dataclass(frozen=True, slots=True)
class CumulativeSums:
    """Sums along a drive, over the metres that are compared, at up to 60 places."""

    distance_m: tuple[float, ...]
    duration_s: tuple[IntervalComparison, ...]
    energy_joule: tuple[IntervalComparison, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveCost:
    """A drive: what was driven, what of it can be compared, what that took and was predicted to take."""

    run_id: str
    log: str
    map: str
    driven_m: float
    """Odometer of the whole drive."""
    segments_m: float
    """Of it in segments: no starts, stops, turns in place, reversing."""
    compared_m: float
    """Of them with labels, on ground that the model knows."""
    rest_m: Mapping[str, float]
    """The other segments, by why they are not compared; a metre may have several reasons."""
    samples_in_training: int
    """Of this very drive: a drive with any is not held back."""
    near_training_percent: float
    """Of its segments with their middle within 1.05 chords of that of a training sample of any drive."""
    duration_s: IntervalComparison
    energy_joule: IntervalComparison
    label_energy: str
    along: CumulativeSums

    @property
    def held_back(self) -> bool:
        """Return whether nothing of the drive was trained on."""
        return self.samples_in_training == 0


def find_drive(store: Store, log: str) -> RunDirectory:
    """Return the ingested run of a log, by its path or its run's name; `UsageError` if there is none, or it lies under several recipes."""
    found = []
    for run in store.runs():
        known = store.run_json(run.run_id)
        paths = known.source.paths if known else ()
        if log == run.run_id or str(Path(log).absolute()) in {str(Path(path).absolute()) for path in paths}:
            found.append(run)
    if not found:
        raise UsageError(
            f"{log}: no run of this log in {store.root}; wanted its path or its run's name: run 'tcpipe ingest {log}' first"
        )
    if len(found) > 1:
        recipes = ", ".join(run.recipe_id for run in found)
        raise UsageError(
            f"{log}: {store.root} holds it under several recipes ({recipes}); wanted one: give a store with it alone"
        )
    return found[0]


def compute_drive_cost(model: CostModel, source: MapReader, run: RunDirectory, data: Dataset, *, log: str) -> DriveCost:
    """Return what a drive took beside what a model says of it.

    Parameters
    ----------
    model, source : who predicts, and the map.
    run : the drive, ingested.
    data : the dataset that the model was trained on: what of the drive it has seen.
    log : what the user calls it.

    Raises
    ------
    ModelError, MapError : the model is of another robot or dataset, or the map cannot give what it wants.
    UsageError : the drive has no segments.
    """
    check_model(model, source)
    segments = run.segments()
    if run.manifest.robot != model.robot:
        raise ModelError(f"{log}: is of robot {run.manifest.robot}, model {model.name} of {model.robot}")
    if not segments.num_rows:
        raise UsageError(f"{log}: run {run.run_id} has no segments to compare; see 'tcpipe report' for why")
    segments = segments.sort_by("start_ns")
    said = _predict_drive(model, source, segments, data)
    reasons, energy = _list_reasons(model, segments, said, data), ENERGIES[model.label_energy].energy
    length_m, good = to_floats(segments, "arc_length_m"), np.array([not why for why in reasons])
    named = sorted({name for why in reasons for name in why})
    trained = data["train"]
    near = are_near(
        compute_middles_deg({name: to_floats(segments, name) for name in PLACES}),
        compute_middles_deg({name: trained.column(name) for name in PLACES}), within_m=CLOSE * model.chord_m,
    )  # fmt: skip
    duration = to_floats(segments, "chord_m") / said.velocity_mps
    along = _sum_along(
        fit_errors(model.residuals), said.terrain_class[good], np.cumsum(length_m)[good],
        (to_floats(segments, "duration_s")[good], duration[good]),
        (to_floats(segments, energy)[good], (said.power_watt * duration)[good]),
    )  # fmt: skip
    return DriveCost(
        run_id=run.run_id, log=log, map=source.name, driven_m=float(sum(run.manifest.distance_by_reason_m.values())),
        segments_m=float(length_m.sum()), compared_m=float(length_m[good].sum()),
        rest_m={name: float(length_m[[name in why for why in reasons]].sum()) for name in named},
        samples_in_training=int((trained.column("run_id").astype(np.str_) == run.run_id).sum()),
        near_training_percent=100.0 * float(near.mean()),
        duration_s=along.duration_s[-1] if along.duration_s else IntervalComparison(0.0, 0.0, None, None),
        energy_joule=along.energy_joule[-1] if along.energy_joule else IntervalComparison(0.0, 0.0, None, None),
        label_energy=model.label_energy, along=along,
    )  # fmt: skip


def _predict_drive(model: CostModel, source: MapReader, segments: pa.Table, data: Dataset) -> SegmentPredictions:
    """Return what the model says of each segment, where it was driven."""
    projection = find_map_projection(source, data.card.recipe.read.gnss_crs)
    start, end = (projection.forward(read_lonlat_deg(segments, name)) for name in ("start", "end"))
    turn_radpm = (
        to_floats(segments, "mean_abs_yaw_rate_radps")
        * to_floats(segments, "duration_s")
        / to_floats(segments, "arc_length_m")
    )
    frames = patch_frames(start, end, to_floats(segments, "chord_m"))
    return join_predictions(predict_segments(model, source, iterate_batches(frames), turn_radpm=turn_radpm))


def _list_reasons(model: CostModel, segments: pa.Table, said: SegmentPredictions, data: Dataset) -> list[list[str]]:
    """Return why each segment is not compared; nothing where it is."""
    uncertain = to_floats(segments, "position_std_m") > data.card.recipe.sample.max_position_std_m
    unlabelled = ~np.isfinite(
        to_floats(segments, ENERGIES[model.label_energy].energy) + to_floats(segments, "duration_s")
    )
    return [
        [*flag_names(bits, Reason), *[UNCERTAIN] * bool(unsure), *[UNLABELLED] * bool(without)]
        for bits, unsure, without in zip(said.reasons, uncertain, unlabelled, strict=True)
    ]


def _sum_along(
    errors: Mapping[str, Errors] | None,
    class_id: NDArray[np.uint8],
    distance_m: Floats,
    duration: tuple[Floats, Floats],
    energy: tuple[Floats, Floats],
) -> CumulativeSums:
    """Return sums of measured and predicted from the drive's beginning to places spread over it, the last at its end."""
    count = len(distance_m)
    ends = sorted({round(end) for end in np.linspace(1, count, min(_POINTS, count)).tolist()}) if count else []

    def sums(quantity: str, measured: Floats, predicted: Floats) -> tuple[IntervalComparison, ...]:
        found = []
        for end in ends:
            low, high = (None, None) if errors is None else errors[quantity].of_sum(predicted[:end], class_id[:end])
            found.append(IntervalComparison(float(measured[:end].sum()), float(predicted[:end].sum()), low, high))
        return tuple(found)

    return CumulativeSums(
        tuple(float(distance_m[end - 1]) for end in ends), sums("duration", *duration), sums("energy", *energy)
    )


def format_drive(drive: DriveCost) -> list[str]:
    """Return what a drive shows, as plain lines."""
    rest = ", ".join(f"{metres:.0f} m {name.replace('_', ' ')}" for name, metres in drive.rest_m.items())
    lines = [
        f"{drive.run_id}: {drive.compared_m:.0f} of {drive.driven_m:.0f} m driven are compared; {drive.segments_m:.0f} m are in segments"
        + (f", of them not compared: {rest}" if rest else ""),
        f"{drive.run_id}: {drive.near_training_percent:.0f} % of its segments are within {CLOSE:g} chords of a training sample",
    ]
    above = ", above standing" if drive.label_energy == "net" else ""
    for called, of, unit in (("time", drive.duration_s, "s"), (f"energy{above}", drive.energy_joule, "J")):
        if drive.compared_m:
            interval = (
                "no interval" if of.low is None or of.high is None
                else f"{COVERAGE:.0%}: {of.low:.0f} to {of.high:.0f}, which {'holds' if of.held else 'does NOT hold'} it"
            )  # fmt: skip
            lines.append(
                f"{drive.run_id}: {called} {of.measured:.0f} {unit} measured, {of.predicted:.0f} {unit} predicted "
                f"({of.off_percent:+.1f} %; {interval})"
            )
    return lines
