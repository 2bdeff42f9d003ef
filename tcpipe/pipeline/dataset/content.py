"""Content of a dataset: usable segments of all runs, samples in order with their patches, and the distance breakdown.

Columns of the samples beyond their schema: the tags of their runs, and covariates joined by time.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pyproj import CRS

from tcpipe.arrays import Floats, Ints, Texts
from tcpipe.errors import DatasetError
from tcpipe.formats.dataset_card import (
    LOCAL,
    Covariate,
    MapRegistration,
    RunSource,
    Shard,
    SplitResult,
    group_dataset_findings,
    list_shifts,
)
from tcpipe.formats.dataset_files import FileFormat, ParquetShardWriter, Pixels, make_parquet_writers, make_zarr_writers
from tcpipe.formats.finding_lines import format_finding, format_groups
from tcpipe.formats.maps.map_files import MapFile, open_map
from tcpipe.formats.parquet import ROWS_PER_GROUP, add_geo_metadata, move_to_file, take_rows
from tcpipe.formats.place import Place
from tcpipe.formats.recipe_toml import load_profiles
from tcpipe.formats.zarr_arrays import Compression
from tcpipe.pipeline.dataset.inputs import ChosenInputs
from tcpipe.pipeline.dataset.map_checks import find_contradictions, find_driven_obstacles, register_runs
from tcpipe.pipeline.dataset.options import BuildOptions
from tcpipe.pipeline.dataset.runs import list_needs, move_losses, pool_segments
from tcpipe.pipeline.dataset.sampling import Spool, sample_all_segments
from tcpipe.pipeline.dataset.splitting import draw_splits, number_runs
from tcpipe.progress import logger
from tcpipe.recipe import CovariateConfig, Recipe, SplitConfig
from tcpipe.recipe.suggestions import format_recipe_key, suggest
from tcpipe.robots import Robot
from tcpipe.splits.assignment import EXCLUDED, NO_FOLD, Assignment, hash_ranks
from tcpipe.stages.sample import Sampled, place_segments, sum_losses
from tcpipe.tables.bits import Loss, flag_name
from tcpipe.tables.columns import make_points, read_lonlat_deg, to_floats, to_integers
from tcpipe.tables.findings import Finding, Findings, Subject, make_finding
from tcpipe.tables.levels import SAMPLES
from tcpipe.terrain.layers import PAPER_CLASSES
from tcpipe.terrain.projection import Projection, compute_area, find_utm_crs, format_crs, parse_crs
from tcpipe.terrain.tiles import find_map_projection


@dataclass(frozen=True, slots=True)
class SampleTable:
    """The samples in the dataset's order, made piece by piece: their segments are mapped from a file, not in memory.

    Row i is patch ``patch[i]`` of ``sampled``, whose pixels are in ``slot`` of the spool; ``assigned`` is in the
    patches' order.
    """

    segments: pa.Table
    sampled: Sampled
    slot: Ints
    has_terrain: bool
    assigned: Assignment
    map_names: tuple[str, ...]
    class_names: Texts
    patch: Ints
    flags: NDArray[np.uint32]
    """Quality bits of each patch of ``sampled`` beyond those of its segment."""
    added: pa.Table
    """Columns beyond SAMPLES, in the segments' order."""
    convert: Callable[[pa.Table], pa.Table] | None = None
    """Makes rows with coordinates those of a dataset without; None if the dataset has them."""

    @property
    def schema(self) -> pa.Schema:
        """The samples' columns, with the extent of their coordinates."""
        bare = pa.schema([*SAMPLES.arrow(), *self.added.schema]).empty_table()
        if self.convert is not None:
            return self.convert(bare).schema
        pieces = (
            self._centres_deg(self.patch[first : first + ROWS_PER_GROUP])
            for first in range(0, len(self), ROWS_PER_GROUP)
        )
        corners = [corner for piece in pieces for corner in (piece.min(axis=0), piece.max(axis=0))]
        return add_geo_metadata(bare, "Point", np.array(corners).reshape(-1, 2)).schema

    def _centres_deg(self, patches: Ints) -> Floats:
        """Return the centre of patches of ``sampled``, WGS 84 lon, lat [deg], shape (N, 2)."""
        corners = np.unwrap(self.sampled.footprint_lonlat_deg[patches], axis=1, period=360.0)  # on the date line
        return np.asarray(corners.mean(axis=1))

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.patch)

    def take(self, rows: Ints) -> pa.Table:
        """Return rows of the samples table as the dataset has them."""
        table = self._make_rows(rows)
        return table if self.convert is None else self.convert(table)

    def _make_rows(self, rows: Ints) -> pa.Table:
        """Return rows of the samples table with coordinates (schema SAMPLES, and the added columns behind it)."""
        at = self.patch[rows]
        assigned = self.assigned.select(at)
        rows_of_segments = self.sampled.kept[at]
        segments = take_rows(self.segments, rows_of_segments)
        columns: dict[str, Any] = {
            name: segments.column(name) for name in SAMPLES.names() if name in segments.column_names
        }
        shown = {*SAMPLES.names()}
        columns |= {name: values[at] for name, values in self.sampled.patches.columns().items() if name in shown}
        columns["quality"] = segments.column("quality").to_numpy() | self.flags[at]
        columns["position_std_m"] = self.sampled.position_std_m[at]
        columns["geometry"] = make_points(centres := self._centres_deg(at))
        columns["terrain_name"] = self.class_names[columns["terrain_class"]].tolist()
        if not self.has_terrain:
            of_terrain = (column for column in SAMPLES.columns if column.name.startswith("terrain"))
            columns |= {column.name: pa.nulls(len(at), column.dtype) for column in of_terrain}
        table = SAMPLES.table(
            sample_id=segments.column("segment_id"),
            split=assigned.split.tolist(),
            fold=pa.array(assigned.fold, pa.int8(), mask=assigned.fold == NO_FOLD),
            map=[self.map_names[index] for index in self.sampled.map_index[at]]
            if self.map_names
            else pa.nulls(len(at)),
            **columns,
        )
        added = take_rows(self.added, rows_of_segments)
        for field in added.schema:
            table = table.append_column(field, added.column(field.name))
        return add_geo_metadata(table, "Point", centres)

    def pieces(self) -> Iterator[pa.Table]:
        """Yield the table in pieces of `ROWS_PER_GROUP`; at least one, which may be empty."""
        for first in range(0, max(len(self), 1), ROWS_PER_GROUP):
            yield self.take(np.arange(first, min(first + ROWS_PER_GROUP, len(self))))

    def centres_xy_m(self) -> Floats:
        """Return the centre of every footprint in the first map's plane [m], shape (N, 2)."""
        centres = np.empty((len(self), 2))
        for first in range(0, len(self), ROWS_PER_GROUP):
            corners = self.sampled.footprint_xy_m[self.patch[first : first + ROWS_PER_GROUP]]
            centres[first : first + ROWS_PER_GROUP] = corners.mean(axis=1)
        return centres


@dataclass(frozen=True, slots=True)
class Content:
    """Samples in the dataset's order, their pixels and layers, and the distance breakdown."""

    samples: SampleTable
    spool: Spool
    sources: tuple[MapFile, ...]
    plane: str
    """CRS of the footprints, or `LOCAL`."""
    split: SplitResult
    distance_by_reason_m: Mapping[str, float]
    registrations: Sequence[tuple[MapRegistration, ...]]
    """By map, one for each run."""
    covariates: tuple[Covariate, ...]
    findings: Findings


def gather_content(directory: Path, inputs: ChosenInputs, options: BuildOptions, jobs: int) -> Content:
    """Sample, split and order; segments and pixels are kept in files in ``directory``, which must be empty.

    Raises `DatasetError`, `MapError`: no segment, none on the map, or none inside the region.
    """
    recipe = options.recipe
    needs = list_needs(inputs.runs, options.labels, has_patches=bool(inputs.map_records))
    segments, distance_by_reason_m, unusable = pool_segments(inputs.runs, directory, needs, again=inputs.again)
    logger.info("sampling %d segments of %d runs", segments.num_rows, len(inputs.runs))
    ranks = _rank_segments(segments, seed=recipe.split.seed)
    sources = tuple(open_map(*arguments) for arguments in inputs.maps())
    registered = [register_runs(inputs.runs, source, recipe) for source in sources]
    shifts = [list_shifts(registrations) for registrations, _ in registered]
    projection = _choose_plane(segments, sources)
    if sources:
        sampled, slot, spool = sample_all_segments(
            segments,
            ranks,
            inputs.maps,
            recipe.sample,
            gnss_crs=recipe.read.gnss_crs,
            shifts=shifts,
            jobs=jobs,
            directory=directory,
        )
    else:
        place = (
            number_runs(segments)[0]
            if projection is None
            else replace(projection, source=parse_crs(recipe.read.gnss_crs, where="gnss_crs"))
        )
        sampled = place_segments(segments, place, recipe.sample)
        slot, spool = np.zeros(segments.num_rows, np.int64), Spool(directory, {}, recipe.sample.patch_px)
    lost_m = sum_losses(to_floats(segments, "arc_length_m"), sampled.lost_by) if sources else {}
    if len(sampled.kept) == 0:
        raise DatasetError(
            _describe_nothing_sampled(segments, lost_m, sources),
            *map(format_finding, find_driven_obstacles(segments, sources, recipe, shifts=shifts)),
            *_describe_uncertainty(segments, lost_m, inputs, recipe),
        )
    tags = read_tags(pc.unique(segments.column("run_id")).to_pylist(), inputs.sources, recipe.split)
    assigned, result = draw_splits(segments, sampled, projection, options.regions, recipe, tags=tags)
    unused = {Loss.SPLIT_BUFFER: assigned.is_in("buffer"), Loss.SPLIT_EXCLUDED: assigned.is_in(EXCLUDED)}
    arc_m = to_floats(segments, "arc_length_m")[sampled.kept]
    unused_m = {loss: arc_m[rows].sum() for loss, rows in unused.items()}
    shifted = [finding for _, findings in registered for finding in findings]
    flags, contradictions = np.zeros(len(sampled.kept), np.uint32), list[Finding]()
    if sources:
        flags, contradictions = find_contradictions(inputs.runs, segments, sampled, inputs.map_names, recipe.sample)
    obstacles = find_driven_obstacles(segments, sources, recipe, shifts=shifts)
    kept = np.flatnonzero(~assigned.is_in(EXCLUDED))
    order = move_to_file(kept[np.argsort(ranks[sampled.kept[kept]], kind="stable")], directory)
    added, covariates, incomplete = make_added_columns(
        segments, sampled.kept[order], inputs.sources, options.covariates, recipe.covariates, layers=tuple(spool.layers)
    )
    robots = [run.robot for run in inputs.sources]
    narrow = find_narrow_patches(robots, load_profiles(recipe).robots, patch_m=recipe.sample.patch_m) if sources else []
    class_names = (sources[0].classes if sources else PAPER_CLASSES).names()
    has_terrain = "terrain" in spool.layers
    if projection is None:
        incomplete = [*incomplete, make_finding("local-frames", Subject("dataset", recipe.dataset.name))]
    more = inputs.map_names, class_names, order, flags, added
    found = (*inputs.findings, *unusable, *shifted, *sampled.findings, *contradictions)
    return Content(
        samples=SampleTable(segments, sampled, slot, has_terrain, assigned, *more),
        spool=spool,
        sources=sources,
        plane=LOCAL if projection is None else format_crs(projection.target),
        split=result,
        distance_by_reason_m=move_losses(distance_by_reason_m, {**lost_m, **unused_m}),
        registrations=[registrations for registrations, _ in registered],
        covariates=covariates,
        findings=(*found, *narrow, *obstacles, *incomplete),
    )


def _choose_plane(segments: pa.Table, sources: Sequence[MapFile]) -> Projection | None:
    """Return the projection from WGS 84 to the footprints' plane: the first map's, or the first segment's UTM zone.

    None: the runs have no positions on Earth.
    """
    if sources:
        return find_map_projection(sources[0], "EPSG:4326")
    lonlat_deg = read_lonlat_deg(segments, "start")
    if not np.isfinite(lonlat_deg).all():
        return None
    wgs84 = CRS.from_epsg(4326)
    area_deg = (*lonlat_deg.min(axis=0).tolist(), *lonlat_deg.max(axis=0).tolist())
    return Projection(wgs84, find_utm_crs(wgs84, tuple(lonlat_deg[0].tolist())), area_deg)


def _rank_segments(segments: pa.Table, *, seed: int) -> NDArray[np.uint64]:
    """Return the rank of every segment in the dataset's order, (M,); `DatasetError` where an id occurs twice."""
    column = segments.column("segment_id")
    ranks = np.concatenate([hash_ranks(chunk.to_pylist(), seed=seed, purpose="order") for chunk in column.chunks])
    rising = np.sort(ranks)
    equal = rising[1:][np.diff(rising) == 0]
    if len(equal):  # with 64 bits, equal ranks mean equal names
        name = column[int(np.flatnonzero(ranks == equal[0])[0])].as_py()
        times = int((ranks == equal[0]).sum())
        raise DatasetError(f"segment {name} is in the store {times} times; ingest its run again with --force")
    return ranks


def _describe_nothing_sampled(segments: pa.Table, lost_m: Mapping[Loss, float], sources: Sequence[MapFile]) -> str:
    """Return metres by reason, and the places of maps and runs."""
    lost = sorted(((metres, flag_name(loss)) for loss, metres in lost_m.items() if metres > 0.0), reverse=True)
    where = ", ".join(f"{metres:.0f} m {name.replace('_', ' ')}" for metres, name in lost)
    lon, lat = (float(np.mean(to_floats(segments, f"start_{axis}_deg"))) for axis in ("lon", "lat"))
    names = f"map{'s' if len(sources) > 1 else ''} {', '.join(source.name for source in sources)}"
    return (
        f"{names}: none of {segments.num_rows} segments gives a sample ({where}); the runs are around "
        f"{lon:.5f}, {lat:.5f} (lon, lat), {'; '.join(_describe_coverage(source, alone=len(sources) == 1) for source in sources)}"
    )


def _describe_uncertainty(
    segments: pa.Table, lost_m: Mapping[Loss, float], inputs: ChosenInputs, recipe: Recipe
) -> list[str]:
    """Return the positions' uncertainty and findings of ingest, where uncertain positions are the main loss."""
    uncertain_m = lost_m.get(Loss.POSITION_UNCERTAIN, 0.0)
    if uncertain_m == 0.0 or uncertain_m < max(lost_m.values()):
        return []
    known_m = float(np.median(to_floats(segments, "position_std_m")))
    line = (
        f"positions are known to {known_m:.2f} m (median standard deviation), expected {recipe.sample.max_position_std_m:g} m: solve "
        f"the problems below, or accept patches with such an offset ({format_recipe_key('sample.max_position_std_m')})"
    )
    groups = group_dataset_findings((), {run.run_id: run.findings for run in inputs.sources})
    return [line, *format_groups(groups)]


def _describe_coverage(source: MapFile, *, alone: bool) -> str:
    west, south, east, north = compute_area(parse_crs(source.grid.crs, where="map"), source.grid.bounds_m)
    return f"{'the map' if alone else f'map {source.name}'} covers {west:.5f} to {east:.5f}, {south:.5f} to {north:.5f}"


def write_patches(
    directory: Path,
    content: Content,
    sample_ids: pa.ChunkedArray,
    file_format: FileFormat,
    jobs: int,
    *,
    compression: Compression,
) -> list[Shard]:
    """Write the layers by shard; return the shards, if any. Without patches, Parquet shards have samples alone."""
    samples, spool = content.samples, content.spool
    if not spool.layers and file_format == "zarr":
        return []
    pixels = Pixels(spool.layers, spool.patch_px, samples.slot[samples.patch], spool.read)
    if file_format == "parquet":
        split = samples.assigned.select(samples.patch).split
        drawers = make_parquet_writers(Place(directory), pixels, samples.take, split)
    else:
        drawers = make_zarr_writers(directory, pixels, sample_ids, compression=compression, threads=jobs)
    for drawer in drawers:
        drawer.write()
    return [drawer.shard for drawer in drawers if isinstance(drawer, ParquetShardWriter)]


if TYPE_CHECKING:
    from tcpipe.formats.covariates import CovariateTable

TAG = "tag_"
"""Prefix of a tag's column."""

_NUMBER = re.compile(r"[+-]?(\d++\.?\d*+|\.\d++)([eE][+-]?\d{1,3})?")


def make_added_columns(
    segments: pa.Table,
    kept: Ints,
    runs: Sequence[RunSource],
    tables: Sequence[CovariateTable],
    config: CovariateConfig,
    *,
    layers: Sequence[str],
) -> tuple[pa.Table, tuple[Covariate, ...], list[Finding]]:
    """Return the added columns of all segments, M rows, the covariates for the card, and findings.

    A covariate is that of a segment's start; ``kept`` are the rows that are samples, (N,). `DatasetError` if a column
    has the name of another one or of one of ``layers``.
    """
    table, findings = _make_tag_columns(segments.column("run_id"), runs)
    covariates = list[Covariate]()
    for source in tables:
        joined, reached = source.join(to_integers(segments, "start_ns"), max_age_s=config.max_age_s)
        without = {name: int(joined.column(name).take(kept).null_count) for name in joined.column_names}
        covariate = Covariate(
            source.name, source.checksum, source.rows.height, source.time_column, *source.span, without
        )
        covariates.append(covariate)
        findings += (*source.findings, *_find_missing(covariate, int((~reached[kept]).sum()), len(kept)))
        for field in joined.schema:
            table = table.append_column(field, joined.column(field.name))
    names = [*SAMPLES.names(), *layers, *table.column_names]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise DatasetError(
            f"columns {', '.join(twice)} would occur twice; rename the file of covariates, or its columns"
        )
    return table, tuple(covariates), findings


def _find_missing(covariate: Covariate, unreached: int, samples: int) -> list[Finding]:
    """Return the finding that no row is near some samples, and one for each column with more missing values."""
    missing = {Subject("file", covariate.name): unreached}
    missing |= {Subject("column", name): count - unreached for name, count in covariate.samples_without.items()}
    return [
        make_finding("covariates-missing", subject, missing_count=count, sample_count=samples)
        for subject, count in missing.items()
        if count
    ]


def _make_tag_columns(run_ids: pa.ChunkedArray, runs: Sequence[RunSource]) -> tuple[pa.Table, list[Finding]]:
    """Return a column for each tag: numbers if all its values are, else text; null for runs without the tag."""
    tags = {run.run_id: run.tags or {} for run in runs}
    place = pc.index_in(run_ids, value_set=pa.array(list(tags), pa.string()))
    columns, fields, findings = list[pa.Array](), list[pa.Field](), list[Finding]()
    for key in sorted({key for run_tags in tags.values() for key in run_tags}):
        texts = [run_tags.get(key) for run_tags in tags.values()]
        different = {text for text in texts if text is not None}
        words = sorted(text for text in different if not _NUMBER.fullmatch(text.strip()))
        if words and len(words) < len(different):
            subject, names, count = Subject("tag", key), {"example": words[0]}, len(different)
            findings.append(
                make_finding("column-is-text", subject, names=names, odd_count=len(words), value_count=count)
            )
        numbers = None if words else [None if text is None else float(text) for text in texts]
        values = pa.array(texts, pa.string()) if numbers is None else pa.array(numbers, pa.float64())
        columns.append(values.take(place))
        fields.append(pa.field(f"{TAG}{key}", values.type, metadata={"unit": "", "doc": f"tag {key} of the run"}))
    if not fields:
        return pa.table({"run_id": run_ids}).select([]), findings
    return pa.table(columns, schema=pa.schema(fields)), findings


def read_tags(run_ids: Sequence[str], runs: Sequence[RunSource], rules: SplitConfig) -> dict[str, str] | None:
    """Return the value of the holdout's tag by run, None with other holdouts; `DatasetError` names runs without it."""
    if rules.holdout != "tag":
        return None
    key, tags = rules.holdout_tag, {run.run_id: (run.tags or {}).get(rules.holdout_tag) for run in runs}
    missing = [run_id for run_id in run_ids if tags[run_id] is None]
    if missing:
        raise DatasetError(
            f"holdout by tag {key}: {len(missing)} of {len(run_ids)} runs do not have it ({', '.join(missing[:3])}); "
            f"ingest their logs again with --tag {key}=VALUE"
        )
    return {run_id: str(tags[run_id]) for run_id in run_ids}


def find_narrow_patches(robots: Sequence[str], known: Mapping[str, Robot], *, patch_m: float) -> list[Finding]:
    """Return a finding for each robot that is wider than a patch, or of unknown width."""
    findings = []
    for robot in sorted(set(robots)):
        width_m = known[robot].width_m if robot in known else None
        subject = Subject("robot", robot)
        if width_m is None:
            findings.append(make_finding("robot-width-unknown", subject, patch_m=patch_m))
        elif width_m > patch_m:
            remedies = suggest("wider", {"sample": {"patch_m": width_m}})
            findings.append(
                make_finding("patch-narrower-than-robot", subject, remedies=remedies, width_m=width_m, patch_m=patch_m)
            )
    return findings
