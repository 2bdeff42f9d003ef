"""The cost of a path: cut into segments of a metre, one prediction each, and summed (paper, section III)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import csv
from pyproj import Geod

from tcpipe.arrays import Floats
from tcpipe.cost.adaptation import Adapted, MeasuredRun, Metres, adapt, predict
from tcpipe.cost.prediction_errors import COVERAGE, SumDistribution
from tcpipe.errors import ModelError, PathError
from tcpipe.formats.atomic import write_atomic_file
from tcpipe.formats.geojson import make_line_feature
from tcpipe.formats.json_files import write_json
from tcpipe.geometry.rotation import wrap_to_pi
from tcpipe.learning.models import Model
from tcpipe.path import find_cuts
from tcpipe.planning.cost_model import Reason, SegmentPredictions, check_model, count_reasons, predict_segments
from tcpipe.planning.frames import find_lonlat_projection
from tcpipe.planning.search import Turning, compute_course_changes, find_turning
from tcpipe.splits.audit import PLACES, compute_middles
from tcpipe.tables.bits import flag_names
from tcpipe.tables.columns import Column, TableSchema
from tcpipe.tables.findings import omit
from tcpipe.terrain.projection import compute_area, make_metres_from_plane
from tcpipe.terrain.sampling import PatchFrames, compute_footprints, count_corners_on, make_patch_frames
from tcpipe.terrain.tiles import MapReader


@dataclass(frozen=True, slots=True, kw_only=True)
class PathTotals:
    """Totals of a path over the path segments with a cost, by model, map and robot."""

    model: str
    map: str
    robot: str
    label_energy: str = "total"
    """Kind of energy: ``total`` or ``net``."""
    adapted_by: str | None = omit()
    """Run that adapted the model."""
    length_m: float
    path_segments: int
    path_segments_without_cost: int
    duration_s: float
    energy_joule: float | None
    """None for a model of time alone."""
    turn_rad: float = 0.0
    """Sum of turns in both directions."""
    turn_energy_joule: float | None = None
    """Energy of turns beyond those of the training segments; None without the robot's physics, and for models with
    turns as input, whose energies include it."""
    duration_interval_s: tuple[float, float] | None
    """Interval of the value that the robot's sensors will measure; None without held-out samples, as for energy."""
    energy_interval_joule: tuple[float, float] | None
    energy_common_std_joule: float | None = None
    """Standard deviation of the sensors' measurement (gain and zero of the power sensor); in no interval."""
    coverage: float = COVERAGE
    """Share of drives that an interval is to cover."""
    held_out_samples: int = 0
    held_out_runs: int = 0
    """Samples that determine the intervals."""
    reasons: Mapping[str, int]
    """By reason; a path segment may have several."""
    complete: bool
    """Whether all path segments have a cost."""

    @property
    def known_energy_joule(self) -> float:
        """Return the energy; `ModelError` for a model of time alone."""
        if self.energy_joule is None:
            raise ModelError(f"{self.model}: predicts time alone, expected a model of energy")
        return self.energy_joule


@dataclass(frozen=True, slots=True)
class PathCost:
    """Cost of a path; ``path_segments`` is a checked table (`PATH_SEGMENTS`), one row a path segment in order."""

    path_segments: pa.Table
    totals: PathTotals
    errors: Mapping[str, SumDistribution] | None
    """Distributions of the total ``duration`` [s] and ``energy`` [J]; None without held-out samples."""


def compute_path_cost(
    model: Model,
    source: MapReader,
    lonlat_deg: Floats,
    *,
    where: str,
    known: MeasuredRun | None = None,
    shortest_m: float | None = None,
) -> PathCost:
    """Return the predicted cost of a path; the labelled segments of a run adapt the model, if they are given.

    Parameters
    ----------
    model, source : the model and the map.
    lonlat_deg : the path's points, WGS 84, shape (P, 2).
    where : name of the path in errors.
    known : labelled segments of a run of the robot that will drive the path.
    shortest_m : the least length of a path; None: that of a path segment.

    Raises `PathError` if the path is too short or off the map; `ModelError` if the map lacks a layer of the model.
    """
    check_model(model, source, needs_energy=False)
    segments = _cut_into_segments(source, lonlat_deg, chord_m=model.card.chord_m, where=where, shortest_m=shortest_m)
    frames = segments.frames(model.card.chord_m)
    if not count_corners_on(source.grid, compute_footprints(frames, model.card.inputs.patch_m)).any():
        raise PathError(describe_off_map(source, where, lonlat_deg))
    turn_rad = compute_course_changes(segments.start_xy_m, segments.end_xy_m)
    turn_radpm = turn_rad / segments.arc_m
    usual_radpm = 0.0 if model.card.physics is None else model.card.physics.mean_turn_radpm
    turn_radpm[turn_radpm <= usual_radpm] = np.nan  # usual turns: a real path is never as straight as a drawn line
    prediction = predict_segments(model, source, frames, turn_radpm)
    prediction.reasons[segments.arc_m > model.card.max_arc_to_chord * segments.chord_m] |= np.uint16(Reason.CURVED)
    return _sum_costs(model, source, segments, prediction, turn_rad, known)


def _cut_into_segments(
    source: MapReader, lonlat_deg: Floats, *, chord_m: float, where: str, shortest_m: float | None
) -> PathSegments:
    """Return the path segments of a path; `PathError` if it is shorter than one, or than ``shortest_m``."""
    projection = find_lonlat_projection(source)
    xy_m = projection.forward(lonlat_deg)
    if not np.isfinite(xy_m).all():
        raise PathError(f"{where}: points are outside the area where the CRS of map {source.name} is defined")
    length_m = float(np.linalg.norm(np.diff(xy_m, axis=0), axis=1).sum()) if len(xy_m) > 1 else 0.0
    scale = float(np.mean(np.sqrt(np.abs(np.linalg.det(make_metres_from_plane(projection.target, xy_m))))))
    if not length_m:
        raise PathError(f"{where}: is one point; expected a path of at least {chord_m:g} m")
    segments = cut_path(xy_m, chord_m=chord_m, scale=scale)
    if not segments.chord_m.size or segments.chord_m[0] < (shortest_m or chord_m) * (1.0 - 1e-6):
        raise PathError(
            f"{where}: is {length_m * scale:.2f} m long and never {chord_m:g} m from its start; "
            f"expected a path of at least {chord_m:g} m"
        )
    return segments


def find_added_turning(model: Model) -> Turning | None:
    """Return the cost of turns if a model's predictions exclude it; None if turns are an input, or without physics."""
    return None if model.takes_turns else find_turning(model.card.physics, model.card.class_table)


def _sum_costs(  # noqa: PLR0917
    model: Model,
    source: MapReader,
    segments: PathSegments,
    prediction: SegmentPredictions,
    turn_rad: Floats,
    known: MeasuredRun | None,
) -> PathCost:
    """Return the sums of duration and energy over path segments, with their intervals and the table of segments."""
    class_id, errors, turning = prediction.terrain_class, model.errors, find_added_turning(model)
    nothing = np.full(len(class_id), np.nan)
    duration = segments.arc_m / prediction.velocity_mps
    turn_joule = nothing if turning is None else turning.energy_joule(turn_rad, segments.arc_m, class_id)
    energy = prediction.power_watt * duration + np.nan_to_num(turn_joule)
    turn_joule = np.where(np.isfinite(energy), turn_joule, np.nan)
    found = {
        name: Adapted(total, nothing, nothing, SumDistribution(0.0, 0.0, 0.0))
        for name, total in (("duration", duration), ("energy", energy))
    }
    located = _locate_segments(source, segments)
    if known is not None and errors is None:
        raise ModelError(f"{model.name}: has no error estimates, which adaptation needs; train it on more samples")
    if errors is not None:
        begin_m, rise_m = np.cumsum(segments.arc_m), segments.arc_m * np.tan(prediction.slope_rad)
        for name, predicted in [(name, found[name]) for name in found if name in errors]:
            std = segments.arc_m * (prediction.duration_std_s if name == "duration" else prediction.energy_std_joule)
            near = model.find_near(compute_middles([located[place] for place in PLACES]))
            metres = Metres(
                predicted.value, nothing, class_id, begin_m, segments.arc_m, duration, rise_m, turn_rad, std, near
            )
            found[name] = (
                predict(errors[name], metres) if known is None else adapt(errors[name], known.metres[name], metres)
            )
    time, joule = found["duration"], found["energy"]
    table = PATH_SEGMENTS.table(
        path_segment=np.arange(len(class_id)),
        **located,
        terrain_class=class_id,
        terrain_name=source.classes.names()[class_id].tolist(),
        slope_rad=prediction.slope_rad,
        cross_slope_rad=prediction.cross_slope_rad,
        power_watt=prediction.power_watt,
        velocity_mps=prediction.velocity_mps,
        duration_s=time.value,
        duration_low_s=time.low,
        duration_high_s=time.high,
        turn_rad=turn_rad,
        turn_energy_joule=turn_joule,
        energy_joule=joule.value,
        energy_low_joule=joule.low,
        energy_high_joule=joule.high,
        reasons=prediction.reasons,
        reason_names=[" ".join(flag_names(int(value), Reason)) for value in prediction.reasons],
    )
    without_cost = int(table.column("duration_s").null_count)
    sums = None if errors is None else {name: adapted.total for name, adapted in found.items() if name in errors}
    is_time_alone = model.card.inputs.is_time_alone
    totals = PathTotals(
        model=model.name,
        map=source.name,
        robot=model.card.robot,
        label_energy=model.card.label_energy,
        adapted_by=None if known is None else known.name,
        length_m=float(segments.arc_m.sum()),
        path_segments=table.num_rows,
        path_segments_without_cost=without_cost,
        duration_s=float(np.nansum(time.value)),
        energy_joule=None if is_time_alone else float(np.nansum(joule.value)),
        turn_rad=float(turn_rad.sum()),
        turn_energy_joule=None if turning is None or is_time_alone else float(np.nansum(turn_joule)),
        duration_interval_s=sums["duration"].interval if sums else None,
        energy_interval_joule=sums["energy"].interval if sums and "energy" in sums else None,
        energy_common_std_joule=sums["energy"].common_std if sums and "energy" in sums else None,
        held_out_samples=errors["duration"].samples if errors else 0,
        held_out_runs=errors["duration"].runs if errors else 0,
        reasons=count_reasons(prediction.reasons),
        complete=not without_cost,
    )
    return PathCost(table, totals, sums)


def _locate_segments(source: MapReader, segments: PathSegments) -> dict[str, Floats]:
    """Return the columns of the positions of path segments."""
    projection = find_lonlat_projection(source)
    start, end = (projection.inverse(xy_m) for xy_m in (segments.start_xy_m, segments.end_xy_m))
    azimuth_deg, _, _ = Geod(ellps="WGS84").inv(start[:, 0], start[:, 1], end[:, 0], end[:, 1])
    return {
        "start_lon_deg": start[:, 0],
        "start_lat_deg": start[:, 1],
        "end_lon_deg": end[:, 0],
        "end_lat_deg": end[:, 1],
        "distance_m": np.cumsum(segments.arc_m) - segments.arc_m,
        "chord_m": segments.chord_m,
        "arc_length_m": segments.arc_m,
        "course_rad": wrap_to_pi(np.radians(90.0 - np.asarray(azimuth_deg))),
    }


def describe_off_map(source: MapReader, where: str, lonlat_deg: Floats) -> str:
    """Return a message for points, shape (P, 2), off the map: its extent, and whether their axes are swapped."""
    west, south, east, north = compute_area(find_lonlat_projection(source).target, source.grid.bounds_m)
    lat, lon = lonlat_deg.T
    swapped = bool(((lon >= west) & (lon <= east) & (lat >= south) & (lat <= north)).any())
    hint = (
        "the axes look swapped; longitude comes first"
        if swapped
        else "expected lon, lat in WGS 84, and the map of this site"
    )
    extent = f"lon {west:.5f} to {east:.5f}, lat {south:.5f} to {north:.5f}"
    return f"{where}: is not on map {source.name} ({extent}); {hint}"


_F, _WGS84 = pa.float64(), "WGS84"

PATH_SEGMENTS = TableSchema(
    "path segments",
    "path",
    "Segments of a path in order, with their costs (tcpipe predict-path).",
    (
        Column("path_segment", pa.int64(), "", "Number of the path segment, from 0."),
        Column("start_lon_deg", _F, "deg", "Longitude of its start.", _WGS84),
        Column("start_lat_deg", _F, "deg", "Latitude of its start.", _WGS84),
        Column("end_lon_deg", _F, "deg", "Longitude of its end.", _WGS84),
        Column("end_lat_deg", _F, "deg", "Latitude of its end.", _WGS84),
        Column("distance_m", _F, "m", "Length of the path before it, horizontal."),
        Column("chord_m", _F, "m", "Straight length, horizontal; the last one is the remainder."),
        Column("arc_length_m", _F, "m", "Length along the path, horizontal; its cost is for this length."),
        Column("course_rad", _F, "rad", "Direction of its chord, counter-clockwise from true east.", "ENU"),
        Column("terrain_class", pa.uint8(), "", "Majority class under the chord; 0: none."),
        Column("terrain_name", pa.string(), "", "Name of that class."),
        Column("slope_rad", _F, "rad", "Slope along travel, uphill positive.", nullable=True),
        Column(
            "cross_slope_rad", _F, "rad", "Slope across travel, positive when the left side is higher.", nullable=True
        ),
        Column(
            "power_watt", _F, "W", "Predicted mean power; null without a cost, as all following columns.", nullable=True
        ),
        Column("velocity_mps", _F, "m/s", "Predicted ground velocity.", nullable=True),
        Column("duration_s", _F, "s", "Predicted time: arc length over velocity.", nullable=True),
        Column("duration_low_s", _F, "s", "Lower end of its 90 % interval.", nullable=True),
        Column("duration_high_s", _F, "s", "Upper end of its 90 % interval.", nullable=True),
        Column("turn_rad", _F, "rad", "Turn: half of the change of course at either end."),
        Column(
            "turn_energy_joule", _F, "J",
            "Energy of the turn beyond the turns of training; null without physics.", nullable=True,
        ),
        Column(
            "energy_joule", _F, "J", "Predicted energy: power times time, plus the energy of the turn.", nullable=True
        ),
        Column("energy_low_joule", _F, "J", "Lower end of its 90 % interval.", nullable=True),
        Column("energy_high_joule", _F, "J", "Upper end of its 90 % interval.", nullable=True),
        Column("reasons", pa.uint16(), "bits", "Why it has no cost, or an unreliable one; 0: reliable.", flags=Reason),
        Column("reason_names", pa.string(), "", "The same as names, separated by spaces."),
    ),
)  # fmt: skip


def write_path_segments(path: Path, table: pa.Table) -> None:
    """Write the table as CSV, or as GeoJSON of a line each, whole or not at all."""
    if path.suffix.lower() == ".csv":
        with write_atomic_file(path) as temporary:
            csv.write_csv(table, temporary)
        return
    lines = [
        make_line_feature(
            np.array([[row[f"{end}_{axis}_deg"] for axis in ("lon", "lat")] for end in ("start", "end")]), row
        )
        for row in table.to_pylist()
    ]
    write_json(path, {"type": "FeatureCollection", "features": lines})


@dataclass(frozen=True, slots=True)
class PathSegments:
    """N path segments of a path, in order.

    Attributes
    ----------
    start_xy_m, end_xy_m : in the map's CRS [m], shape (N, 2).
    chord_m, arc_m : straight and along the path, on the ground [m], shape (N,); ``chord_m`` is d but for the last.
    scale : ground metres a map metre.
    """

    start_xy_m: Floats
    end_xy_m: Floats
    chord_m: Floats
    arc_m: Floats
    scale: float

    def frames(self, chord_m: float) -> PatchFrames:
        """Return the patch of each path segment; that of a shorter last one overlaps the patch before it."""
        along = (self.end_xy_m - self.start_xy_m) / np.linalg.norm(self.end_xy_m - self.start_xy_m, axis=1)[:, None]
        start = self.end_xy_m - along * (chord_m / self.scale)
        return make_patch_frames(start, self.end_xy_m, np.full(len(start), chord_m))


def cut_path(xy_m: Floats, *, chord_m: float, scale: float) -> PathSegments:
    """Return the path segments of a polyline.

    Parameters
    ----------
    xy_m : its points in the map's CRS [m], shape (P, 2).
    chord_m : d, on the ground [m].
    scale : ground metres a map metre; over the some kilometres that a robot drives it is one number to 1e-5.
    """
    points = xy_m[np.r_[True, (np.diff(xy_m, axis=0) != 0.0).any(axis=1)]]
    cuts = find_cuts(points.tolist(), chord_m / scale)
    ends = np.array([(x, y) for x, y, _ in cuts]).reshape(-1, 2)
    arc = np.diff(np.array([length for _, _, length in cuts])) * scale
    chord = np.linalg.norm(np.diff(ends, axis=0), axis=1) * scale
    return PathSegments(ends[:-1], ends[1:], chord, arc, scale)
