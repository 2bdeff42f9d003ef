"""What a raster says its values mean: its raster attribute table, or its category names."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree.ElementTree import Element, fromstring

_VALUE_USAGES = ("5", "3")
"""GDAL's GFU_MinMax, GFU_Min: the column that holds the value (or where a range of values begins)."""
_UPPER_USAGE = "4"
_NAME_USAGE = "2"
_STRING_TYPE = "2"
_NAME_TITLES = ("class name", "classname", "class names", "class", "name", "label", "category", "terrain")


def read_value_names(vrt: str, band: int) -> dict[int, str]:
    """Return names by value of a band, from 1, by a VRT document that GDAL wrote of a raster; those of the attribute table come first."""
    root = fromstring(vrt)  # noqa: S314  GDAL wrote it
    described = root.find(f"./VRTRasterBand[@band='{band}']")
    if described is None:
        return {}
    table = described.find("GDALRasterAttributeTable")
    names = {} if table is None else _read_table_names(table)
    return names or _read_category_names(described)


def _read_category_names(described: Element) -> dict[int, str]:
    names = [(entry.text or "").strip() for entry in described.findall("./CategoryNames/Category")]
    return {value: name for value, name in enumerate(names) if name}


def _read_table_names(table: Element) -> dict[int, str]:
    columns = [
        tuple((column.findtext(tag) or "").strip() for tag in ("Name", "Type", "Usage"))
        for column in table.findall("FieldDefn")
    ]
    titles = [" ".join(title.casefold().replace("_", " ").split()) for title, _, _ in columns]
    values = [n for usage in _VALUE_USAGES for n, column in enumerate(columns) if column[2] == usage]
    values += [n for n, title in enumerate(titles) if title == "value"]
    texts = [n for n, column in enumerate(columns) if column[1] == _STRING_TYPE]
    named = [n for n in texts if columns[n][2] == _NAME_USAGE]
    named += sorted((n for n in texts if titles[n] in _NAME_TITLES), key=lambda n: _NAME_TITLES.index(titles[n]))
    named += texts if len(texts) == 1 else []
    if not values or not named:
        return {}
    uppers = [n for n, column in enumerate(columns) if column[2] == _UPPER_USAGE]
    rows = [[(cell.text or "").strip() for cell in row.findall("F")] for row in table.findall("Row")]
    found = ((_parse_single_value(row, values[0], uppers), row[named[0]]) for row in rows if len(row) == len(columns))
    return {value: name for value, name in found if value is not None and name}


def _parse_single_value(row: Sequence[str], column: int, uppers: Sequence[int]) -> int | None:
    """Return the one integer that a row is about; None where it is about a range or a fraction."""
    try:
        value = float(row[column])
        upper = float(row[uppers[0]]) if uppers else value
    except ValueError:
        return None
    return int(value) if value == upper and value.is_integer() else None
