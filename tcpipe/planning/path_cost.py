"""The cost of a path: cut into pieces of a metre, one prediction each, and summed (paper, section III)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyproj import Geod

from tcpipe.cost.prediction_errors import COVERAGE, errors_of
from tcpipe.errors import PathError
from tcpipe.geometry.angles import wrap_to_pi
from tcpipe.planning.cost_model import CostModel, check_model
from tcpipe.planning.path_table import PIECES
from tcpipe.planning.pieces import Pieces, cut_path, ground_scale
from tcpipe.planning.reasons import Reason, counts_of
from tcpipe.planning.turning import turning_of, turns_between
from tcpipe.planning.verdicts import Verdicts, in_batches, joined, verdicts_of
from tcpipe.tables.bits import names_of
from tcpipe.terrain.patches import corners_on, footprints
from tcpipe.terrain.projection import Projection, area_of
from tcpipe.terrain.tiles import MapReader, projection_to

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class PathTotals:
    """What a path costs in all, over the pieces that have a cost; ``complete`` says whether all have."""

    length_m: float
    pieces: int
    pieces_without_cost: int
    duration_s: float
    energy_joule: float
    turn_rad: float = 0.0
    """How far it turns, both ways counted."""
    turn_energy_joule: float | None = None
    """Of the energy, what turns cost beyond those of the segments that the model knows; None where its robot's physics is not known, and
    where the model was told the turns: its energies hold them."""
    duration_interval_s: tuple[float, float] | None
    """None, as that of energy, without held-out samples."""
    energy_interval_joule: tuple[float, float] | None
    coverage: float = COVERAGE
    """Share of drives that an interval is to hold."""
    held_out_samples: int = 0
    held_out_runs: int = 0
    """What the intervals are told by."""
    reasons: Mapping[str, int]
    """Pieces by reason; a piece may have several."""
    complete: bool


@dataclass(frozen=True, slots=True)
class PathCost:
    """What a path costs; ``pieces`` is a checked table (`path_table.PIECES`), one row a piece in order."""

    pieces: pa.Table
    totals: PathTotals


def projection_of(source: MapReader) -> Projection:
    """Return the operation from WGS 84 lon, lat [deg] to the map's CRS."""
    return projection_to(source, "EPSG:4326")


def cost_of_path(model: CostModel, source: MapReader, lonlat_deg: Floats, *, where: str) -> PathCost:
    """Return what a path costs.

    Parameters
    ----------
    model, source : who predicts, and the map.
    lonlat_deg : the path's points, WGS 84, shape (P, 2).
    where : what the path is called in errors.

    Raises
    ------
    ModelError, MapError : the map cannot give what the model wants, or cannot be read.
    PathError : the path is shorter than a piece, or nowhere on the map.
    """
    check_model(model, source)
    pieces = pieces_of(source, lonlat_deg, chord_m=model.chord_m, where=where)
    frames = pieces.frames(model.chord_m)
    if not corners_on(source.grid, footprints(frames, model.patch_m)).any():
        raise PathError(off_map_text(source, where, lonlat_deg))
    turn_radpm = _turn_radpm(model, turns_between(pieces.start_xy_m, pieces.end_xy_m) / pieces.arc_m)
    said = joined(verdicts_of(model, source, in_batches(frames), turn_radpm=turn_radpm))
    said.reasons[pieces.arc_m > model.max_arc_to_chord * pieces.chord_m] |= np.uint16(Reason.CURVED)
    return _costed(model, source, pieces, said)


def _turn_radpm(model: CostModel, planned_radpm: Floats) -> Floats:
    """Return how far metres turn: as planned, but NaN, as usual, where that is less: nobody drives as straight as a line is drawn."""
    usual_radpm = 0.0 if model.physics is None else model.physics.usual_turn_radpm
    return np.where(planned_radpm > usual_radpm, planned_radpm, np.nan)


def pieces_of(source: MapReader, lonlat_deg: Floats, *, chord_m: float, where: str) -> Pieces:
    """Return the pieces of a path; `PathError` where it is shorter than one."""
    projection = projection_of(source)
    xy_m = projection.forward(lonlat_deg)
    if not np.isfinite(xy_m).all():
        raise PathError(f"{where}: points of it lie outside the area where the CRS of map {source.name} is defined")
    length_m = float(np.linalg.norm(np.diff(xy_m, axis=0), axis=1).sum()) if len(xy_m) > 1 else 0.0
    scale = ground_scale(projection.target, xy_m)
    if not length_m:
        raise PathError(f"{where}: is one point; wanted a path of at least {chord_m:g} m")
    pieces = cut_path(xy_m, chord_m=chord_m, scale=scale)
    if not pieces.chord_m.size or pieces.chord_m[0] < chord_m * (1.0 - 1e-6):
        raise PathError(
            f"{where}: is {length_m * scale:.2f} m long and never {chord_m:g} m from where it starts; "
            f"wanted a path of at least {chord_m:g} m"
        )
    return pieces


def _costed(model: CostModel, source: MapReader, pieces: Pieces, said: Verdicts) -> PathCost:
    bits, class_id, errors = said.reasons, said.terrain_class, errors_of(model.residuals)
    duration, nothing = pieces.arc_m / said.velocity_mps, np.full(len(bits), np.nan)
    turn_rad = turns_between(pieces.start_xy_m, pieces.end_xy_m)
    turning = None if model.takes_turns else turning_of(model.physics, model.classes)
    turn_joule = nothing if turning is None else turning.energy_joule(turn_rad, pieces.arc_m, class_id)
    energy = said.power_watt * duration + np.nan_to_num(turn_joule)
    turn_joule = np.where(np.isfinite(energy), turn_joule, np.nan)
    (fast, slow), (least, most), sums = (nothing, nothing), (nothing, nothing), None
    if errors is not None:
        fast, slow = errors["duration"].of_pieces(duration, class_id)
        least, most = errors["energy"].of_pieces(energy, class_id)
        sums = errors["duration"].of_sum(duration, class_id), errors["energy"].of_sum(energy, class_id)
    table = PIECES.table(
        piece=np.arange(len(bits)),
        **_places(source, pieces),
        terrain_class=class_id,
        terrain_name=source.classes.names()[class_id].tolist(),
        slope_rad=said.slope_rad,
        cross_slope_rad=said.cross_slope_rad,
        power_watt=said.power_watt,
        velocity_mps=said.velocity_mps,
        duration_s=duration,
        duration_low_s=fast,
        duration_high_s=slow,
        turn_rad=turn_rad,
        turn_energy_joule=turn_joule,
        energy_joule=energy,
        energy_low_joule=least,
        energy_high_joule=most,
        reasons=bits,
        reason_names=[" ".join(names_of(int(value), Reason)) for value in bits],
    )
    without_cost = int(table.column("duration_s").null_count)
    totals = PathTotals(
        length_m=float(pieces.arc_m.sum()),
        pieces=table.num_rows,
        pieces_without_cost=without_cost,
        duration_s=float(np.nansum(duration)),
        energy_joule=float(np.nansum(energy)),
        turn_rad=float(turn_rad.sum()),
        turn_energy_joule=None if turning is None else float(np.nansum(turn_joule)),
        duration_interval_s=sums[0] if sums else None,
        energy_interval_joule=sums[1] if sums else None,
        held_out_samples=errors["energy"].samples if errors else 0,
        held_out_runs=errors["energy"].runs if errors else 0,
        reasons=counts_of(bits),
        complete=not without_cost,
    )
    return PathCost(table, totals)


def _places(source: MapReader, pieces: Pieces) -> dict[str, Floats]:
    """Return where the pieces lie, as columns."""
    projection = projection_of(source)
    start, end = (projection.inverse(xy_m) for xy_m in (pieces.start_xy_m, pieces.end_xy_m))
    azimuth_deg, _, _ = Geod(ellps="WGS84").inv(start[:, 0], start[:, 1], end[:, 0], end[:, 1])
    return {
        "start_lon_deg": start[:, 0],
        "start_lat_deg": start[:, 1],
        "end_lon_deg": end[:, 0],
        "end_lat_deg": end[:, 1],
        "distance_m": np.cumsum(pieces.arc_m) - pieces.arc_m,
        "chord_m": pieces.chord_m,
        "arc_length_m": pieces.arc_m,
        "course_rad": wrap_to_pi(np.radians(90.0 - np.asarray(azimuth_deg))),
    }


def off_map_text(source: MapReader, where: str, lonlat_deg: Floats) -> str:
    """Say that points, shape (P, 2), are not on a map, where that lies, and whether their axes are swapped."""
    west, south, east, north = area_of(projection_of(source).target, source.grid.bounds_m)
    lat, lon = lonlat_deg.T
    swapped = bool(((lon >= west) & (lon <= east) & (lat >= south) & (lat <= north)).any())
    hint = (
        "the axes look swapped; longitude comes first"
        if swapped
        else "wanted lon, lat in WGS 84, and the map of this site"
    )
    extent = f"lon {west:.5f} to {east:.5f}, lat {south:.5f} to {north:.5f}"
    return f"{where}: is not on map {source.name} ({extent}); {hint}"
