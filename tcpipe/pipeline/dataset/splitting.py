"""The split of sampled patches: regions in the map's plane, the holdout, the leakage audit."""

import math
from collections.abc import Mapping

import numpy as np
import pyarrow as pa
import shapely
from numpy.typing import NDArray

from tcpipe.arrays import Floats
from tcpipe.errors import DatasetError
from tcpipe.formats.dataset_card import SplitResult
from tcpipe.formats.geojson import regions_to_json
from tcpipe.formats.parquet import take_rows
from tcpipe.recipe import Recipe
from tcpipe.recipe.suggestions import format_recipe_key
from tcpipe.splits.assignment import EXCLUDED, Assignment, assign_splits, hash_ranks
from tcpipe.splits.audit import audit_leakage
from tcpipe.splits.regions import Regions, project_regions
from tcpipe.stages.sample import Sampled
from tcpipe.tables.columns import to_integers
from tcpipe.terrain.projection import Projection

_ROWS = 1 << 16  # rows whose ids are in memory together
_MARGIN_DEG = 0.05  # regions are cut this far around the samples (3 km or more below 60° latitude)


def draw_splits(
    segments: pa.Table,
    sampled: Sampled,
    projection: Projection | None,
    regions: Regions | None,
    recipe: Recipe,
    *,
    tags: Mapping[str, str] | None = None,
) -> tuple[Assignment, SplitResult]:
    """Assign every patch of ``sampled`` to a split by its whole footprint, and audit the result.

    ``projection`` leads from WGS 84 to the plane of the footprints; None: runs are in local frames, which no region can
    name. ``regions`` are in WGS84 lon/lat; None: everything is train and test. ``tags`` have the holdout's tag by run.
    `DatasetError` if no footprint is inside the region.
    """
    rules, chord_m = recipe.split, recipe.segment.chord_m
    buffer_m = math.sqrt(2.0) * chord_m if rules.buffer_m is None else rules.buffer_m
    starts_ns = to_integers(segments, "start_ns")
    if regions is not None and projection is None:
        raise DatasetError("the region (--split) needs positions on Earth, but the runs have no GNSS; remove --split")
    run, run_names = number_runs(segments)
    run, starts_ns = run[sampled.kept], starts_ns[sampled.kept]
    ids, rows = segments.select(["segment_id"]), sampled.kept
    ranks = np.empty(len(rows), np.uint64)
    for first in range(0, len(rows), _ROWS):
        names = take_rows(ids, rows[first : first + _ROWS]).column(0).to_pylist()
        ranks[first : first + _ROWS] = hash_ranks(names, seed=rules.seed, purpose="test")
    planar, tagged = None, None
    if regions is not None and projection is not None:
        west, south = (sampled.footprint_lonlat_deg.min(axis=(0, 1)) - _MARGIN_DEG).tolist()
        east, north = (sampled.footprint_lonlat_deg.max(axis=(0, 1)) + _MARGIN_DEG).tolist()
        planar = project_regions(regions, projection.forward, window_deg=(west, south, east, north))
    if tags is not None:
        values = list(dict.fromkeys(tags[name] for name in run_names))
        tagged = np.array([values.index(tags[name]) for name in run_names], np.int32)[run], values
    assigned = assign_splits(
        ranks,
        run,
        run_names,
        sampled.footprint_xy_m,
        planar,
        holdout=rules.holdout,
        test_fraction=rules.test_fraction,
        block_m=rules.block_m,
        buffer_m=buffer_m,
        folds=rules.folds,
        seed=rules.seed,
        tagged=tagged,
    )
    del ranks
    if regions is not None and not assigned.is_in("train", "test").any():
        raise DatasetError(_describe_nothing_inside(regions, sampled.footprint_lonlat_deg, assigned))
    held = {name: assigned.is_in(name) for name in ("test", "unseen")}
    audit = audit_leakage(assigned.is_in("train"), held, run, starts_ns, sampled.footprint_xy_m, chord_m=chord_m)
    region = None if regions is None else regions_to_json(regions)
    return assigned, SplitResult(buffer_m, region, audit)


def number_runs(segments: pa.Table) -> tuple[NDArray[np.int32], list[str]]:
    """Return the number of each segment's run in the order of recording, (M,), and the runs' ids by number."""
    starts_ns = to_integers(segments, "start_ns")
    coded = segments.column("run_id").dictionary_encode().unify_dictionaries()
    names = coded.chunk(0).dictionary.to_pylist()
    codes = np.concatenate([chunk.indices.to_numpy() for chunk in coded.chunks])
    first_ns = np.full(len(names), np.iinfo(np.int64).max)
    np.minimum.at(first_ns, codes, starts_ns)
    order = sorted(range(len(names)), key=lambda code: (first_ns[code], names[code]))
    number = np.empty(len(names), np.int32)
    number[order] = np.arange(len(names))
    return number[codes], [names[code] for code in order]


def _describe_nothing_inside(regions: Regions, lonlat_deg: Floats, assigned: Assignment) -> str:
    """Return why no sample is inside the region, and what to change."""
    points = shapely.multipoints(lonlat_deg.mean(axis=1))
    lon, lat = lonlat_deg.mean(axis=(0, 1))
    near, excluded = (int(assigned.is_in(name).sum()) for name in ("buffer", EXCLUDED))
    count = len(assigned.code)
    if excluded:
        return (
            f"the region (--split) leaves no training sample: {excluded} of {count} samples are in its exclude polygons, "
            f"{near} on a border or nearer to one than the buffer; redraw them"
        )
    if near:
        return (
            f"the region (--split) contains no whole footprint: {near} of {count} samples are on its border or nearer "
            f"to it than the buffer; draw it larger, or lower the {format_recipe_key('split.buffer_m')}"
        )
    swapped = shapely.transform(regions.train_test, lambda lonlat: lonlat[:, ::-1])
    if shapely.intersects(swapped, points):
        return (
            f"the region (--split) covers none of the {count} samples, but would with its axes swapped: "
            "GeoJSON is lon before lat (RFC 7946)"
        )
    km_per_deg = 111.3 * np.array([math.cos(math.radians(lat)), 1.0])
    apart_km = shapely.distance(
        *(shapely.transform(each, lambda p: p * km_per_deg) for each in (regions.train_test, points))
    )
    return (
        f"the region (--split) covers none of the {count} samples: they are around {lon:.5f}, {lat:.5f} (lon, lat), "
        f"about {apart_km:.2g} km from it; draw it over the runs"
    )
