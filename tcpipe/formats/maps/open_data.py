"""Catalogues of open data (STAC): which items cover a track, and which of these are newest.

What tcpipe knows of a catalogue is in a TOML file: those beside this module, or the user's. What a catalogue replies is not trusted.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlencode, urljoin, urlsplit

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Geometry
from shapely.geometry import shape

from tcpipe.errors import MapError, StoreError, UsageError
from tcpipe.formats.https import HttpsClient
from tcpipe.formats.json_files import MOST_BYTES, parse_json
from tcpipe.formats.recipe_toml import parse_toml
from tcpipe.recipe.checking import from_values

_MOST_READ_BYTES = 4_000_000_000
_MOST_FILE_BYTES = 100_000
_PAGE_ITEMS, _MOST_PAGES = 100, 50
_METRES_PER_DEG = 111_320.0
_SIMPLER_M = 0.5
_NEW_GROUND_FRACTION = 1e-3
"""An older item is read if it adds this share of the area: outlines of one tile differ by centimetres from year to year."""


@dataclass(frozen=True, slots=True)
class Collection:
    """One collection of a catalogue that can become a layer."""

    layer: Literal["height", "ortho"]
    vertical_datum: str | None = None
    """What its heights refer to, with the EPSG code if there is one."""
    asset: str = "*"
    """Pattern of the asset's key, where an item has several GeoTIFFs and does not tell their resolutions."""


@dataclass(frozen=True, slots=True)
class Catalogue:
    """A STAC API, and what it does not tell itself."""

    stac: str
    """Its URL, without /collections."""
    licence: str
    """What the licence demands, and where it can be read."""
    collections: dict[str, Collection]
    """By id."""
    hosts: list[str] = field(default_factory=list)
    """Other hosts that its rasters are on, name or name:port."""

    def connect(self) -> HttpsClient:
        """Return a client that asks the catalogue's own host and `hosts` only."""
        return HttpsClient([urlsplit(self.stac).netloc, *self.hosts], most_bytes=_MOST_READ_BYTES)


@dataclass(frozen=True, slots=True)
class Item:
    """One raster of a collection, as its catalogue has it."""

    id: str
    url: str
    date: str
    """When it was surveyed, ISO 8601; of a span its end; empty where it is not told."""
    crs: str | None
    checksum: str | None
    footprint: Geometry = field(repr=False)
    """In longitude and latitude [deg]."""


def find_catalogue(stac: str) -> Catalogue:
    """Return a catalogue by its name, its URL or its TOML file; `UsageError`: it is not known, or the file is wrong."""
    if stac.endswith(".toml"):
        try:
            with Path(stac).open(encoding="utf-8") as file:
                return from_values(Catalogue, parse_toml(file.read(_MOST_FILE_BYTES)), where=stac)
        except (OSError, ValueError) as error:
            raise UsageError(f"{stac}: cannot be read as TOML ({error})") from None
    shipped = {
        file.name.removesuffix(".toml"): from_values(
            Catalogue, parse_toml(file.read_text(encoding="utf-8")), where=file.name
        )
        for file in files("tcpipe.formats.maps").iterdir()
        if file.name.endswith(".toml")
    }
    for name, known in shipped.items():
        if stac.rstrip("/") in {name, known.stac}:
            return known
    listed = ", ".join(sorted(shipped))
    raise UsageError(
        f"--stac {stac}: not known (known: {listed}); describe it in a TOML file: docs/how-to/your-maps.md#open-data"
    )


def make_area(tracks: Sequence[NDArray[np.float64]], margin_m: float) -> Geometry:
    """Return the ground around tracks, each (N, 2) longitude and latitude [deg], in these; the margin is right to 2 %."""
    parts = []
    for lonlat in tracks:
        middle = (lonlat.min(axis=0) + lonlat.max(axis=0)) / 2.0
        scale = _METRES_PER_DEG * np.array([np.cos(np.radians(middle[1])), 1.0])
        line = shapely.simplify(shapely.linestrings((np.vstack([lonlat, lonlat[-1:]]) - middle) * scale), _SIMPLER_M)
        parts.append(shapely.transform(shapely.buffer(line, margin_m), lambda xy, at=middle, by=scale: xy / by + at))
    return shapely.union_all(parts)


def find_items(client: HttpsClient, catalogue: Catalogue, collection: str, area: Geometry) -> list[Item]:
    """Return the items of a collection with a GeoTIFF that touch an area; `MapError`: there are none, or no catalogue replies."""
    query = urlencode({"bbox": ",".join(f"{bound:.7f}" for bound in area.bounds), "limit": _PAGE_ITEMS})
    url = f"{catalogue.stac.rstrip('/')}/collections/{collection}/items?{query}"
    found: dict[str, Item] = {}
    for _ in range(_MOST_PAGES):
        data, _ = client.get(url, most=MOST_BYTES)
        try:
            page: Any = parse_json(data, url)
            items = list(_iterate_items(page, url, catalogue.collections[collection].asset))
            found |= {item.id: item for item in items if item.footprint.intersects(area)}
            links = {link["rel"]: link["href"] for link in page.get("links", ())}
        except (StoreError, LookupError, TypeError, ValueError, AttributeError, shapely.errors.ShapelyError) as error:
            raise MapError(
                f"{url}: expected GeoJSON of STAC items, got something else ({type(error).__name__}: {error})"
            ) from None
        if "next" not in links:
            break
        url = urljoin(url, links["next"])
    else:
        raise MapError(
            f"{url}: more than {_MOST_PAGES} pages of items around the tracks; name fewer runs with --around"
        )
    if not found:
        raise MapError(f"{url}: no item with a GeoTIFF around the tracks; {collection} may not cover the site")
    return list(found.values())


def _iterate_items(page: Any, url: str, pattern: str) -> Iterator[Item]:
    """Yield the items of a page, each with its finest GeoTIFF."""
    for item in page["features"]:
        about, name = item["properties"], item["id"]
        assets = {
            key: asset for key, asset in item["assets"].items() if _is_geotiff(asset) and fnmatchcase(key, pattern)
        }
        sizes = {key: asset.get("gsd") or asset.get("eo:gsd") for key, asset in assets.items()}
        if len(assets) > 1 and None in sizes.values():
            raise MapError(
                f"{url}: item {name} has the GeoTIFFs {', '.join(assets)}, and does not tell which is finest (gsd); "
                'choose by asset = "PATTERN" below the collection in a TOML file for --stac'
            )
        for key in sorted(assets, key=lambda key: float(sizes[key] or 0.0))[:1]:
            raster = {**about, **assets[key]}
            code = raster.get("proj:code") or raster.get("proj:epsg")
            yield Item(
                id=str(name),
                url=urljoin(url, str(raster["href"])),
                date=str(about.get("datetime") or about.get("end_datetime") or ""),
                crs=f"EPSG:{code}" if isinstance(code, int) else code,
                checksum=raster.get("file:checksum") or raster.get("checksum:multihash"),
                footprint=shapely.make_valid(shape(item["geometry"])),
            )


def _is_geotiff(asset: Mapping[str, Any]) -> bool:
    is_tiff = str(asset.get("type", asset["href"])).lower().startswith("image/tiff") or (
        "type" not in asset and urlsplit(asset["href"]).path.lower().endswith((".tif", ".tiff"))
    )
    return is_tiff and not {"thumbnail", "overview"} & {*asset.get("roles", ())}


def choose_newest(items: Sequence[Item], area: Geometry) -> tuple[list[Item], float]:
    """Return the newest items that together cover what there is of an area, the newest last, and the share that they cover."""
    chosen: list[Item] = []
    missing = area
    for item in sorted(items, key=lambda item: (item.date, item.id), reverse=True):
        left = missing.difference(item.footprint)
        if missing.area - left.area > _NEW_GROUND_FRACTION * area.area:
            chosen.insert(0, item)
            missing = left
    return chosen, 1.0 - missing.area / area.area
