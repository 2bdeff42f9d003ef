"""The split of sampled patches: regions in the map's plane, the holdout, the leakage audit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely
from numpy.typing import NDArray

from tcpipe.errors import DatasetError
from tcpipe.formats.dataset_card import Exclusion, KeptSplit, SplitResult
from tcpipe.formats.dataset_files import EXCLUDED_IDS, IS_EXCLUDED
from tcpipe.formats.geojson import regions_to_json
from tcpipe.formats.parquet import take_rows
from tcpipe.pipeline.dataset.options import ExcludedIds
from tcpipe.recipe import Recipe
from tcpipe.recipe.suggestions import format_recipe_key
from tcpipe.splits.assignment import EXCLUDED, NO_FOLD, SPLITS, Assignment, assign_splits, hash_ranks
from tcpipe.splits.audit import audit_leakage
from tcpipe.splits.regions import Regions, project_regions
from tcpipe.stages.sample import Sampled
from tcpipe.tables.columns import to_integers
from tcpipe.tables.findings import Finding, Subject, make_finding
from tcpipe.terrain.projection import Projection

_ROWS = 1 << 16
"""Rows whose ids are in memory together."""
_MARGIN_DEG = 0.05
"""Regions are cut this far around the samples (3 km or more below 60° latitude)."""


@dataclass(frozen=True, slots=True)
class ExcludedSamples:
    """Samples that lists exclude: which of N samples, the lists for the card, each id with list, reason and outcome, and findings."""

    mask: NDArray[np.bool_]
    lists: tuple[Exclusion, ...]
    ids: pa.Table
    findings: tuple[Finding, ...]


def find_excluded(
    lists: Sequence[ExcludedIds], segment_ids: pa.ChunkedArray, kept: NDArray[np.int64]
) -> ExcludedSamples:
    """Return which samples the lists exclude; ``kept`` are the rows of ``segment_ids`` that are samples, (N,)."""
    mask, findings = np.zeros(len(kept), np.bool_), list[Finding]()
    exclusions, tables = list[Exclusion](), [EXCLUDED_IDS.empty_table()]
    known = segment_ids.combine_chunks() if lists else None
    samples = np.full(len(segment_ids), -1)
    samples[kept] = np.arange(len(kept))
    for listed in lists:
        rows, count = pc.index_in(pa.array(listed.ids), value_set=known).fill_null(-1).to_numpy(), len(listed.ids)
        outcomes = np.select([rows < 0, samples[rows] < 0], ["no segment", "no sample"], IS_EXCLUDED)
        excluded = samples[rows[outcomes == IS_EXCLUDED]]
        new = int((~mask[excluded]).sum())
        exclusions.append(Exclusion(listed.name, listed.checksum, listed.reason, count, new))
        mask[excluded] = True
        texts = [[listed.name] * count, [listed.reason] * count, outcomes.tolist()]
        tables.append(pa.table([listed.ids, *texts], schema=EXCLUDED_IDS))
        if missing := int((rows < 0).sum()):
            names, subject = {"example": listed.ids[int(np.argmin(rows))]}, Subject("file", listed.name)
            findings.append(
                make_finding("exclusion-unmatched", subject, names=names, unmatched_count=missing, listed_count=count)
            )
    return ExcludedSamples(mask, tuple(exclusions), pa.concat_tables(tables), tuple(findings))


def draw_splits(
    segments: pa.Table,
    sampled: Sampled,
    projection: Projection | None,
    regions: Regions | None,
    recipe: Recipe,
    *,
    excluded: NDArray[np.bool_],
    earlier: pa.Table | None = None,
    tags: Mapping[str, str] | None = None,
) -> tuple[Assignment, SplitResult]:
    """Assign every patch of ``sampled`` to a split by its whole footprint, and audit the result.

    ``excluded`` samples, (N,), take part in the draw, so that all others have the split and fold that they would have without exclusion.
    ``projection`` leads from WGS 84 to the plane of the footprints; None: runs are in local frames, which no region can name.
    ``regions`` are in WGS84 lon/lat; None: everything is train and test. ``earlier`` has ``sample_id``, ``split`` and ``fold`` of a dataset
    whose samples keep their split; ``tags`` the holdout's tag by run. `DatasetError` if no footprint lies inside the region.
    """
    rules, chord_m = recipe.split, recipe.segment.chord_m
    buffer_m = math.sqrt(2.0) * chord_m if rules.buffer_m is None else rules.buffer_m
    starts_ns = to_integers(segments, "start_ns")
    if regions is not None and projection is None:
        raise DatasetError("the region (--split) needs positions on Earth, but the runs have no GNSS; remove --split")
    run, run_names = number_runs(segments)
    run, starts_ns = run[sampled.kept], starts_ns[sampled.kept]
    ids, rows = segments.select(["segment_id"]), sampled.kept
    kept = None if earlier is None else _read_earlier_assignment(take_rows(ids, rows).column(0), earlier)
    ranks = np.empty(len(rows), np.uint64)
    for first in range(0, len(rows), _ROWS):
        names = take_rows(ids, rows[first : first + _ROWS]).column(0).to_pylist()
        ranks[first : first + _ROWS] = hash_ranks(names, seed=rules.seed, purpose="test")
    assigned = assign_splits(
        ranks,
        run,
        run_names,
        sampled.footprint_xy_m,
        None
        if regions is None or projection is None
        else _project_regions(regions, projection, sampled.footprint_lonlat_deg),
        holdout=rules.holdout,
        test_fraction=rules.test_fraction,
        block_m=rules.block_m,
        buffer_m=buffer_m,
        folds=rules.folds,
        seed=rules.seed,
        kept=kept,
        tagged=None if tags is None else _number_values(run, [tags[name] for name in run_names]),
    )
    del ranks
    if regions is not None and not assigned.is_in("train", "test").any():
        raise DatasetError(_describe_nothing_inside(regions, sampled.footprint_lonlat_deg, assigned))
    assigned = assigned.exclude(excluded)
    if excluded.any() and not assigned.is_in(*SPLITS).any():
        raise DatasetError(f"the lists of excluded samples (--exclude) name all {len(rows)} samples; shorten them")
    held = {name: assigned.is_in(name) for name in ("test", "unseen")}
    audit = audit_leakage(assigned.is_in("train"), held, run, starts_ns, sampled.footprint_xy_m, chord_m=chord_m)
    counts = None
    if kept is not None and earlier is not None:
        found = int((~kept.is_in("")).sum())
        counts = KeptSplit(found, earlier.num_rows - found)
    region = None if regions is None else regions_to_json(regions)
    return assigned, SplitResult(buffer_m, region, audit, counts)


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


def _number_values(run: NDArray[np.int32], values: list[str]) -> tuple[NDArray[np.int32], list[str]]:
    """Return the number of each sample's value, (N,), and the values by number; run i has ``values[i]``."""
    names = list(dict.fromkeys(values))
    return np.array([names.index(value) for value in values], np.int32)[run], names


def _read_earlier_assignment(ids: pa.ChunkedArray, earlier: pa.Table) -> Assignment:
    """Return each sample's split and fold in an earlier dataset."""
    at = pc.index_in(ids, value_set=earlier.column("sample_id").combine_chunks())
    row = at.to_numpy(zero_copy_only=False)  # NaN where it is not there
    known = np.isfinite(row)
    split, fold = np.full(len(row), "", dtype="<U8"), np.full(len(row), NO_FOLD)
    rows = row[known].astype(np.int64)
    split[known] = earlier.column("split").to_numpy().astype(np.str_)[rows]
    fold[known] = earlier.column("fold").fill_null(NO_FOLD).to_numpy()[rows]
    return Assignment.from_names(split, fold)


def _project_regions(regions: Regions, projection: Projection, footprint_lonlat_deg: NDArray[np.float64]) -> Regions:
    west, south = (footprint_lonlat_deg.min(axis=(0, 1)) - _MARGIN_DEG).tolist()
    east, north = (footprint_lonlat_deg.max(axis=(0, 1)) + _MARGIN_DEG).tolist()
    return project_regions(regions, projection.forward, window_deg=(west, south, east, north))


def _describe_nothing_inside(regions: Regions, lonlat_deg: NDArray[np.float64], assigned: Assignment) -> str:
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
