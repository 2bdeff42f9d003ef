"""The rasters of a map from a catalogue of open data: the newest that cover the tracks of runs, and only that part of them."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import MapError, UsageError, clean_lines, hide_secrets
from tcpipe.formats.maps.map_facts import RasterOrigin, origin_lines
from tcpipe.formats.maps.open_data import Catalogue, choose_newest, find_catalogue, find_items, make_area
from tcpipe.formats.maps.remote_geotiff import open_window
from tcpipe.pipeline.options import AddMapOptions
from tcpipe.store import Store, open_store
from tcpipe.tables.columns import to_floats

logger = logging.getLogger("tcpipe")

_WHOLE_FRACTION = 0.9995


@dataclass(frozen=True, slots=True)
class MapPlan:
    """What a catalogue of open data gives for a map; ``str`` of it is what ``--dry-run`` prints."""

    kind: Literal["plan"]
    name: str
    origins: tuple[RasterOrigin, ...]

    def __str__(self) -> str:
        """Return the rasters, their licence and what is to be read, as plain lines."""
        read = sum(of.to_read_bytes for of in self.origins) / 1e6
        return clean_lines((*origin_lines(self.origins), f"{read:.2f} MB to read, less what is in the cache"))


def plan_open_data(options: AddMapOptions) -> MapPlan:
    """Return what `tcpipe.add_map` with these options would take from its catalogue; only heads of rasters are read.

    Raises `UsageError`, `MapError`, `StoreError`: there is no catalogue, no run or no raster, or what there is cannot be used.
    """
    if options.stac is None:
        raise UsageError("--dry-run: says what --stac would take; give --stac, too")
    return fetch_open_data(options, open_store(options.store), None)[0]


def fetch_open_data(
    options: AddMapOptions, store: Store, directory: Path | None
) -> tuple[MapPlan, dict[str, list[Path]]]:
    """Write the windows of the rasters into a directory, if there is one; return what they are, and each layer's files, newest last."""
    catalogue = find_catalogue(str(options.stac))
    layers = _choose_collections(options, catalogue)
    area = make_area([_read_track(store, run_id) for run_id in _list_runs(options)], options.margin_m)
    client = catalogue.connect()
    origins: list[RasterOrigin] = []
    files: dict[str, list[Path]] = {layer: [] for layer in layers}
    for layer, collection in layers.items():
        items, covered = choose_newest(find_items(client, catalogue, collection, area), area)
        if covered < _WHOLE_FRACTION:
            logger.warning("%s covers %.1f %% of the ground around the tracks", collection, 100.0 * covered)
        for item in items:
            with open_window(client, item.url, area, crs=item.crs) as window:
                if window is None:
                    continue
                origins.append(
                    RasterOrigin(
                        layer=layer,
                        url=hide_secrets(item.url),
                        item=item.id,
                        date=item.date,
                        resolution=window.resolution,
                        vertical_datum=catalogue.collections[collection].vertical_datum,
                        licence=catalogue.licence,
                        to_read_bytes=window.to_read_bytes,
                        version=window.version,
                        checksum=item.checksum,
                    )
                )
                if directory is not None:
                    files[layer].append(
                        directory / f"{len(origins):04d}-{re.sub('[^A-Za-z0-9_.-]', '_', item.id)[:80]}.tif"
                    )
                    window.copy(files[layer][-1])
        if layer not in {of.layer for of in origins}:
            raise MapError(
                f"{collection}: no raster has a pixel around the tracks, but the catalogue says {len(items)} do"
            )
    return MapPlan("plan", options.name, tuple(origins)), files


def _choose_collections(options: AddMapOptions, catalogue: Catalogue) -> dict[str, str]:
    """Return the collection of each layer; `UsageError` where one is unknown, or a layer would come twice."""
    layers: dict[str, str] = {}
    for name in options.collections or catalogue.collections:
        if name not in catalogue.collections:
            raise UsageError(f"--collections {name}: not in the catalogue's entry ({', '.join(catalogue.collections)})")
        layer = catalogue.collections[name].layer
        if layer in layers or getattr(options, layer):
            other = layers.get(layer, f"--{layer}")
            raise UsageError(f"--collections: {other} and {name} both give {layer}; name the others with --collections")
        layers[layer] = name
    return layers


def _list_runs(options: AddMapOptions) -> list[str]:
    if not options.around:
        raise UsageError("--stac: name the runs that the map is to cover: --around RUN (tcpipe inspect lists them)")
    return [options.around] if isinstance(options.around, str) else list(options.around)


def _read_track(store: Store, run_id: str) -> NDArray[np.float64]:
    """Return the positions of a run, shape (N, 2): longitude and latitude [deg]."""
    runs = store.recipes_of(run_id)
    if not runs:
        raise UsageError(
            f"--around {run_id}: no finished run of that name in {store.root} (tcpipe inspect {store.root} lists them)"
        )
    table = runs[-1].table("track", ["lon_deg", "lat_deg"])
    lonlat = np.stack([to_floats(table, name) for name in ("lon_deg", "lat_deg")], axis=-1)
    lonlat = lonlat[np.isfinite(lonlat).all(axis=-1)]
    if not len(lonlat):
        raise MapError(f"--around {run_id}: its track has no geographic position (no GNSS)")
    return lonlat
