"""Runs against maps: the map's registration by heights, contradictions between map and track, and driven obstacles."""

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from tcpipe.arrays import Floats, Ints, Mask
from tcpipe.errors import MapError
from tcpipe.formats.dataset_card import MapRegistration
from tcpipe.formats.json_files import convert_record
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.formats.stored_runs import StoredRun
from tcpipe.recipe import Recipe, SampleConfig
from tcpipe.robust import estimate_shorth
from tcpipe.stages.sample import Sampled, Shifts
from tcpipe.tables.bits import Quality
from tcpipe.tables.columns import read_ends_deg, to_floats
from tcpipe.tables.findings import Finding, Findings, Subject, make_finding, read_threshold
from tcpipe.terrain.projection import Projection
from tcpipe.terrain.registration import REACH_M, HeightScale, Registration, register_track
from tcpipe.terrain.sampling import find_classes_at
from tcpipe.terrain.tiles import find_map_projection

_COLUMNS = ["lon_deg", "lat_deg", "alt_m", "x_std_m", "y_std_m", "z_std_m"]
_BLOCKED = "driven-not-traversable"


def register_runs(
    runs: Sequence[StoredRun], source: MapFile, recipe: Recipe
) -> tuple[tuple[MapRegistration, ...], list[Finding]]:
    """Return the map's registration against each run that crosses enough of it, and findings on misfits.

    Rows of a track count that are certain enough to be sampled. With ``sample.align`` a registration states whether its
    shift is applied, and findings why not. `MapError` if the map's heights are in another unit than metres, or scaled.
    """
    projection = find_map_projection(source, recipe.read.gnss_crs)
    tracks = [_register(run, source, projection, recipe.sample) for run in runs]
    scales = {track.run_id: track.found.scale for track in tracks if track.found is not None}
    wrong = [run_id for run_id, scale in scales.items() if scale.is_wrong()]
    if wrong and not any(scale.is_known and not scale.is_off() for scale in scales.values()):
        raise MapError(_describe_scale(scales[wrong[0]], wrong[0], source))
    registrations, findings = list[MapRegistration](), list[Finding]()
    for track in tracks:
        found = track.found
        reason = track.find_obstacle(recipe.sample.max_position_std_m) if recipe.sample.align else "not wanted"
        subject, names = Subject("run", track.run_id), {"map": source.name}
        if recipe.sample.align and reason and np.isfinite(track.std_m):
            findings.append(make_finding("map-not-aligned", subject, names=names | {"reason": reason}))
        if found is None:
            continue
        registrations.append(_make_map_registration(track.run_id, found, track.expected_m, is_applied=not reason))
        findings += _find_shift(found, track.run_id, source.name, is_applied=not reason)
        findings += _find_other_heights(found, track.expected_m, track.run_id, source.name)
    return tuple(registrations), findings


@dataclass(frozen=True, slots=True)
class _Track:
    """The map's registration against a run's certain positions on it.

    ``expected_m`` is the expected misfit, ``std_m`` the median DRMS of the track on the map, NaN beside it [m].
    """

    run_id: str
    found: Registration | None
    expected_m: float
    std_m: float

    def find_misfit(self) -> str:
        """Return the reason why the run's heights do not fit the map's ground; "" if they fit."""
        if self.found is None:
            return "too few points on the map"
        if self.found.scale.is_off():
            return "heights are scaled"
        if self.found.at_reach:
            return f"the shift may be beyond {REACH_M:g} m"
        return "heights differ" if _is_other_ground(self.found.shape_misfit_m, self.expected_m) else ""

    def find_obstacle(self, max_std_m: float) -> str:
        """Return why a shift cannot be applied, or "" if its DRMS and the track's together are within ``max_std_m``."""
        found = self.found
        if found is None or self.find_misfit():
            return self.find_misfit()
        if not np.isfinite(found.position_std_m):
            return "the ground does not determine the shift"
        is_known = found.position_std_m <= np.sqrt(max_std_m**2 - self.std_m**2)
        return "" if is_known else f"the shift is known only to {found.position_std_m:.2f} m"


def _register(run: StoredRun, source: MapFile, projection: Projection, config: SampleConfig) -> _Track:
    table = run.table("track", _COLUMNS)
    lon, lat, height_m, x_std_m, y_std_m, z_std_m = (to_floats(table, name) for name in _COLUMNS)
    std_m = np.hypot(x_std_m, y_std_m)
    certain: Mask = std_m <= config.max_position_std_m
    lonlat = np.stack([lon, lat], axis=1)[certain]
    map_error_m = read_threshold("map-heights-differ", "map_error_m")
    expected_m = float(np.hypot(np.sqrt(np.mean(z_std_m[certain] ** 2)), map_error_m)) if certain.any() else map_error_m
    xy_m, height_m = projection.forward(lonlat), height_m[certain]
    is_on = source.grid.contains(xy_m)
    track_std_m = float(np.median(std_m[certain][is_on])) if is_on.any() else float("nan")
    return _Track(run.run_id, register_track(source, xy_m, height_m), expected_m, track_std_m)


def _describe_scale(scale: HeightScale, run_id: str, source: MapFile) -> str:
    """Return the error for a map whose heights are not in metres, with the command that corrects its raster."""
    unit, file = scale.find_unit(), source.facts.sources["height"]
    file = "FILE" if "…" in file else shlex.quote(file)
    mended = f"rio edit-info {file} --bidx 1 --units {unit}"
    if not unit:
        files = f"{file} scaled.tif --dtype float32 --co nodata=nan"
        mended = f"rio calc \"(* {scale.value:.3g} (read 1 1 'float64'))\" {files}"
    kind = {"": "scaled", "m": "metres, converted by mistake", "ft": "in feet"}.get(unit, f"in {unit}")
    return (
        f"map {source.name}: it rises by {1 / scale.value:.3g} m (± {100.0 * scale.std / scale.value:.2g} %) where run {run_id} "
        f"rises by 1 m: its heights are {kind}; correct the raster ({mended}) and add it again: "
        f"tcpipe add-map {source.name} --height FILE ... --force"
    )


def _find_shift(found: Registration, run_id: str, name: str, *, is_applied: bool) -> Findings:
    """Return the finding, if any, that the map is shifted against the track, or that the run was moved."""
    is_far = found.significant and found.shift_m > read_threshold("map-shifted", "min_shift_m")
    if not is_far and not is_applied:
        return ()
    east_m, north_m = found.shift_xy_m
    is_error = not is_applied and found.shift_m >= read_threshold("map-shifted", "error_shift_m")
    finding = make_finding(
        "map-aligned" if is_applied else "map-shifted",
        Subject("run", run_id),
        severity="error" if is_error else None,
        names={"map": name},
        shift_m=found.shift_m,
        std_m=found.position_std_m if is_applied else found.shift_std_m,
        east_m=east_m,
        north_m=north_m,
        misfit_m=found.misfit_m,
        shifted_misfit_m=found.shifted_misfit_m,
    )
    return (finding,)


def _find_other_heights(found: Registration, expected_m: float, run_id: str, name: str) -> Findings:
    """Return the finding if heights of map and track differ too much."""
    subject, names = Subject("run", run_id), {"map": name}
    if found.scale.is_off() or found.scale.is_wrong():
        return (make_finding("map-height-scale", subject, names=names, map_rise_m=1 / found.scale.value),)
    if not _is_other_ground(found.left_m, expected_m):
        return ()
    return (make_finding("map-heights-differ", subject, names=names, misfit_m=found.left_m, expected_m=expected_m),)


def _is_other_ground(misfit_m: float, expected_m: float) -> bool:
    return misfit_m > read_threshold("map-heights-differ", "max_misfit_ratio") * expected_m


def _make_map_registration(run_id: str, found: Registration, expected_m: float, *, is_applied: bool) -> MapRegistration:
    """Return the registration for the card: no shift where the ground cannot determine one."""
    unknown = {} if np.isfinite(found.shift_std_m) else dict.fromkeys(("shift_xy_m", "shift_std_m", "shifted_misfit_m"))
    if is_applied:  # to a tenth of a millimetre, so that the last bits of another processor do not move a pixel
        unknown = {
            "shift_xy_m": tuple(round(shift_m, 4) for shift_m in found.shift_xy_m),
            "applied_std_m": found.position_std_m,
        }
    return convert_record(
        found,
        MapRegistration,
        **unknown,
        run_id=run_id,
        height_scale=found.scale.value if found.scale.is_known else None,
        height_scale_std=found.scale.std if found.scale.is_known else None,
        expected_misfit_m=expected_m,
    )


_CONTRADICTION = "map-contradicts-track"
_LIMITS = ("min_slope_rad", "min_slope_rad", "min_rise_m", "min_bulge_m")
_ATTITUDE_ROLES = {"imu", "visual_odometry", "pose"}
_MIN_HEIGHT_CHANGE_M = 0.001  # least range of heights on a track that measures them [m]
_MOTION = ("start_z_m", "end_z_m", "chord_m", "pitch_rad", "roll_rad", "fused_velocity_mps")
_Rows = Floats


def find_contradictions(
    runs: Sequence[StoredRun], segments: pa.Table, sampled: Sampled, map_names: Sequence[str], config: SampleConfig
) -> tuple[NDArray[np.uint32], list[Finding]]:
    """Return `Quality.MAP_CONTRADICTS_TRACK` or 0 of each patch, shape (N,), and findings on their largest clusters.

    Slope, cross slope and heights along the middle of patches are compared run by run; runs without heights and
    attitude are not flagged.
    """
    motion = np.stack([to_floats(segments, name)[sampled.kept] for name in _MOTION])
    patches, (rear_m, centre_m, front_m) = sampled.patches, sampled.patches.profile_m.T
    rise_m, bulge_m = front_m - rear_m, centre_m - (rear_m + front_m) / 2.0
    slope_of_rise = rise_m / (config.patch_m * (1.0 - 1.0 / config.patch_px))
    ground = np.stack([patches.slope_rad, patches.cross_slope_rad, slope_of_rise, bulge_m])
    run_ids = segments.column("run_id").combine_chunks().dictionary_encode()
    code, excess = run_ids.indices.to_numpy(zero_copy_only=False)[sampled.kept], np.zeros(ground.shape)
    fused = {run.run_id: run.manifest.info.report.facts.fuse for run in runs}
    for number in np.unique(code):
        rows, facts = code == number, fused[run_ids.dictionary[number].as_py()]
        has_attitude = facts is not None and not _ATTITUDE_ROLES.isdisjoint(facts.sensors)
        excess[:, rows] = _compare_ground(motion[:, rows], ground[:, rows], has_attitude=has_attitude)
    flags = np.where(excess.any(axis=0), np.uint32(Quality.MAP_CONTRADICTS_TRACK), np.uint32(0))
    return flags, list(_find_clusters(np.flatnonzero(flags), excess, sampled, map_names))


def _compare_ground(motion: _Rows, ground: _Rows, *, has_attitude: bool) -> _Rows:
    """Return how slope, cross slope [rad], rise and bulge [m] of patches differ from the track, (4, N); 0 in limits.

    The track's climb or its pitch counts, whichever is nearer to the map: a jump of the fixes is no error of the map.
    The mounting error of the IMU is a constant of the run.
    """
    start_z_m, end_z_m, chord_m, pitch_rad, roll_rad, speed_mps = motion
    sign, has_height = np.where(speed_mps < 0.0, -1.0, 1.0), np.ptp(end_z_m) > _MIN_HEIGHT_CHANGE_M
    climb_rad = np.where(has_height, np.arctan2(end_z_m - start_z_m, chord_m), np.nan)
    tilt_rad, roll_rad = (np.where(has_attitude, sign * angle, np.nan) for angle in (-pitch_rad, roll_rad))
    tilt_rad -= sign * estimate_shorth(sign * (tilt_rad - climb_rad))[0]
    climb_error, tilt_error = (np.nan_to_num(np.abs(each - ground[0]), nan=np.inf) for each in (climb_rad, tilt_rad))
    slope_rad, cross_rad = np.where(tilt_error < climb_error, tilt_rad, climb_rad), ground[1] - roll_rad
    cross_rad -= sign * estimate_shorth(sign * cross_rad)[0]
    rise_m = chord_m * (ground[2] - np.tan(slope_rad))
    excess = np.stack([ground[0] - slope_rad, cross_rad, rise_m, ground[3] + 0.0 * slope_rad])
    for row, name in zip(excess, _LIMITS, strict=True):
        sigmas = read_threshold(_CONTRADICTION, "min_sigma_ratio") * estimate_shorth(row)[1]
        row[~(np.abs(row) > max(read_threshold(_CONTRADICTION, name), sigmas))] = 0.0
    return excess


def _find_clusters(rows: Ints, excess: _Rows, sampled: Sampled, maps: Sequence[str]) -> Iterator[Finding]:
    """Yield findings on the largest clusters of patches ``rows``: place, size, largest slope and height differences."""
    places = KDTree(np.column_stack([sampled.footprint_xy_m[rows].mean(axis=1), 1e9 * sampled.map_index[rows]]))
    near = places.sparse_distance_matrix(places, read_threshold(_CONTRADICTION, "max_gap_m"))
    cluster, most = connected_components(near)[1], int(read_threshold(_CONTRADICTION, "max_finding_count"))
    for mine in (rows[cluster == number] for number in np.argsort(-np.bincount(cluster), kind="stable")[:most]):
        lon, lat = sampled.footprint_lonlat_deg[mine].mean(axis=(0, 1))
        slope_rad, height_m = (float(np.abs(part[:, mine]).max()) for part in np.split(excess, 2))
        names, subject = {"place": f"{lon:.6f}, {lat:.6f}"}, Subject("map", maps[sampled.map_index[mine[0]]])
        extent_m = float(np.hypot(*np.ptp(sampled.footprint_xy_m[mine].reshape(-1, 2), axis=0)))
        yield make_finding(
            _CONTRADICTION, subject, names=names, sample_count=len(mine), extent_m=extent_m, slope_rad=slope_rad, height_m=height_m
        )  # fmt: skip


def find_driven_obstacles(
    segments: pa.Table, sources: Sequence[MapFile], recipe: Recipe, *, shifts: Sequence[Shifts]
) -> list[Finding]:
    """Return findings on classes that are not traversable, under a large part of the segments.

    Of overlapping ``sources`` the first counts. ``shifts`` are those of the runs, by map.
    """
    runs = segments.column("run_id").combine_chunks().dictionary_encode()
    run, run_ids = runs.indices.to_numpy(zero_copy_only=False), runs.dictionary.to_pylist()
    lonlat_deg = np.mean(read_ends_deg(segments), axis=0)
    length_m, class_id = to_floats(segments, "arc_length_m"), np.zeros(segments.num_rows, np.int64)
    grounds = [(source, moved) for source, moved in zip(sources, shifts, strict=True) if "terrain" in source.layers]
    for source, moved in grounds:
        shift_m = np.array([moved.get(run_id, (0.0, 0.0, 0.0))[:2] for run_id in run_ids])
        unknown = np.flatnonzero(class_id == 0)
        xy_m = find_map_projection(source, recipe.read.gnss_crs).forward(lonlat_deg[unknown]) + shift_m[run[unknown]]
        class_id[unknown] = np.maximum(find_classes_at(source, xy_m), 0)
    findings, least = list[Finding](), read_threshold(_BLOCKED, "min_driven_fraction")
    for entry in grounds[0][0].classes.classes if grounds else ():
        driven_m = float(length_m[class_id == entry.id].sum())
        if entry.traversable or driven_m <= least * length_m.sum():
            continue
        values = [str(value) for value, number in grounds[0][0].id_by_value.items() if number == entry.id]
        subject, names = Subject("class", entry.name), {"values": ", ".join(values[:3])}
        share = driven_m / float(length_m.sum())
        findings.append(make_finding(_BLOCKED, subject, names=names, driven_m=driven_m, driven_fraction=share))
    return findings
