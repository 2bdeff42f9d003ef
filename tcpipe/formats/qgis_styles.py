"""Styles (QML) in which QGIS shows rasters."""

_COLOURS = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")
"""Viridis: from the least to the greatest, told apart by every eye and in grey."""
_HEAD = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n<qgis version=\"3.22.0\">\n"


def make_raster_style(band: int, low: float, high: float) -> str:
    """Return the style of a raster whose band, counted from 1, is coloured from the least value to the greatest."""
    step = (high - low) / (len(_COLOURS) - 1)
    stops = [(low + at * step, colour) for at, colour in enumerate(_COLOURS)]
    items = "".join(f'<item alpha="255" color="{colour}" value="{at!r}" label="{at:.4g}"/>' for at, colour in stops)
    shader = f'colorRampType="INTERPOLATED" classificationMode="1" minimumValue="{low!r}" maximumValue="{high!r}"'
    bounds = f'classificationMin="{low!r}" classificationMax="{high!r}"'
    return (
        f'{_HEAD}<pipe><rasterrenderer type="singlebandpseudocolor" band="{band}" opacity="1" {bounds}>'
        f"<rastershader><colorrampshader {shader}>{items}</colorrampshader></rastershader></rasterrenderer></pipe>\n</qgis>\n"
    )
