"""Redacted datasets: no names of logs, topics, paths, hosts or users; all places are moved by one offset, which is not stored."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyproj import Transformer

from tcpipe.errors import DatasetError
from tcpipe.formats.dataset_card import DatasetCard, MapSource, Redacted, judge_dataset
from tcpipe.formats.geojson import PolygonGeometry
from tcpipe.pipeline.dataset.content import Content, SampleTable
from tcpipe.pipeline.dataset.inputs import Inputs
from tcpipe.recipe import Recipe
from tcpipe.tables.columns import read_lonlat_deg, to_floats
from tcpipe.tables.facts import HeldOut
from tcpipe.tables.findings import Finding, Subject, read_catalogue

PLANE = "+proj=tmerc +lat_0=0 +lon_0=0 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +type=crs"
"""Plane of a redacted dataset: that of its maps, moved to 0° N 0° E with grid north up."""

REACH_DEG = 5.0
"""Greatest distance of a redacted dataset from there."""

_PLACE_M, _PLACE_DIGITS_DEG = 0.01, 7
"""Places are rounded to a centimetre: finer, their distances would reveal the scale of the maps' plane."""

_REDACTED_WITHIN_M = 0.1
"""Greatest distance of x and y from lon and lat."""

_SCALE_VARIES = 2e-5
"""Variation of the scale with height and place."""

_MOST_SCALE = 0.005
"""Greatest deviation of the scale of the maps' plane from 1: beyond, the maps' own pixels would reveal it."""

_ENDS, _AXES = ("start", "end"), ("lon", "lat")
_KEPT_SUBJECTS = ("role", "class", "layer", "slope", "split")
"""Kinds of subjects whose names a redacted dataset has anyway."""

_KEPT_SECTIONS = ("fuse", "mask", "segment", "label", "sample", "split", "covariates", "dataset")
"""Sections of the recipe that name no topics, files or robots."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Redaction:
    """Public names and places of runs and maps."""

    gnss_crs: str
    map_crs: str
    origin_xy_m: tuple[float, float]
    """Place in the maps' plane that becomes 0, 0."""
    scale: float
    """Metres of the maps' plane to a metre of ``chord_m``."""
    height_m: float
    """Subtracted from heights of the maps."""
    runs: Mapping[str, str]
    maps: Mapping[str, str]

    def in_plane(self, lonlat_deg: Floats) -> Floats:
        """Return places (lon, lat) [deg], shape (..., 2), from the new origin along the maps' grid, in metres of ground."""
        return (_project_to_map(lonlat_deg, self.gnss_crs, self.map_crs) - self.origin_xy_m) / self.scale

    def placed(self, lonlat_deg: Floats) -> Floats:
        """Return the public lon, lat [deg] of places (lon, lat) [deg], shape (..., 2)."""
        return _move_to_origin(self.in_plane(lonlat_deg))

    def table(self, samples: pa.Table) -> pa.Table:
        """Return samples with public places and names; courses and x, y are along the maps' grid.

        In a run's own frame x is towards the east: against the grid that would reveal the meridian's convergence, and so the latitude.
        """
        ends = {end: self.in_plane(read_lonlat_deg(samples, end)) for end in _ENDS}
        columns: dict[str, Any] = {
            f"{end}_{axis}_deg": _move_to_origin(xy_m)[:, at]
            for end, xy_m in ends.items()
            for at, axis in enumerate(_AXES)
        }
        columns |= {
            f"{end}_{axis}_m": (xy_m[:, at] / _PLACE_M).round() * _PLACE_M
            for end, xy_m in ends.items()
            for at, axis in enumerate("xy")
        }
        columns["course_rad"] = np.arctan2(*(ends["end"] - ends["start"]).T[::-1])
        columns["height_min_m"] = to_floats(samples, "height_min_m") - self.height_m
        runs = samples.column("run_id").to_pylist()
        columns["run_id"] = [self.runs[run_id] for run_id in runs]
        columns["map"] = [self.maps[name] for name in samples.column("map").to_pylist()]
        for name in ("sample_id", "segment_id"):
            pairs = zip(samples.column(name).to_pylist(), runs, strict=True)
            columns[name] = [self.runs[run_id] + segment[len(run_id) :] for segment, run_id in pairs]
        for name, values in columns.items():
            field = samples.schema.field(name)
            samples = samples.set_column(samples.schema.get_field_index(name), field, pa.array(values, field.type))
        return samples


@cache
def _make_transformer(source: str, target: str) -> Transformer:
    return Transformer.from_crs(source, target, always_xy=True)


def _project_to_map(lonlat_deg: Floats, gnss_crs: str, map_crs: str) -> Floats:
    to_map = _make_transformer(gnss_crs, map_crs)
    return np.stack(to_map.transform(lonlat_deg[..., 0], lonlat_deg[..., 1]), axis=-1)


def _estimate_scale(samples: SampleTable, gnss_crs: str, map_crs: str) -> float:
    """Return the length of a metre of chords in the maps' plane, by least squares over all samples.

    `DatasetError` if it is so far from 1 that the extent of the maps in pixels would reveal it.
    """
    plane_chord = chord_chord = 0.0
    for piece in samples.pieces():
        start, end = (_project_to_map(read_lonlat_deg(piece, end), gnss_crs, map_crs) for end in _ENDS)
        chord_m = to_floats(piece, "chord_m")
        plane_chord += float(np.hypot(*(end - start).T) @ chord_m)
        chord_chord += float(chord_m @ chord_m)
    scale = plane_chord / chord_chord if chord_chord else 1.0
    if abs(scale - 1.0) > _MOST_SCALE:
        raise DatasetError(
            f"a metre of ground is {scale:.4f} m in the maps' CRS, which would reveal the latitude; add the maps in a CRS whose metres are "
            "those of the ground, such as UTM (rio warp in.tif out.tif --dst-crs EPSG:n), and build the redacted dataset with them"
        )
    return scale


def _move_to_origin(xy_m: Floats) -> Floats:
    """Return (lon, lat) [deg] of places in the plane at 0 N 0 E, shape (..., 2)."""
    lonlat = _make_transformer(PLANE, "EPSG:4326").transform(xy_m[..., 0], xy_m[..., 1])
    return np.stack(lonlat, axis=-1).round(_PLACE_DIGITS_DEG)


def make_redaction(content: Content, inputs: Inputs, recipe: Recipe) -> Redaction:
    """Return the redaction of a dataset; `DatasetError` if its maps have different CRS."""
    planes = {source.grid.crs for source in content.sources}
    if len(planes) > 1:
        raise DatasetError(
            f"maps in {len(planes)} CRS cannot be redacted together; build with those of one CRS (--map)"
        )
    heights_m = content.samples.sampled.patches.columns()["height_min_m"]
    gnss_crs, map_crs = recipe.read.gnss_crs, content.sources[0].grid.crs
    return Redaction(
        gnss_crs=gnss_crs,
        map_crs=map_crs,
        scale=_estimate_scale(content.samples, gnss_crs, map_crs),
        origin_xy_m=tuple(content.samples.centres_xy_m().mean(axis=0).tolist()),
        height_m=float(math.floor(np.min(heights_m))),
        runs={run.run_id: f"run{number:04}-{run.sha256[:8]}" for number, run in enumerate(inputs.sources, 1)},
        maps={name: f"map{number}" for number, name in enumerate(inputs.map_names, 1)},
    )


def redact_content(content: Content, redaction: Redaction) -> Content:
    """Return content whose samples have public names and places."""
    sampled = content.samples.sampled
    footprints = replace(redaction, gnss_crs="EPSG:4326").placed(sampled.footprint_lonlat_deg)
    added = content.samples.added  # descriptions of its columns name files
    bare = pa.schema([field.with_metadata({"unit": "", "doc": ""}) for field in added.schema])
    sampled = replace(sampled, footprint_lonlat_deg=footprints)
    samples = replace(content.samples, sampled=sampled, added=added.cast(bare), redact=redaction.table)
    return replace(content, samples=samples, registrations=[() for _ in content.registrations])


def redact_inputs(inputs: Inputs, redaction: Redaction) -> Inputs:
    """Return inputs whose runs have public names, without names of logs."""
    runs = tuple(replace(run, run_id=redaction.runs[run.run_id], logs=(), tags=None) for run in inputs.sources)
    named = {redaction.runs[name]: replace(run, logs=(), tags={}) for name, run in inputs.made_from.runs.items()}
    return replace(inputs, sources=runs, made_from=replace(inputs.made_from, runs=named))


def redact_findings(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings with the fields that the catalogue calls public."""
    return tuple(map(_redact_finding, findings))


def _redact_finding(finding: Finding) -> Finding:
    entry, subject = read_catalogue().get(finding.code), finding.subject
    public = entry.public if entry else ()
    return Finding(
        finding.code,
        finding.severity,
        subject if subject.kind in _KEPT_SUBJECTS else Subject(subject.kind, subject.kind),
        finding.action,
        numbers={name: number for name, number in finding.numbers.items() if name in public},
        names={name: text for name, text in finding.names.items() if name in public},
    )


def redact_card(card: DatasetCard, redaction: Redaction) -> DatasetCard:
    """Return a card, made from redacted inputs and samples, without other names and places."""
    region = card.split.region
    moved = None if region is None else {kind: _move_polygon(polygon, redaction) for kind, polygon in region.items()}
    bare = replace(Recipe(), **{name: getattr(card.recipe, name) for name in _KEPT_SECTIONS})
    findings, maps = redact_findings(card.findings), tuple(_redact_map(source, redaction) for source in card.maps)
    runs = tuple(replace(run, findings=redact_findings(run.findings)) for run in card.runs)
    return replace(
        card,
        made_from=replace(
            card.made_from, recipe=bare, tags={}, maps={}, map_names=(), region=None, covariates={}, exclusions={}
        ),
        split=replace(
            card.split,
            region=moved,
            audit=tuple(_convert_distances(part, redaction.scale) for part in card.split.audit),
        ),
        label=replace(card.label, includes=()),
        runs=runs,
        maps=maps,
        findings=findings,
        verdict=judge_dataset(findings, runs, maps),
        covariates=tuple(replace(covariate, name=f"covariates{n}") for n, covariate in enumerate(card.covariates, 1)),
        exclusions=tuple(
            replace(exclusion, name=f"excluded{n}", reason="") for n, exclusion in enumerate(card.exclusions, 1)
        ),
        redaction=Redacted(),
    )


def _convert_distances(held: HeldOut, scale: float) -> HeldOut:
    """Return an entry of the audit with distances in metres of ground."""
    names = [
        entry.name for entry in fields(held) if entry.name.endswith("_m") and getattr(held, entry.name) is not None
    ]
    return replace(held, **{name: getattr(held, name) / scale for name in names})


def _redact_map(source: MapSource, redaction: Redaction) -> MapSource:
    low, high = source.height_min_m, source.height_max_m
    x_m, y_m = redaction.origin_xy_m
    return replace(
        source,
        name=redaction.maps[source.name],
        crs=PLANE,
        x_min_m=source.x_min_m - x_m,
        y_max_m=source.y_max_m - y_m,
        sha256=None,
        sources=None,
        inputs=None,
        height_min_m=None if low is None else low - redaction.height_m,
        height_max_m=None if high is None else high - redaction.height_m,
        findings=redact_findings(source.findings),
    )


def _move_polygon(polygon: PolygonGeometry, redaction: Redaction) -> PolygonGeometry:
    move = replace(redaction, gnss_crs="EPSG:4326").placed
    return replace(polygon, coordinates=move_coordinates(polygon.coordinates, move))


def move_coordinates(coordinates: Any, move: Callable[[Floats], Floats]) -> Any:
    """Return the coordinates of a GeoJSON geometry with each position moved."""
    if isinstance(coordinates[0], int | float):
        return tuple(move(np.array(coordinates[:2], np.float64)).round(9).tolist())
    return tuple(move_coordinates(part, move) for part in coordinates)


def find_leaks(card: DatasetCard, samples: pa.Table) -> Iterator[str]:
    """Yield what a redacted dataset reveals, a line for each secret."""
    for end in _ENDS:
        lon, lat, x_m, y_m = (to_floats(samples, f"{end}_{name}") for name in ("lon_deg", "lat_deg", "x_m", "y_m"))
        plane_x_m, plane_y_m = _make_transformer("EPSG:4326", PLANE).transform(lon, lat)
        if (np.hypot(x_m - plane_x_m, y_m - plane_y_m) > _REDACTED_WITHIN_M).any():
            yield f"{end}_x_m and {end}_y_m are not along its lon and lat: their angle reveals the latitude; build it again"
        for axis, degrees in zip(_AXES, (lon, lat), strict=True):
            if (np.abs(degrees) > REACH_DEG).any():
                yield f"{end}_{axis}_deg is beyond {REACH_DEG:g} degrees"
    yield from (f"map {source.name} has the CRS {source.crs}" for source in card.maps if source.crs != PLANE)
    named = [run.run_id for run in card.runs if run.logs or not re.fullmatch(r"run\d{4,}-[0-9a-f]+", run.run_id)]
    yield from (f"reveals the name of the log of run {name}" for name in named)
    ratio, _, most = compute_plane_per_chord(samples)
    if abs(ratio - 1.0) > max(most, _SCALE_VARIES):
        yield f"distances are {ratio:.6f} of chord_m: the scale of the maps' plane reveals the place; build it again"
    yield from (f"tells {text!r}" for text in (*card.label.includes, *card.added_columns.values()) if text)
    every = (card.findings, card.verdict.reasons, *card.findings_by_run.values(), *card.findings_by_map.values())
    revealing = [finding.code for findings in every for finding in findings if _redact_finding(finding) != finding]
    yield from (f"a finding {code} contains more than is public" for code in revealing)


def compute_plane_per_chord(samples: pa.Table) -> tuple[float, float, float]:
    """Return the length of a metre of ``chord_m`` in x and y, its standard and its greatest error from rounding; inf without samples.

    Consecutive segments are added up: only their two outer ends are rounded.
    """
    samples = samples.sort_by([("run_id", "ascending"), ("start_ns", "ascending")])
    if not samples.num_rows:
        return 1.0, math.inf, math.inf
    start_m, end_m = (np.stack([to_floats(samples, f"{end}_{axis}_m") for axis in "xy"], axis=-1) for end in _ENDS)
    course_rad = to_floats(samples, "course_rad")
    chord_m = to_floats(samples, "chord_m")[:, None] * np.stack([np.cos(course_rad), np.sin(course_rad)], axis=-1)
    follows = np.hypot(*(start_m[1:] - end_m[:-1]).T) < _PLACE_M / 2
    first = np.flatnonzero(np.concatenate([[True], ~follows]))
    last = np.append(first[1:], len(start_m)) - 1
    chained_m = np.add.reduceat(chord_m, first)
    squares = float((chained_m**2).sum())
    ratio = float(((end_m[last] - start_m[first]) * chained_m).sum()) / squares
    most_m = math.sqrt(2.0) * _PLACE_M * float(np.hypot(*chained_m.T).sum())
    return ratio, _PLACE_M / math.sqrt(6.0 * squares), most_m / squares
