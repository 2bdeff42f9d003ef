"""LabelledSegments to patches: cut-outs of the map under each segment, and reasons for missing patches."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.arrays import AnyInts, Bytes, Floats, Ints
from tcpipe.errors import MapError
from tcpipe.recipe import SampleConfig
from tcpipe.recipe.suggestions import suggest
from tcpipe.tables.bits import Loss
from tcpipe.tables.columns import read_ends_deg, read_ends_m, to_floats
from tcpipe.tables.findings import Findings, Subject, make_finding
from tcpipe.tables.levels import PLACED_SEGMENTS
from tcpipe.terrain.projection import Projection
from tcpipe.terrain.sampling import (
    Patches,
    check_scale,
    compute_footprints,
    count_corners_on,
    has_other_pixels,
    join_patches,
    make_patch_frames,
    sample_patches,
)
from tcpipe.terrain.tiles import MapReader, TilePool, choose_level, find_map_projection

Shifts = Mapping[str, tuple[float, float, float]]
"""By run: shift of its positions on a map, x and y, and its DRMS [m]."""

_LOSSES = (Loss.POSITION_UNCERTAIN, Loss.OUTSIDE_MAP, Loss.NODATA, Loss.NOT_TRAVERSABLE)


@dataclass(frozen=True, slots=True)
class Sampled:
    """L6 before the split: N patches of M segments, from one map or several.

    ``kept``: rows of the segments with a patch, (N,), rising on each map; all other N are in that order. ``map_index``:
    the map of each. Footprints are counter-clockwise from rear right, (N, 4, 2): in the first map's CRS [m], and as WGS
    84 lon, lat [deg]. ``position_std_m``: their DRMS, (N,), with that of the run's shift. ``lost_by``: each segment's
    `Loss`, 0 if kept, (M,). If pixels are stored in files, those of ``patches`` are empty.
    """

    kept: Ints
    map_index: Bytes
    patches: Patches
    position_std_m: Floats
    footprint_xy_m: Floats
    footprint_lonlat_deg: Floats
    lost_by: NDArray[np.uint32]
    findings: Findings


def sample_segments(
    segments: pa.Table,
    source: MapReader,
    config: SampleConfig,
    *,
    gnss_crs: str,
    pool: TilePool | None = None,
    shifts: Shifts | None = None,
) -> Sampled:
    """Return the patches of all segments that are on the map.

    Raises `TableError`: chords and positions contradict each other; `MapError`: no transformation between CRSs, or a
    damaged tile.

    Parameters
    ----------
    segments : L5 of any runs, or `PLACED_SEGMENTS` of it; the first reason of loss counts, in the order: position
        uncertain, off the map, nodata, untraversable.
    source, pool : the map, and its tiles as `sample_patches` takes them.
    gnss_crs : geographic CRS of the segments' longitudes and latitudes.
    shifts : of runs on this map.
    """
    PLACED_SEGMENTS.check(segments, more=True)
    chord_m, projection = to_floats(segments, "chord_m"), find_map_projection(source, gnss_crs)
    shift_m = np.zeros((segments.num_rows, 3))
    if shifts:
        shift_m[:] = [shifts.get(run_id, (0.0, 0.0, 0.0)) for run_id in segments.column("run_id").to_pylist()]
    start, end = (projection.forward(ends_deg) + shift_m[:, :2] for ends_deg in read_ends_deg(segments))
    frames = make_patch_frames(start, end, chord_m)
    corners = compute_footprints(frames, config.patch_m)
    lost_by = np.zeros(segments.num_rows, np.uint32)
    lost_by[count_corners_on(source.grid, corners) < (4 if config.min_valid_fraction >= 1.0 else 1)] = Loss.OUTSIDE_MAP
    std_m = np.hypot(to_floats(segments, "position_std_m"), shift_m[:, 2])
    lost_by[std_m > config.max_position_std_m] = Loss.POSITION_UNCERTAIN
    rows = np.flatnonzero(lost_by == 0)
    frames = frames.rows(rows)
    check_scale(frames)
    patches = sample_patches(source, frames, chord_m[rows], patch_m=config.patch_m, patch_px=config.patch_px, pool=pool)
    lost_by[rows] = _find_losses(patches, corners[rows], source, config)
    good = lost_by[rows] == 0
    kept, patches = rows[good], patches if good.all() else patches.keep_valid(good)
    return Sampled(
        kept=kept,
        map_index=np.zeros(kept.size, np.uint8),
        patches=patches,
        position_std_m=std_m[kept],
        footprint_xy_m=corners[kept],
        footprint_lonlat_deg=find_map_projection(source, "EPSG:4326").inverse(corners[kept]),
        lost_by=lost_by,
        findings=_find_in_map(source, config, projection),
    )


def place_segments(segments: pa.Table, place: Projection | AnyInts, config: SampleConfig) -> Sampled:
    """Return the footprints of all segments, without patches.

    Parameters
    ----------
    segments : L5 of any runs.
    place : projection from the segments' longitudes and latitudes to the plane of the footprints; or, for runs in local
        frames, the number of each segment's run, shape (M,): they are placed side by side in that order
        (`separate_frames`).
    """
    count = segments.num_rows
    if isinstance(place, Projection):
        start, end = map(place.forward, read_ends_deg(segments))
    else:
        start, end = separate_frames(place, read_ends_m(segments))
    corners = compute_footprints(make_patch_frames(start, end, to_floats(segments, "chord_m")), config.patch_m)
    unknown, nothing = np.full(count, np.nan), np.zeros(count, np.uint8)
    numbers = (
        "height_min_m",
        "slope_rad",
        "cross_slope_rad",
        "valid_fraction",
        "height_clipped_fraction",
        "terrain_purity",
    )
    return Sampled(
        kept=np.arange(count),
        map_index=nothing,
        patches=Patches(
            {}, **dict.fromkeys(numbers, unknown), terrain_class=nothing, profile_m=np.full((count, 3), np.nan)
        ),
        position_std_m=to_floats(segments, "position_std_m"),
        footprint_xy_m=corners,
        footprint_lonlat_deg=place.inverse(corners)
        if isinstance(place, Projection)
        else np.full(corners.shape, np.nan),
        lost_by=np.zeros(count, np.uint32),
        findings=(),
    )


_FRAME_STEP_M = 100.0
"""Step by which local frames are moved [m]: split blocks of 1, 2, 5, 10, 20, 25 or 50 m stay whole."""


def separate_frames(frame: AnyInts, ends_xy_m: Sequence[Floats]) -> list[Floats]:
    """Return points of local frames in one plane [m], each shape (N, 2): later frames begin farther along x.

    ``frame`` is the number of each point's frame, shape (N,).
    """
    low, high = (np.full(int(frame.max(initial=-1)) + 1, sign * np.inf) for sign in (1.0, -1.0))
    for points in ends_xy_m:
        np.minimum.at(low, frame, points[:, 0])
        np.maximum.at(high, frame, points[:, 0])
    first, last = np.floor(low / _FRAME_STEP_M), np.floor(high / _FRAME_STEP_M)
    steps = np.cumsum(last - first + 2.0) - (last - first + 2.0) - first
    return [points + np.stack([_FRAME_STEP_M * steps[frame], np.zeros(len(frame))], axis=1) for points in ends_xy_m]


def _find_losses(patches: Patches, corners: Floats, source: MapReader, config: SampleConfig) -> NDArray[np.uint32]:
    lost = np.zeros(patches.valid_fraction.size, np.uint32)
    if "terrain" in patches.pixels:
        lost[~source.classes.traversable()[patches.terrain_class]] = Loss.NOT_TRAVERSABLE
        lost[patches.terrain_class == 0] = Loss.NODATA
    thin = patches.valid_fraction < max(config.min_valid_fraction, 1.0 / config.patch_px**2)
    lost[thin] = Loss.NODATA
    lost[thin & (count_corners_on(source.grid, corners) < 4)] = Loss.OUTSIDE_MAP
    return lost


def sum_losses(arc_length_m: Floats, lost_by: NDArray[np.uint32]) -> dict[Loss, float]:
    """Return lost metres by reason."""
    return {loss: float(arc_length_m[lost_by == loss].sum()) for loss in _LOSSES}


def _find_in_map(source: MapReader, config: SampleConfig, projection: Projection) -> Findings:
    """Return the findings on a map itself: its datum, and the size of its pixels."""
    subject, patch_pixel_m = Subject("map", source.name), config.patch_m / config.patch_px
    map_pixel_m = choose_level(source, patch_pixel_m).grid.pixel_size_m
    findings = projection.find_rough_shift(subject)
    if not has_other_pixels(patch_pixel_m, map_pixel_m):
        return findings
    remedies = suggest("match", {"sample": {"patch_px": round(config.patch_m / map_pixel_m)}})
    other = make_finding(
        "patch-pixels-unlike-map", subject, remedies=remedies, patch_pixel_m=patch_pixel_m, map_pixel_m=map_pixel_m
    )
    return (*findings, other)


_ELSEWHERE = (Loss.OUTSIDE_MAP, Loss.NODATA)
"""Losses that may not occur on the next map; untraversable ground and uncertain positions are final."""


def sample_on_maps(
    segments: pa.Table,
    sources: Sequence[MapReader],
    config: SampleConfig,
    *,
    gnss_crs: str,
    pools: Sequence[TilePool | None] | None = None,
    shifts: Sequence[Shifts] | None = None,
) -> Sampled:
    """Return the patches of all segments that are on one of the maps; where maps overlap, the first counts.

    Parameters as `sample_segments`; ``pools`` and ``shifts`` have one a map.

    Raises `TableError`, `MapError`: as `sample_segments`; maps with different layers or classes, or too far apart.
    """
    check_same_layers(sources)
    lost_by = np.full(segments.num_rows, Loss.OUTSIDE_MAP, np.uint32)
    waiting = np.arange(segments.num_rows)
    parts: list[Sampled] = []
    each = zip(sources, pools or [None] * len(sources), shifts or [{}] * len(sources), strict=True)
    for number, (source, pool, moved) in enumerate(each):
        here = segments if len(waiting) == segments.num_rows else segments.take(waiting)
        found = sample_segments(here, source, config, gnss_crs=gnss_crs, pool=pool, shifts=moved)
        known = found.lost_by != Loss.OUTSIDE_MAP  # missing data in one map has priority over being outside the next
        lost_by[waiting[known]] = found.lost_by[known]
        place = np.full(found.kept.size, number, np.uint8)
        placed = _project_to_first_map(found, source, sources[0])
        parts.append(replace(found, kept=waiting[found.kept], map_index=place, footprint_xy_m=placed))
        waiting = waiting[np.isin(found.lost_by, _ELSEWHERE)]
    names = ("kept", "map_index", "position_std_m", "footprint_xy_m", "footprint_lonlat_deg")
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    findings = tuple(dict.fromkeys(finding for part in parts for finding in part.findings))
    return Sampled(patches=join_patches([part.patches for part in parts]), lost_by=lost_by, findings=findings, **joined)


def _project_to_first_map(sampled: Sampled, source: MapReader, first: MapReader) -> Floats:
    """Return footprints in the CRS of the first map [m], in which splits are drawn and distances measured."""
    if source.grid.crs == first.grid.crs:
        return sampled.footprint_xy_m
    placed = find_map_projection(first, "EPSG:4326").forward(sampled.footprint_lonlat_deg)
    if not np.isfinite(placed).all():
        raise MapError(f"map {source.name}: is too far from map {first.name} for one dataset; build one from each")
    return placed


def check_same_layers(sources: Sequence[MapReader]) -> None:
    """Raise `MapError` if the maps' layers or classes differ: no model can learn from their patches together."""
    first, problems = sources[0], []
    layers, *others = (source.layers for source in sources)
    for other, theirs in zip(sources[1:], others, strict=True):
        if set(theirs) != set(layers):
            problems.append(
                f"map {other.name}: has {', '.join(theirs)}, but map {first.name} has {', '.join(layers)}; "
                "maps of one dataset have the same layers"
            )
            continue
        for name, layer in layers.items():
            its = theirs[name]
            if its.signature != layer.signature:
                what = f"{name} is {its.signature}, but {layer.signature}"
                problems.append(f"map {other.name}: {what} in map {first.name}")
            elif layer.classes is not None and its.classes is not None and its.classes != layer.classes:
                different = "; ".join(its.classes.differences(layer.classes))
                subject = "its classes" if name == "terrain" else f"its classes of {name}"
                problems.append(f"map {other.name}: {subject} differ from those of map {first.name}: {different}")
    if problems:
        raise MapError(*problems)
