"""A dataset, a store or a run as a GeoPackage: samples, footprints, regions, where to drive next; segments."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import shapely
from numpy.typing import NDArray
from pyproj import CRS
from shapely.geometry.base import BaseGeometry

from tcpipe.errors import UsageError, clean_lines
from tcpipe.formats.bucket_directories import fetch_directory
from tcpipe.formats.dataset_card import DatasetCard, MapSource
from tcpipe.formats.dataset_files import CARD, DRIVE_NEXT, read_current_card, read_samples
from tcpipe.formats.geojson import read_polygons
from tcpipe.formats.geopackage import VIRIDIS, VectorLayer, make_classes_style, make_ranges_style, write_geopackage
from tcpipe.formats.object_storage import is_url
from tcpipe.report.colours import SPLIT_COLOURS
from tcpipe.store import Store, find_store_above, is_store, run_at
from tcpipe.tables.arrays import make_lines, to_texts
from tcpipe.tables.columns import read_lonlat_deg, to_floats
from tcpipe.terrain.projection import Projection, compute_area, parse_crs
from tcpipe.terrain.sampling import compute_footprints, make_patch_frames

_REGIONS = {"train_test": SPLIT_COLOURS["train"], "unseen": SPLIT_COLOURS["unseen"], "exclude": SPLIT_COLOURS["buffer"]}
_WGS84 = "EPSG:4326"

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ExportedLayers:
    """A GeoPackage that was written, and the rows of each of its layers."""

    source: str
    path: Path
    layers: Mapping[str, int]

    def __str__(self) -> str:
        """Return its layers, a line each."""
        return clean_lines((f"{self.path}:", *(f"{rows:>9} {name}" for name, rows in self.layers.items())))


def export_layers(source: Path | str, out: Path) -> ExportedLayers:
    """Write a dataset, a run or all runs of a store, here or in a bucket, as a GeoPackage with styles for QGIS.

    Raises
    ------
    UsageError : ``source`` is none of these, ``out`` is there and something else, or the extra ``gis`` is not installed.
    DatasetError, StoreError : it cannot be read.
    """
    stored = is_store(source) or find_store_above(source) is not None
    if stored:
        layers = [_make_segment_layer(source)]
    else:
        directory = fetch_directory(source) if is_url(source) else Path(source)
        if not (directory / CARD).is_file():
            raise UsageError(f"{source}: is no dataset, run or store; a GeoPackage is made of one of these")
        layers = list(_iterate_dataset_layers(directory))
    write_geopackage(out, layers)
    return ExportedLayers(str(source), out, {layer.name: layer.table.num_rows for layer in layers})


def _make_segment_layer(source: Path | str) -> VectorLayer:
    found = run_at(source)
    runs = found[1] if found else Store(source).runs()
    crs = {run.manifest.recipe.read.gnss_crs for run in runs}
    if len(crs) != 1:
        raise UsageError(
            f"{source}: its runs are in {', '.join(sorted(crs)) or 'no datum: there are none'}; give one run"
        )
    table = pa.concat_tables([run.segments() for run in runs])
    table = table.filter(table["start_lon_deg"].is_valid())
    return VectorLayer("segments", "LineString", crs.pop(), table, _make_lines(table), _make_power_style(table))


def _iterate_dataset_layers(directory: Path) -> Iterator[VectorLayer]:
    card, table = read_current_card(directory), read_samples(directory)
    split = make_classes_style("split", SPLIT_COLOURS, "line")
    yield VectorLayer(
        "samples",
        "LineString",
        card.recipe.read.gnss_crs,
        table,
        _make_lines(table),
        {"split": split, **_make_power_style(table)},
    )
    named = table.select(["sample_id", "split", "map"])
    areas = list(shapely.to_wkb(shapely.polygons(_compute_footprints(card, table))))
    yield VectorLayer(
        "footprints", "Polygon", _WGS84, named, areas, {"split": make_classes_style("split", SPLIT_COLOURS, "fill")}
    )
    if card.split.region:
        kinds = pa.table({"split": list(card.split.region)})
        shapes = [
            shapely.geometry.shape({"type": of.type, "coordinates": of.coordinates})
            for of in card.split.region.values()
        ]
        yield VectorLayer(
            "regions",
            "MultiPolygon",
            _WGS84,
            kinds,
            _make_multi_lines(shapes),
            {"split": make_classes_style("split", _REGIONS, "fill")},
        )
    if (directory / DRIVE_NEXT).is_file() and (features := read_polygons(directory / DRIVE_NEXT)[0]):
        facts = pa.Table.from_pylist([dict(feature.properties) for feature in features])
        rare = dict(zip(dict.fromkeys(to_texts(facts["class"]).tolist()), VIRIDIS * len(features), strict=False))
        shapes = [shapely.MultiPolygon(feature.polygons) for feature in features]
        yield VectorLayer(
            "drive_next",
            "MultiPolygon",
            _WGS84,
            facts,
            _make_multi_lines(shapes),
            {"class": make_classes_style("class", rare, "fill")},
        )


def _make_lines(table: pa.Table) -> list[bytes]:
    found: list[bytes] = make_lines(*(read_lonlat_deg(table, end) for end in ("start", "end"))).to_pylist()
    return found


def _make_multi_lines(shapes: Sequence[BaseGeometry]) -> list[bytes]:
    whole = [of if of.geom_type == "MultiPolygon" else shapely.MultiPolygon([of]) for of in shapes]
    return list(shapely.to_wkb(whole))


def _make_power_style(table: pa.Table) -> dict[str, str]:
    power = to_floats(table, "power_watt")
    power = power[np.isfinite(power)]
    return (
        {"power": make_ranges_style("power_watt", np.quantile(power, np.linspace(0.0, 1.0, 6)).tolist(), "line")}
        if len(power)
        else {}
    )


def _compute_footprints(card: DatasetCard, table: pa.Table) -> Floats:
    """Return the corners of each patch as WGS 84 lon, lat [deg], shape (N, 4, 2)."""
    names, corners = to_texts(table["map"]), np.full((table.num_rows, 4, 2), np.nan)
    for source in card.maps:
        rows = np.flatnonzero(names == source.name)
        if len(rows):
            corners[rows] = _project_from_map(table.take(rows), source, card)
    return corners


def _project_from_map(table: pa.Table, source: MapSource, card: DatasetCard) -> Floats:
    crs = parse_crs(source.crs, where=f"map {source.name}")
    area = compute_area(crs, source.bounds_m)
    place = Projection(parse_crs(card.recipe.read.gnss_crs, where="gnss_crs"), crs, area)
    start, end = (place.forward(read_lonlat_deg(table, name)) for name in ("start", "end"))
    corners = compute_footprints(make_patch_frames(start, end, to_floats(table, "chord_m")), card.patch_m)
    return Projection(CRS.from_epsg(4326), crs, area).inverse(corners)
