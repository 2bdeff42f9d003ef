"""A dataset for the public: no names of logs, topics, paths, hosts or users, and everything moved by one offset that is kept nowhere."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyproj import Transformer

from tcpipe.errors import DatasetError
from tcpipe.formats.dataset_card import DatasetCard, MapSource, Redacted
from tcpipe.formats.geojson import FeatureCollection, PolygonGeometry
from tcpipe.pipeline.dataset.content import Content
from tcpipe.pipeline.dataset.inputs import Inputs
from tcpipe.recipe import Recipe
from tcpipe.tables.columns import floats, lonlat_deg

PLANE = "+proj=tmerc +lat_0=0 +lon_0=0 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +type=crs"
"""Where a redacted dataset lies: the plane of its maps, laid down at 0° N 0° E with its grid north up."""

REACH_DEG = 5.0
"""No redacted dataset lies further from there."""

_PLACE_M, _PLACE_DIGITS_DEG = 0.01, 7
"""Places are told to a centimetre: finer, their distances would tell the scale of the maps' plane."""

_REDACTED_WITHIN_M = 0.1
"""Of lon and lat lie x and y of a redacted dataset."""

_ENDS, _AXES = ("start", "end"), ("lon", "lat")
_PLACES = re.compile(r"\b[\w.+-]+@[\w.-]+|(?<![\w/])(?:[A-Za-z]:(?=\\)|[a-z]\w*:/)?[~.]{0,2}[/\\][\w./\\~@%+-]+")
"""Users at hosts; paths, topics and URLs."""
_HIDDEN = "…"

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Redaction:
    """How runs, maps and places are told."""

    gnss_crs: str
    map_crs: str
    origin_xy_m: tuple[float, float]
    """Of the maps' plane: it becomes 0, 0."""
    height_m: float
    """What is taken from heights of the maps."""
    runs: Mapping[str, str]
    maps: Mapping[str, str]

    def in_plane(self, lonlat_deg: Floats) -> Floats:
        """Return where places (lon, lat) [deg], shape (..., 2), lie in the maps' plane, from its new origin [m]."""
        to_map = _between(self.gnss_crs, self.map_crs)
        return np.stack(to_map.transform(lonlat_deg[..., 0], lonlat_deg[..., 1]), axis=-1) - self.origin_xy_m

    def placed(self, lonlat_deg: Floats) -> Floats:
        """Return where places (lon, lat) [deg], shape (..., 2), are said to lie."""
        return _laid_down(self.in_plane(lonlat_deg))

    def segment_id(self, name: str, run_id: str) -> str:
        """Return what a run's segment is called."""
        return self.runs[run_id] + name[len(run_id) :]

    def table(self, samples: pa.Table) -> pa.Table:
        """Return samples with the places and names that are told; courses and x, y are along the maps' grid.

        In its run's own frame x is towards the east: against the grid that would tell the meridian's convergence, and so the latitude.
        """
        ends = {end: self.in_plane(lonlat_deg(samples, end)) for end in _ENDS}
        columns: dict[str, Any] = {
            f"{end}_{axis}_deg": _laid_down(xy_m)[:, at] for end, xy_m in ends.items() for at, axis in enumerate(_AXES)
        }
        columns |= {
            f"{end}_{axis}_m": (xy_m[:, at] / _PLACE_M).round() * _PLACE_M
            for end, xy_m in ends.items()
            for at, axis in enumerate("xy")
        }
        columns["course_rad"] = np.arctan2(*(ends["end"] - ends["start"]).T[::-1])
        columns["height_min_m"] = floats(samples, "height_min_m") - self.height_m
        runs = samples.column("run_id").to_pylist()
        columns["run_id"] = [self.runs[run_id] for run_id in runs]
        columns["map"] = [self.maps[name] for name in samples.column("map").to_pylist()]
        for name in ("sample_id", "segment_id"):
            pairs = zip(samples.column(name).to_pylist(), runs, strict=True)
            columns[name] = [self.segment_id(segment, run_id) for segment, run_id in pairs]
        for name, values in columns.items():
            field = samples.schema.field(name)
            samples = samples.set_column(samples.schema.get_field_index(name), field, pa.array(values, field.type))
        return samples

    def text(self, line: str) -> str:
        """Return a line without names of runs and maps, paths, topics, hosts and users."""
        for name, told in sorted({**self.runs, **self.maps}.items(), key=lambda of: -len(of[0])):
            line = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", lambda _, told=told: told, line)  # type: ignore[misc]
        return _PLACES.sub(_HIDDEN, line)


@cache
def _between(source: str, target: str) -> Transformer:
    return Transformer.from_crs(source, target, always_xy=True)


def _laid_down(xy_m: Floats) -> Floats:
    """Return (lon, lat) [deg] of places in the plane at 0 N 0 E, shape (..., 2)."""
    lonlat = _between(PLANE, "EPSG:4326").transform(xy_m[..., 0], xy_m[..., 1])
    return np.stack(lonlat, axis=-1).round(_PLACE_DIGITS_DEG)


def redaction_of(content: Content, inputs: Inputs, recipe: Recipe) -> Redaction:
    """Return how a dataset is redacted; `DatasetError` where its maps lie in different planes, of which one offset makes none."""
    planes = {source.grid.crs for source in content.sources}
    if len(planes) > 1:
        raise DatasetError(
            f"maps in {len(planes)} CRS cannot be redacted together; build with those of one CRS (--map)"
        )
    heights_m = content.samples.sampled.patches.columns()["height_min_m"]
    return Redaction(
        gnss_crs=recipe.read.gnss_crs,
        map_crs=content.sources[0].grid.crs,
        origin_xy_m=tuple(content.samples.centres_xy_m().mean(axis=0).tolist()),
        height_m=float(math.floor(np.min(heights_m))),
        runs={run.run_id: f"run{number:04}-{run.sha256[:8]}" for number, run in enumerate(inputs.sources, 1)},
        maps={name: f"map{number}" for number, name in enumerate(inputs.map_names, 1)},
    )


def redacted_content(content: Content, redaction: Redaction) -> Content:
    """Return content whose samples have the names and places that are told."""
    sampled = content.samples.sampled
    footprints = replace(redaction, gnss_crs="EPSG:4326").placed(sampled.footprint_lonlat_deg)
    samples = replace(content.samples, sampled=replace(sampled, footprint_lonlat_deg=footprints), redaction=redaction)
    return replace(content, samples=samples, registrations=[() for _ in content.registrations])


def redacted_inputs(inputs: Inputs, redaction: Redaction) -> Inputs:
    """Return inputs whose runs are called as is told, without what their logs are called and ingest said of them."""
    runs = tuple(
        replace(
            run,
            run_id=redaction.runs[run.run_id],
            logs=(),
            tags=None,
            warnings=tuple(map(redaction.text, run.warnings)),
        )
        for run in inputs.sources
    )
    return replace(inputs, sources=runs)


def redacted_card(card: DatasetCard, redaction: Redaction) -> DatasetCard:
    """Return a card, made from redacted inputs and samples, without what is left in it of names and places."""
    region = card.split.region
    told = None if region is None else {kind: _moved(of, redaction) for kind, of in region.items()}
    bare = replace(Recipe(), **{name: getattr(card.recipe, name) for name in _KEPT_SECTIONS})
    return replace(
        card,
        recipe=bare,
        split=replace(card.split, region=told),
        maps=tuple(_map(source, redaction) for source in card.maps),
        problems=tuple(map(redaction.text, card.problems)),
        warnings=tuple(map(redaction.text, card.warnings)),
        covariates=tuple(replace(of, name=f"covariates{n}") for n, of in enumerate(card.covariates, 1)),
        added_columns={name: redaction.text(about) for name, about in card.added_columns.items()},
        redaction=Redacted(),
    )


_KEPT_SECTIONS = ("fuse", "gate", "segment", "label", "sample", "split", "covariates", "dataset")
"""Of the recipe: the others tell topics, files and robots by name."""


def _map(source: MapSource, redaction: Redaction) -> MapSource:
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
        warnings=tuple(map(redaction.text, source.warnings)),
    )


def _moved(polygon: PolygonGeometry, redaction: Redaction) -> PolygonGeometry:
    move = replace(redaction, gnss_crs="EPSG:4326").placed
    return replace(polygon, coordinates=moved_coordinates(polygon.coordinates, move))


def redacted_features(collection: FeatureCollection, redaction: Redaction) -> FeatureCollection:
    """Return polygons (WGS84) where they are said to lie."""
    features = (replace(of, geometry=_moved(of.geometry, redaction)) for of in collection.features)
    return replace(collection, features=tuple(features))


def moved_coordinates(coordinates: Any, move: Callable[[Floats], Floats]) -> Any:
    """Return the coordinates of a GeoJSON geometry with each position moved."""
    if isinstance(coordinates[0], int | float):
        return tuple(move(np.array(coordinates[:2], np.float64)).round(9).tolist())
    return tuple(moved_coordinates(part, move) for part in coordinates)


def what_is_told(card: DatasetCard, samples: pa.Table) -> Iterator[str]:
    """Yield a line for each thing that a redacted dataset tells and should not; ``samples`` has where their ends lie."""
    for end in _ENDS:
        lon, lat, x_m, y_m = (floats(samples, f"{end}_{name}") for name in ("lon_deg", "lat_deg", "x_m", "y_m"))
        plane_x_m, plane_y_m = _between("EPSG:4326", PLANE).transform(lon, lat)
        if (np.hypot(x_m - plane_x_m, y_m - plane_y_m) > _REDACTED_WITHIN_M).any():
            yield (
                f"it is said to be redacted, but {end}_x_m and {end}_y_m are not along its lon and lat: their angle tells the latitude; "
                "build it again"
            )
        for axis in _AXES:
            if (np.abs(floats(samples, f"{end}_{axis}_deg")) > REACH_DEG).any():
                yield f"it is said to be redacted, but {end}_{axis}_deg is beyond {REACH_DEG:g} degrees"
    elsewhere = [source for source in card.maps if source.crs != PLANE]
    yield from (f"it is said to be redacted, but map {source.name} has the CRS {source.crs}" for source in elsewhere)
    named = [run.run_id for run in card.runs if run.logs or not re.fullmatch(r"run\d{4,}-[0-9a-f]+", run.run_id)]
    yield from (f"it is said to be redacted, but tells what the log of run {name} is called" for name in named)
    texts = [*card.problems, *card.warnings, *(line for run in card.runs for line in run.warnings)]
    yield from (
        f"it is said to be redacted, but tells {found[0]!r}" for line in texts if (found := _PLACES.search(line))
    )
