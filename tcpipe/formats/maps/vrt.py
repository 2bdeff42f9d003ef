"""GDAL's virtual rasters (VRT, XML), taken apart and put together anew, so that GDAL never sees what another has written.

A VRT names other files, and GDAL opens whatever they are: anything on the disk, anything on the network. Here a VRT is a list of rasters
at or below its own folder, and nothing else: elements and attributes that are known to name no file pass, the others are refused, and
what names a file is followed, checked and written with its real place. GDAL reads names of elements and attributes in any case and takes
one for the other; so do the two lists.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from io import StringIO
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, iterparse, tostring

from tcpipe.errors import MapError

MAX_BYTES = 32_000_000
"""Of a VRT, and of one with all VRTs in it; 20,000 tiles of three bands."""

MAX_TAGS = 2_000_000
MAX_SOURCES = 100_000
_MAX_DEPTH = 32
_MAX_NESTING = 8

_FILES = {"sourcefilename", "sourcedataset"}
"""Elements whose text is a file's name."""

_SUBCLASSES = {
    "vrtwarpeddataset", "vrtpansharpeneddataset",
    "vrtsourcedrasterband", "vrtwarpedrasterband", "vrtpansharpenedrasterband", "vrtderivedrasterband",
}  # fmt: skip
"""Raw bands (bytes of any file) and processed datasets (steps that name files) are not among them."""

_ELEMENTS = {
    "vrtdataset", "srs", "geotransform", "gcplist", "gcp", "vrtrasterband", "maskband", "overview", "overviewlist",
    "colorinterp", "colortable", "entry", "nodatavalue", "hidenodatavalue", "description", "unittype", "offset", "scale",
    "categorynames", "category", "gdalrasterattributetable", "fielddefn", "name", "type", "usage", "row", "f",
    "simplesource", "complexsource", "averagedsource", "kernelfilteredsource", "nodatafrommasksource", "kernel", "size", "coefs",
    "sourceband", "sourceproperties", "srcrect", "dstrect", "nodata", "usemaskband", "scaleratio", "scaleoffset", "lut", "exponent",
    "srcmin", "srcmax", "dstmin", "dstmax", "clamp", "colortablecomponent", "maskvaluethreshold", "remappedvalue",
    "pixelfunctiontype", "sourcetransfertype", "blockxsize", "blockysize",
    "gdalwarpoptions", "warpmemorylimit", "resamplealg", "workingdatatype", "option", "options", "srcalphaband",
    "dstalphaband", "transformer",
    "approxtransformer", "maxerror", "basetransformer", "genimgprojtransformer", "srcgeotransform", "srcinvgeotransform",
    "dstgeotransform", "dstinvgeotransform", "reprojecttransformer", "reprojectiontransformer", "sourcesrs", "targetsrs", "reversed",
    "bandlist", "bandmapping", "srcnodatareal", "srcnodataimag", "dstnodatareal", "dstnodataimag",
    "pansharpeningoptions", "algorithm", "algorithmoptions", "weights", "resampling", "numthreads", "bitdepth",
    "spatialextentadjustment", "panchroband", "spectralband",
    *_FILES,
}  # fmt: skip

_ATTRIBUTES = {
    "rasterxsize", "rasterysize", "subclass", "datatype", "band", "blockxsize", "blockysize", "key", "domain", "format", "name",
    "relativetovrt", "shared", "xoff", "yoff", "xsize", "ysize", "dataaxistosrsaxismapping", "coordinateepoch", "c1", "c2", "c3", "c4",
    "index", "tabletype", "resampling", "normalized", "projection", "id", "pixel", "line", "x", "y", "z", "info", "dstband", "src", "dst",
    "bandlist", "row0min", "binsize",
}  # fmt: skip


_DROPPED = {"metadata", "histograms"}
"""Elements that say nothing a map is made from, and may hold anything."""

_CRS = re.compile(r"\s*(?:[A-Z][A-Z0-9_]*\[|(?:EPSG|ESRI|OGC|IGNF|IAU_2015):\w+\s*\Z|\Z)")
"""A CRS as WKT or by its code; GDAL would take a file or an address too."""


def is_vrt(head: bytes) -> bool:
    """Return whether a file that begins so is a VRT."""
    return root_name(head) == "VRTDataset"


def root_name(head: bytes) -> str | None:
    """Return the first element's name if a file that begins so is XML, else None."""
    text = head.removeprefix(b"\xef\xbb\xbf").decode("utf-8", "replace")
    found = re.match(r"\s*(?:<\?[^>]*\?>\s*|<!--.*?-->\s*)*<([A-Za-z_][\w:.-]*)", text, flags=re.DOTALL)
    return found[1] if found else None


def checked_vrt(path: Path, source: Callable[[Path, int], str | None], *, nesting: int = 0) -> str:
    """Return a VRT as a document that GDAL may open: it names only rasters that are known, by their real places.

    Parameters
    ----------
    path : the VRT.
    source : checks one file that it names, and returns its document if that is a VRT too (``nesting`` is handed on), None if not.
    nesting : how many VRTs this one lies in.

    Raises
    ------
    MapError : it is damaged, beyond the bounds, names a file elsewhere, or does more than lay rasters side by side.
    """
    if nesting > _MAX_NESTING:
        raise MapError(f"{path}: VRTs in VRTs, more than {_MAX_NESTING} deep{_mended(path)}")
    root = _parsed(path)
    found: dict[str, str] = {}
    names = 0
    for element in root.iter():
        element[:] = [child for child in element if child.tag.lower() not in _DROPPED]
    for element in root.iter():
        _refuse_unknown(element, path)
        if element.tag.lower() in _FILES:
            names += 1
            if names > MAX_SOURCES:
                raise MapError(f"{path}: names more than {MAX_SOURCES} files{_mended(path)}")
            given = _name(element)
            if given not in found:
                place = _place(path, *given.split("\n", 1))
                found[given] = source(place, nesting + 1) or str(place)
            element.attrib.clear()
            element.set("relativeToVRT", "0")
            element[:] = []
            element.text = found[given]
    document = tostring(root, encoding="unicode")
    if len(document) > MAX_BYTES:
        raise MapError(f"{path}: more than {MAX_BYTES // 10**6} MB with the VRTs in it{_mended(path)}")
    return document


def _parsed(path: Path) -> Element:
    """Return the tree; without a document type (entities could be anything) and not nested deeper than any real one."""
    if path.stat().st_size > MAX_BYTES:
        raise MapError(
            f"{path}: a VRT of {path.stat().st_size / 1e6:.0f} MB, at most {MAX_BYTES // 10**6}{_mended(path)}"
        )
    try:
        text = re.sub(r"\A\s*<\?xml[^>]*\?>", "", path.read_bytes().decode("utf-8-sig"))
        if "<!DOCTYPE" in text:
            raise MapError(f"{path}: a VRT with a document type{_mended(path)}")
        if text.count("<") > MAX_TAGS:
            raise MapError(f"{path}: a VRT of {text.count('<')} tags, at most {MAX_TAGS}{_mended(path)}")
        root, depth = Element(""), 0
        events = iterparse(StringIO(text), ["start", "end"])  # noqa: S314  without entities, and never too deep
        for event, element in events:
            root, depth = element, depth + (1 if event == "start" else -1)
            if depth > _MAX_DEPTH:
                raise MapError(f"{path}: XML nested more than {_MAX_DEPTH} deep{_mended(path)}")
    except (ParseError, UnicodeDecodeError) as error:
        raise MapError(f"{path}: a VRT that is damaged: {error}") from None
    return root


def _refuse_unknown(element: Element, path: Path) -> None:
    """Refuse an element or attribute that may name a file or a program."""
    if element.tag.lower() not in _ELEMENTS:
        raise MapError(f"{path}: a VRT with <{element.tag}>, which is not followed{_mended(path)}")
    for name, value in element.attrib.items():
        if name.lower() not in _ATTRIBUTES:
            raise MapError(f"{path}: a VRT with {name}= in <{element.tag}>, which is not followed{_mended(path)}")
        if name.lower() == "subclass" and value.lower() not in _SUBCLASSES:
            raise MapError(f"{path}: a VRT with a {value}, which is not followed{_mended(path)}")
    crs = element.attrib.get("Projection", element.text if element.tag.lower().endswith("srs") else "")
    if not _CRS.match(crs or ""):
        raise MapError(f"{path}: a VRT with the CRS {(crs or '')[:80]!r}, wanted WKT or EPSG:n{_mended(path)}")


def _name(element: Element) -> str:
    """Return ``1`` or ``0``, whether a name is relative to the VRT, a line feed, and the name."""
    attributes = {name.lower(): value for name, value in element.attrib.items()}
    return (
        f"{int(attributes.get('relativetovrt', '0').strip() not in {'0', ''})}\n{''.join(element.itertext()).strip()}"
    )


def _place(path: Path, relative: str, name: str) -> Path:
    """Return the real place of a file that a VRT names."""
    folder = path.resolve().parent
    try:
        place = ((folder if relative == "1" else Path.cwd()) / name).resolve()
        there = place.is_file()
    except (OSError, ValueError, RuntimeError):  # too long, a NUL, a circle of links
        there = False
    if name and there and place.is_relative_to(folder):
        return place
    why = "is not at or below its own folder" if name and there else "is no file at or below its own folder"
    shown = name if len(name) < 80 else f"{name[:80]}…"
    raise MapError(f"{path}: {shown!r}, which it names, {why}{_mended(path, copy=True)}")


def _mended(path: Path, *, copy: bool = False) -> str:
    written = f"write it out: gdal_translate {path.name} out.tif"
    return f"; put its files there (gdalbuildvrt {path.name} *.tif), or {written}" if copy else f"; {written}"
