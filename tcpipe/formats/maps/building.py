"""Building a map: rasters that need not share grid, resolution or CRS, put on one common grid, window by window."""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from io import StringIO
from pathlib import Path
from typing import Any, Literal

from pyproj import CRS

from tcpipe.errors import MapError
from tcpipe.formats.atomic import write_atomic_directory
from tcpipe.formats.geojson import shorten_problems
from tcpipe.formats.integrity import write_checksums
from tcpipe.formats.maps.geotiff import USES, OpenFile, keep_open
from tcpipe.formats.maps.layer_building import (
    Raster,
    RasterLayer,
    Tally,
    draw_colours,
    iterate_shards,
    open_raster,
    split_colours,
)
from tcpipe.formats.maps.map_facts import MapFacts, MapInputs
from tcpipe.formats.maps.map_files import PICTURE_PX, SHARD_PX, MapWriter
from tcpipe.formats.maps.terrain_polygons import PolygonLayer, is_drawn, place_polygons
from tcpipe.formats.recipe_toml import parse_toml
from tcpipe.tables.findings import Finding, Findings, Subject, make_finding, read_threshold
from tcpipe.terrain.layers import (
    MAX_ID,
    PAPER_LAYERS,
    PAPER_SCHEME,
    ClassScheme,
    ClassTable,
    Layer,
    TerrainClass,
    find_named_scheme,
    make_categorical_layer,
    make_continuous_layer,
    make_own_scheme,
    make_paper_layers,
)
from tcpipe.terrain.projection import parse_crs
from tcpipe.terrain.target_grid import MapGrid, choose_crs, choose_grid, find_projection

Files = Path | Sequence[Path]
"""One file of a layer, or all files; the last one has priority."""

LayerSource = RasterLayer | PolygonLayer
"""Source of a layer of a map."""

OrthoBands = Literal["grey", "rgb"]


@dataclass(frozen=True, slots=True)
class MoreLayers:
    """Layers of a map in addition to height, ortho and terrain."""

    files: Mapping[str, Files] = field(default_factory=dict)
    """Rasters by the layer's name."""
    categorical: Mapping[str, Path | None] = field(default_factory=dict)
    """Rasters whose values are classes, and their class tables; None: the raster's own names give the meanings."""
    ortho_bands: OrthoBands = "grey"
    """rgb: the orthophoto's colours, too."""


def build_map(
    out_path: Path,
    *,
    name: str,
    height: Files,
    ortho: Files = (),
    terrain: Files = (),
    more: MoreLayers = MoreLayers(),
    classes: Path | None = None,
    agreed: ClassScheme | None = None,
    crs: str | None = None,
    pixel_size_m: float | None = None,
    inputs: MapInputs | None = None,
) -> MapFacts:
    """Put rasters on one common grid and write them as a map; nothing remains if that fails.

    Parameters
    ----------
    out_path : the Zarr directory; an existing one is replaced once the new one is complete.
    height, ortho, terrain : rasters in any CRS on the earth, grid and resolution, each in one file or in tiles of one
        grid (`layer_building`); terrain also as GeoJSON polygons (`terrain_polygons`).
    more : other layers, put on the grid of these three.
    classes : class table (CSV or TOML); None takes ``agreed``, the classes of the store's other maps, else the paper's
        seven classes. If the terrain raster names its values, these names determine the classes.
    crs : the map's CRS, projected and metric, and the CRS of rasters that carry none; None takes the height raster's,
    or its UTM zone.
    pixel_size_m : side of a map pixel [m]; None takes the finest raster's.
    inputs : identity of the inputs for later comparison, stored in the map's facts.

    `MapError`: a raster has no CRS, cannot be read, or holds nothing here; the class table is not the store's: one line
    each.
    """
    given = {"height": height, "ortho": ortho, "terrain": terrain, **more.files}
    paths = {role: [files] if isinstance(files, Path) else list(files) for role, files in given.items() if files}
    drawn = paths.pop("terrain") if "terrain" in paths and is_drawn(paths["terrain"]) else []
    wanted = parse_crs(crs, where="--crs") if crs else None
    with keep_open() as open_file:
        rasters = _open_all(open_file, paths, more, wanted)
        scheme, origin = _choose_scheme(classes, agreed, rasters.get("terrain"))
        schemes = {"terrain": scheme} | _read_own_schemes(more, rasters)
        ground = rasters["height"].georeference
        map_crs = choose_crs(ground, wanted)
        others = [rasters[role].georeference for role in ("ortho", "terrain") if role in rasters]
        grid = choose_grid(ground, others, map_crs, pixel_size_m)
        sources: dict[str, LayerSource] = {
            role: RasterLayer(
                _make_layer(raster, schemes),
                raster,
                grid,
                find_projection(raster.georeference, map_crs),
                schemes.get(role),
                Tally(nodata=raster.tiles[0].nodata),
            )
            for role, raster in rasters.items()
        }
        if drawn:
            sources["terrain"] = place_polygons(drawn, scheme, map_crs, grid)
        layers = {role: source.layer for role, source in sources.items()}
        with write_atomic_directory(out_path) as half:
            writer = MapWriter(half, name=name, grid=grid, scheme=scheme, layers=layers)
            for source in sources.values():
                for row0, col0, rows, cols in iterate_shards(source.grid, SHARD_PX):
                    shard = source.shard(row0, col0, rows, cols)
                    if source.tally.count(source.layer, source.label, shard):
                        writer.write(source.layer.name, row0, col0, shard)
            _refuse_empty(sources)
            facts = _make_facts(grid, sources, origin, inputs or MapInputs())
            photo = sources.get("ortho")
            if isinstance(photo, RasterLayer) and (picture := draw_colours(photo, PICTURE_PX)) is not None:
                writer.write_picture(picture)
            writer.finish(facts, {role: _set_range(source) for role, source in sources.items()})
            write_checksums(half)
    return facts


def _make_layer(raster: Raster, schemes: Mapping[str, ClassScheme]) -> Layer:
    """Return the layer that a raster becomes; the range of numbers is not known before they are read."""
    if raster.role in PAPER_LAYERS:
        return make_paper_layers([raster.role], schemes["terrain"].table)[raster.role]
    if raster.role in schemes:
        return make_categorical_layer(raster.role, schemes[raster.role].table)
    return make_continuous_layer(raster.role, unit=raster.unit, low=0.0, high=1.0)


def _set_range(source: LayerSource) -> Layer:
    """Return a layer with the range of its values, as it was found."""
    layer, tally = source.layer, source.tally
    return replace(layer, low=tally.low, high=tally.high) if layer.stack == "floats" else layer


def _read_own_schemes(more: MoreLayers, rasters: Mapping[str, Raster]) -> dict[str, ClassScheme]:
    """Return the classes of the user's categorical layers: of a file, or as the raster itself names its values."""
    schemes = {
        name: make_own_scheme(rasters[name].names) if table is None else read_class_scheme(table)
        for name, table in more.categorical.items()
    }
    if problems := [
        f"{rasters[name].georeference.name}: does not define the meaning of its values (no attribute table, no category names); "
        f"give a table: --categorical {name}=classes.csv"
        for name, scheme in schemes.items()
        if scheme is None
    ]:
        raise MapError(*problems)
    return {name: scheme for name, scheme in schemes.items() if scheme is not None}


def _choose_scheme(classes: Path | None, agreed: ClassScheme | None, terrain: Raster | None) -> tuple[ClassScheme, str]:
    """Return the classes and their source: ``file``, ``names`` of the raster's values, ``store`` or ``default``."""
    if classes is not None:
        scheme = read_class_scheme(classes)
        if different := () if agreed is None else scheme.table.differences(agreed.table):
            raise MapError(
                f"{classes}: the class table is not the one of the store's other maps; take theirs, or keep this map in another store",
                *(f"{classes}: {clause}" for clause in different),
            )
        return scheme, "file"
    scheme, origin = (PAPER_SCHEME, "default") if agreed is None else (agreed, "store")
    if terrain is None or not terrain.names:
        return scheme, origin
    named = find_named_scheme(terrain.names, scheme.table)
    if named is None:
        raster_names = ", ".join(dict.fromkeys(terrain.names.values()))
        table_names = ", ".join(entry.name for entry in scheme.table.classes)
        raise MapError(
            f"{terrain.georeference.name}: none of its class names ({raster_names}) is in the class table ({table_names}); "
            "define them with --classes"
        )
    return named, "names"


def _open_all(
    open_file: OpenFile, paths: Mapping[str, Sequence[Path]], more: MoreLayers, crs: CRS | None
) -> dict[str, Raster]:
    rasters: dict[str, Raster] = {}
    problems: list[str] = []
    uses = USES | {name: "classes" if name in more.categorical else "numbers" for name in more.files}
    for role, files in paths.items():
        try:
            rasters[role] = open_raster(files, role, uses[role], open_file, crs)
        except MapError as error:
            problems += error.problems
    if more.ortho_bands == "rgb" and (ortho := rasters.get("ortho")) and not (colours := split_colours(ortho)):
        problems.append(f"{ortho.georeference.name}: has no colours, expected red, green, blue for --ortho-bands rgb")
    if problems:
        raise MapError(*problems)
    return rasters | (colours if more.ortho_bands == "rgb" else {})


def _refuse_empty(layers: Mapping[str, LayerSource]) -> None:
    problems = []
    for role, layer in layers.items():
        if layer.tally.pixels:
            continue
        if role == "height":
            problems.append(f"{layer.label}: every pixel is nodata")
        else:
            over = layers["height"].name
            unnamed = layer.explain_no_class() if isinstance(layer, RasterLayer) else None
            problems.append(unnamed or f"{layer.label}: has no data anywhere on the height raster {over}")
    if problems:
        raise MapError(*problems)


def _find_all(layers: Mapping[str, LayerSource], covered: Mapping[str, float]) -> Findings:
    findings: list[Finding] = []
    least = read_threshold("layer-covers-little", "min_share_of_height_fraction") * covered["height"]
    for role, layer in layers.items():
        findings += layer.list_findings()
        if covered[role] < least:
            names = {"file": layer.name}
            subject = Subject("layer", role)
            findings.append(make_finding("layer-covers-little", subject, names=names, covered_fraction=covered[role]))
    return tuple(findings)


def _find_assumed(terrain: LayerSource | None) -> Findings:
    """Return the finding, if any, that terrain values are read as the paper's classes although no table names them."""
    values = [] if terrain is None else terrain.values
    known = [f"{entry.id} as {entry.name}" for entry in PAPER_SCHEME.table.classes if entry.id in values]
    if not known:
        return ()
    names = {"meaning": ", ".join(known[:3]) + (" …" if known[3:] else "")}
    return (make_finding("classes-assumed", Subject("layer", "terrain"), names=names),)


def _make_facts(grid: MapGrid, layers: Mapping[str, LayerSource], classes_from: str, inputs: MapInputs) -> MapFacts:
    """Return the findings; layers with their own pixel size may extend beyond the map."""
    covered = {}
    for role, layer in layers.items():
        pixels = layer.tally.pixels * (layer.grid.pixel_size_m / grid.pixel_size_m) ** 2
        covered[role] = min(pixels / (grid.rows * grid.cols), 1.0)
    assumed = _find_assumed(layers.get("terrain")) if classes_from == "default" else ()
    shares = {name: found for name, layer in layers.items() if (found := _compute_class_shares(layer))}
    return MapFacts(
        sources={role: layer.name for role, layer in layers.items()},
        covered=covered,
        height_min_m=layers["height"].tally.low,
        height_max_m=layers["height"].tally.high,
        class_share=shares.pop("terrain", {}),
        class_shares=shares,
        findings=(*assumed, *_find_all(layers, covered)),
        classes_from=classes_from,
        inputs=inputs,
    )


def _compute_class_shares(source: LayerSource) -> dict[str, float]:
    """Return the share of each class that occurs among the pixels that have one; {} for a layer without classes."""
    counts, classes = source.tally.by_class, source.layer.classes
    total = max(int(counts[1:].sum()), 1)
    entries = () if classes is None else classes.classes
    return {entry.name: float(counts[entry.id] / total) for entry in entries if counts[entry.id]}


MAX_BYTES = 2_000_000
"""Largest class table [byte]: enough for every value of 16 bits."""

_SHOWN = 20
_INT64 = 2**63

_COLUMNS, _COLOR = ("value", "id", "name", "traversable"), "color"
_TRUTH = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


def read_class_scheme(path: Path) -> ClassScheme:
    """Read a class table and the raster values of its classes; `MapError`: one problem for each wrong line."""
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise MapError(
                f"{path}: a class table of {size / 1e6:.1f} MB, at most {MAX_BYTES // 10**6}: {MAX_ID} classes and their values"
            )
        text = path.read_text(encoding="utf-8-sig")
        rows = _read_toml_rows(text) if path.suffix.lower() == ".toml" else _read_csv_rows(text, path)
    except (OSError, ValueError, csv.Error) as error:
        raise MapError(f"{path}: the class table cannot be read ({error})") from error
    problems: list[str] = []
    classes: dict[int, TerrainClass] = {}
    id_by_value: dict[int, int] = {}
    for where, row in rows:
        found = _parse_entry(row, f"{path}: {where}", problems)
        if found is None:
            continue
        values, entry = found
        if classes.setdefault(entry.id, entry) != entry:
            problems.append(f"{path}: {where}: id {entry.id} was {classes[entry.id]} before, now {entry}")
        taken = [value for value in values if id_by_value.setdefault(value, entry.id) != entry.id]
        problems += [f"{path}: {where}: value {value} already has id {id_by_value[value]}" for value in taken]
    if not classes and not problems:
        problems.append(f"{path}: the class table has no classes (expected columns {','.join(_COLUMNS)})")
    if problems:
        raise MapError(*shorten_problems(problems, _SHOWN))
    return ClassScheme(ClassTable(tuple(classes[key] for key in sorted(classes))), dict(sorted(id_by_value.items())))


def _read_csv_rows(text: str, path: Path) -> list[tuple[str, dict[str, Any]]]:
    reader = csv.DictReader(StringIO(text, newline=""), skipinitialspace=True)
    missing = [name for name in _COLUMNS if name not in (reader.fieldnames or ())]
    if missing:
        raise MapError(f"{path}: line 1: columns {','.join(missing)} are missing (expected {','.join(_COLUMNS)})")
    return [(f"line {reader.line_num}", row) for row in reader]


def _read_toml_rows(text: str) -> list[tuple[str, dict[str, Any]]]:
    rows = parse_toml(text).get("class", [])
    return [(f"class {number}", row) for number, row in enumerate(rows if isinstance(rows, list) else [rows], 1)]


def _parse_entry(row: Any, where: str, problems: list[str]) -> tuple[list[int], TerrainClass] | None:
    before = len(problems)
    if not isinstance(row, dict):
        problems.append(f"{where}: expected a table with {', '.join(_COLUMNS)}")
        return None
    problems += [f"{where}: {name} is missing" for name in _COLUMNS if row.get(name) in (None, "", "?")]
    problems += [
        f"{where}: {name!r} is not a column (expected {', '.join(_COLUMNS)})"
        for name in row
        if name not in {*_COLUMNS, _COLOR}
    ]
    if len(problems) > before:
        return None
    given = row["value"] if isinstance(row["value"], list) else [row["value"]]
    values = [_integer(value) for value in given]
    if None in values:
        problems.append(f"{where}: value {row['value']!r} is not an integer")
    class_id = _integer(row["id"])
    if class_id is None or not 1 <= class_id <= MAX_ID:
        problems.append(f"{where}: id {row['id']!r} is not an integer from 1 to {MAX_ID} (0 is no data)")
    traversable = _TRUTH.get(str(row["traversable"]).strip().lower())
    if traversable is None:
        problems.append(f"{where}: traversable {row['traversable']!r} is neither true nor false")
    if len(problems) > before or class_id is None or traversable is None:
        return None
    name = str(row["name"]).strip(" \t")
    if not name.isprintable():
        problems.append(f"{where}: name {name!r} contains characters that cannot be printed")
        return None
    color = str(row.get(_COLOR) or "").strip() or None
    if color and re.fullmatch(r"#[0-9a-fA-F]{6}", color) is None:
        problems.append(f"{where}: color {color!r} is not of the form #rrggbb")
        return None
    return [value for value in values if value is not None], TerrainClass(
        class_id, name, traversable=traversable, color=color
    )


def _integer(value: Any) -> int | None:
    if isinstance(value, bool):
        return None
    try:
        number = int(str(value).strip())
    except ValueError:
        return None
    return number if -_INT64 <= number < _INT64 else None
