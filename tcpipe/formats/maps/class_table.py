"""Class tables as people write them: CSV ``value,id,name,traversable``, or the same as TOML.

::

    value,id,name,traversable          [[class]]
    11,1,water,no                      value = 11            # or a list: several values, one id
    40,2,grass,yes                     id = 2
                                       name = "grass"
                                       traversable = true
"""

from __future__ import annotations

import csv
from io import StringIO
from pathlib import Path
from typing import Any

from tcpipe.errors import MapError
from tcpipe.formats.toml_text import parse_toml
from tcpipe.terrain.classes import MAX_ID, ClassScheme, ClassTable, TerrainClass

MAX_BYTES = 2_000_000
"""Of a class table: every value of 16 bits, and to spare."""

_SHOWN = 20
_INT64 = 2**63

_COLUMNS = ("value", "id", "name", "traversable")
_TRUTH = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


def read_class_scheme(path: Path) -> ClassScheme:
    """Read a class table and the raster values of its classes.

    Raises
    ------
    MapError : the file cannot be read, or breaks its contract: one problem a wrong line, all at once.
    """
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise MapError(
                f"{path}: a class table of {size / 1e6:.1f} MB, at most {MAX_BYTES // 10**6}: {MAX_ID} classes and their values"
            )
        text = path.read_text(encoding="utf-8-sig")
        rows = _toml_rows(text) if path.suffix.lower() == ".toml" else _csv_rows(text, path)
    except (OSError, ValueError, csv.Error) as error:
        raise MapError(f"{path}: the class table cannot be read ({error})") from error
    problems: list[str] = []
    classes: dict[int, TerrainClass] = {}
    id_by_value: dict[int, int] = {}
    for where, row in rows:
        found = _entry(row, f"{path}: {where}", problems)
        if found is None:
            continue
        values, entry = found
        if classes.setdefault(entry.id, entry) != entry:
            problems.append(f"{path}: {where}: id {entry.id} was {classes[entry.id]} before, now {entry}")
        taken = [value for value in values if id_by_value.setdefault(value, entry.id) != entry.id]
        problems += [f"{path}: {where}: value {value} stands for id {id_by_value[value]} already" for value in taken]
    if not classes and not problems:
        problems.append(f"{path}: the class table has no classes (wanted columns {','.join(_COLUMNS)})")
    if problems:
        raise MapError(
            *problems[:_SHOWN], *([f"{path}: … and {len(problems) - _SHOWN} more"] if len(problems) > _SHOWN else [])
        )
    return ClassScheme(ClassTable(tuple(classes[key] for key in sorted(classes))), dict(sorted(id_by_value.items())))


def _csv_rows(text: str, path: Path) -> list[tuple[str, dict[str, Any]]]:
    reader = csv.DictReader(StringIO(text, newline=""), skipinitialspace=True)
    missing = [name for name in _COLUMNS if name not in (reader.fieldnames or ())]
    if missing:
        raise MapError(f"{path}: line 1: columns {','.join(missing)} are missing (wanted {','.join(_COLUMNS)})")
    return [(f"line {reader.line_num}", row) for row in reader]


def _toml_rows(text: str) -> list[tuple[str, dict[str, Any]]]:
    rows = parse_toml(text).get("class", [])
    return [(f"class {number}", row) for number, row in enumerate(rows if isinstance(rows, list) else [rows], 1)]


def _entry(row: Any, where: str, problems: list[str]) -> tuple[list[int], TerrainClass] | None:
    before = len(problems)
    if not isinstance(row, dict):
        problems.append(f"{where}: wanted a table with {', '.join(_COLUMNS)}")
        return None
    problems += [f"{where}: {name} is missing" for name in _COLUMNS if row.get(name) in (None, "")]
    problems += [
        f"{where}: {name!r} is not a column (wanted {', '.join(_COLUMNS)})" for name in row if name not in _COLUMNS
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
        problems.append(f"{where}: name {name!r} holds characters that cannot be printed")
        return None
    return [value for value in values if value is not None], TerrainClass(class_id, name, traversable=traversable)


def _integer(value: Any) -> int | None:
    if isinstance(value, bool):
        return None
    try:
        number = int(str(value).strip())
    except ValueError:
        return None
    return number if -_INT64 <= number < _INT64 else None
