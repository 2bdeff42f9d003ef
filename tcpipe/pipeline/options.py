"""The options of ``tcpipe ingest``, ``add-map`` and ``build-dataset``, and of the functions of these names."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

from tcpipe.formats.atomic import Location
from tcpipe.tables.options import (
    DRY_RUN,
    MESSAGE_DEFINITIONS,
    RECIPE,
    SEED,
    STORE,
    Option,
    Range,
    jobs,
    option,
    required,
    tags,
)

if TYPE_CHECKING:
    from tcpipe.formats.dataset_files import FileFormat
    from tcpipe.pipeline.plan import IngestResult
    from tcpipe.recipe import Recipe


@dataclass(frozen=True, slots=True)
class IngestOptions:
    """Which logs are ingested, into which store, and how."""

    logs: Iterable[Location] = required(Option(kind="several", metavar="LOG...", repeatable=True, is_argument=True))
    """Files, ROS 2 bag directories, folders (searched), or URLs of such (``s3://…``), read by range or copied."""
    _: KW_ONLY
    store: Location = option("tcpipe-store", STORE)
    recipe: Recipe | Location | None = option(None, RECIPE)
    robot: str | None = option(
        None,
        "Robot profile, built in or from the recipe (default: found by message types and topic names).",
        kind="robot",
        metavar="NAME",
    )
    tag: Mapping[str, str] | None = tags("Tag for the runs; repeatable.")
    jobs: int = jobs("Logs")
    cluster: str | None = option(
        None,
        "Dask scheduler whose workers ingest the logs, tcp://host:port (or TCPIPE_CLUSTER); instead of --jobs.",
        metavar="ADDRESS",
        envvar="TCPIPE_CLUSTER",
    )
    """Workers see logs and store under the same absolute paths."""
    as_one: bool = option(False, "Treat all logs as parts of one drive (split logs; power in a separate log).")
    msgdef: Location | None = option(None, MESSAGE_DEFINITIONS)
    shard: tuple[int, int] | None = option(
        None, "Be task I of N of an array job: ingest its share of the logs, by their names.", (), "shard", "I/N"
    )
    min_age: float = option(
        0.0,
        "Skip logs that were changed more recently than this (90, 90s, 10m, 2h, 1d); a number is seconds.",
        (),
        "duration",
        "T",
        shown="0",
    )
    retry_failed: bool = option(False, "Try logs again that failed before.")
    existing_store: bool = option(False, "Fail if there is no store, so that an unmounted one is not replaced.")
    force: bool = option(False, "Ingest all logs again, also those that failed before.")
    on_found: Callable[[Mapping[str, int]], None] | None = None
    """Called once with the size [byte] of every log by its name."""
    on_result: Callable[[IngestResult], None] | None = None
    """Called as each log ends, in the order of ending."""
    on_note: Callable[[str], None] | None = None
    """Called with a line before the first result: that the store is new."""


Files: TypeAlias = Location | Sequence[Location]
"""A file, a pattern of files such as ``dem/*.tif`` (by name), or several: tiles of one grid, the last on top."""


def _raster(about: str) -> Option:
    return Option(about, (), "several", "FILE", repeatable=True)


@dataclass(frozen=True, slots=True)
class AddMapOptions:
    """Which rasters become a map of a store; they need not share grid, resolution or CRS."""

    name: str = required(Option(is_argument=True))
    _: KW_ONLY
    height: Files | None = option(None, _raster("Height raster, metres; required."))
    ortho: Files | None = option(None, _raster("Orthophoto, grey or RGB."))
    terrain: Files | None = option(
        None, _raster("Terrain classes: one integer band, or GeoJSON polygons with a property 'class'.")
    )
    """The property is a class name, value or id."""
    classes: Location | None = option(
        None, "Class table: CSV with value,id,name,traversable, or TOML.", (), "input_file", "FILE"
    )
    """None: the store's, else the paper's seven classes. The first map with terrain or classes sets the table."""
    layer: Mapping[str, Files] | None = option(
        None, "Another raster of one band, as layer NAME; repeatable.", (), "layers", "NAME=FILE"
    )
    categorical: Mapping[str, Location | None] | None = option(
        None,
        "Layer NAME contains classes: named by FILE, like --classes, or by the raster itself.",
        (),
        "class_tables",
        "NAME[=FILE]",
    )
    """None: as the raster names its values."""
    ortho_bands: Literal["grey", "rgb"] = option(
        "grey", "rgb also keeps red, green and blue as layers.", (), ("grey", "rgb")
    )
    crs: str | None = option(
        None, "Projected, metric CRS of the map (default: the height's, or its UTM zone).", metavar="EPSG:n"
    )
    force: bool = option(False, "Replace a map of this name that has other inputs.")
    store: Location = option("tcpipe-store", STORE)


@dataclass(frozen=True, slots=True)
class BuildDatasetOptions:
    """Which runs and maps a dataset is made from, and how."""

    out: Location = option("dataset", kind="published", metavar="[OUT]", is_argument=True)
    """A new or empty directory, or one with a dataset of the same options; or a URL, where each build has a folder."""
    _: KW_ONLY
    split: Location | None = option(
        None, "GeoJSON region (WGS84): inside is train and test, outside is unseen.", (), "input_file", "FILE"
    )
    """None: everything is train and test."""
    map: str | Sequence[str] | None = option(
        None,
        "Map to sample from (default: the only one in the store); repeatable; where maps overlap, the first has priority.",
        (),
        "map",
        "NAME",
        repeatable=True,
    )
    robot: str | None = option(None, "Use only runs of this robot.", (), "robot", "NAME")
    tag: Mapping[str, str] | None = tags("Use only runs with this tag; if repeated, with all of the tags.")
    store: Location = option("tcpipe-store", STORE)
    recipe: Recipe | Location | None = option(None, RECIPE)
    jobs: int = jobs("Runs sampled")
    format: FileFormat = option("zarr", "Format of the patches.", kind=("zarr", "parquet"))
    holdout: str | None = option(
        None,
        "Unit that is held out for test: block, sample, run, or tag:NAME for values of a tag (default: from the recipe).",
        (),
        "holdout",
        "HOW",
    )
    covariates: Location | Sequence[Location] = option(
        (),
        "Table (CSV or Parquet) that is joined to the samples by time, such as weather or soil; repeatable.",
        (),
        "input_file",
        "FILE",
        repeatable=True,
    )
    seed: int | None = option(None, "Seed of split and row order (default: from the recipe).", (), SEED)
    min_runs: int | None = option(
        None,
        "Fail if fewer runs are usable; otherwise excluded and missing runs are notes.",
        (),
        Range(1, 1_000_000),
        "N",
    )
    labels: str | Sequence[str] = option(
        (),
        "Labels that every sample needs, comma-separated: energy, time, slip, vibration (default: energy if a run has power, else time).",
        metavar="LIST",
    )
    without_patches: bool = option(
        False, "Write samples without patches; also without a map (default if the store has none)."
    )
    without_coordinates: bool = option(
        False, "For publication: metres from an unstated origin, and no longitude, latitude, CRS, times or names."
    )
    force: bool = option(False, "Replace a dataset that was made with other options (region, map, tags, recipe …).")
    dry_run: bool = option(False, DRY_RUN)
