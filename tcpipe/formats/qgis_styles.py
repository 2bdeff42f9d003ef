"""Styles as QGIS reads them (QML): beside a raster by its name, or in the table ``layer_styles`` of a GeoPackage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Literal
from xml.sax.saxutils import quoteattr

VIRIDIS = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")
"""From the least to the greatest, told apart by every eye and in grey."""

Shape = Literal["line", "fill"]
_HEAD = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n<qgis version=\"3.22.0\">\n"


def make_classes_style(attribute: str, colours: Mapping[str, str], shape: Shape) -> str:
    """Return the style of a vector layer that has a colour for each value of a column."""
    values = [
        f'<category render="true" symbol="{at}" value={quoteattr(of)} label={quoteattr(of)}/>'
        for at, of in enumerate(colours)
    ]
    return _make_vector_style(
        f'type="categorizedSymbol" attr={quoteattr(attribute)}', "categories", values, list(colours.values()), shape
    )


def make_ranges_style(attribute: str, edges: Sequence[float], shape: Shape) -> str:
    """Return the style of a vector layer that has a colour for each range of a column; six edges bound the five ranges."""
    ranges = [
        f'<range render="true" symbol="{at}" lower="{low!r}" upper="{high!r}" label="{low:.4g} - {high:.4g}"/>'
        for at, (low, high) in enumerate(pairwise(edges))
    ]
    return _make_vector_style(f'type="graduatedSymbol" attr={quoteattr(attribute)}', "ranges", ranges, VIRIDIS, shape)


def make_raster_style(band: int, low: float, high: float) -> str:
    """Return the style of a raster whose band, counted from 1, is coloured from the least value to the greatest."""
    step = (high - low) / (len(VIRIDIS) - 1)
    stops = [(low + at * step, colour) for at, colour in enumerate(VIRIDIS)]
    items = "".join(f'<item alpha="255" color="{colour}" value="{at!r}" label="{at:.4g}"/>' for at, colour in stops)
    shader = f'colorRampType="INTERPOLATED" classificationMode="1" minimumValue="{low!r}" maximumValue="{high!r}"'
    bounds = f'classificationMin="{low!r}" classificationMax="{high!r}"'
    return (
        f'{_HEAD}<pipe><rasterrenderer type="singlebandpseudocolor" band="{band}" opacity="1" {bounds}>'
        f"<rastershader><colorrampshader {shader}>{items}</colorrampshader></rastershader></rasterrenderer></pipe>\n</qgis>\n"
    )


def _make_vector_style(renderer: str, groups: str, entries: Sequence[str], colours: Sequence[str], shape: Shape) -> str:
    symbols = "".join(_make_symbol(at, colour, shape) for at, colour in enumerate(colours))
    told = f"<{groups}>{''.join(entries)}</{groups}><symbols>{symbols}</symbols>"
    return f'{_HEAD}<renderer-v2 {renderer} symbollevels="0" forceraster="0">{told}</renderer-v2>\n</qgis>\n'


def _make_symbol(name: int, colour: str, shape: Shape) -> str:
    rgb = ",".join(str(int(colour[at : at + 2], 16)) for at in (1, 3, 5))
    line = {"line_color": f"{rgb},255", "line_width": "0.8", "line_style": "solid"}
    fill = {
        "color": f"{rgb},60",
        "style": "solid",
        "outline_color": f"{rgb},255",
        "outline_width": "0.3",
        "outline_style": "solid",
    }
    kind, wanted = ("SimpleLine", line) if shape == "line" else ("SimpleFill", fill)
    options = "".join(f'<Option type="QString" name="{key}" value="{value}"/>' for key, value in wanted.items())
    layer = f'<layer class="{kind}" pass="0" locked="0" enabled="1"><Option type="Map">{options}</Option></layer>'
    return f'<symbol type="{shape}" name="{name}" alpha="1" clip_to_extent="1">{layer}</symbol>'
