"""Tables that others wrote, as CSV, text in columns (TUM trajectories, RTKLIB's .pos) or Parquet: polars' lazy scan, columns by name.

A table of text is described by its first lines: what separates its fields, what its columns are called (`column_1` and so on where it has
no header), what is comment. A cell that is no number where one is wanted is counted, never guessed.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tcpipe.errors import LogError

TUM = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
"""Columns of a trajectory in the TUM format, which has no header; time in seconds, position in metres."""

_HEAD_BYTES = 1 << 16
_INFERRED_ROWS = 100
_COMMENT = re.compile(rb"[#%]")
_DAY_AND_TIME = re.compile(rb"^(\d{4})[/-](\d\d)[/-](\d\d)[ \t]+(?=\d\d:)", re.MULTILINE)
_SPACES = re.compile(rb"[ \t]+")
_EDGES = re.compile(rb"^ | (?=\r?$)", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Cells:
    """Columns that were read: numbers, NaN where there is none; ``stamp`` as it stands, or [ns since 1970] where it is a time in words.

    ``texts`` says by column how many cells hold something that is no number, and the first with its row (from 1); ``notes`` what the
    file's form shows.
    """

    stamp: NDArray[np.int64] | NDArray[np.float64]
    stamp_known: NDArray[np.bool_]
    stamp_is_time: bool
    columns: dict[str, NDArray[np.float64]]
    texts: dict[str, tuple[int, int, str]]
    notes: tuple[str, ...] = ()


def read_column_names(path: Path) -> list[str]:
    """Return what the columns of a table are called; `LogError` where it cannot be read."""
    return _scan(path).collect_schema().names()


def read_cells(path: Path, *, stamp: str, columns: list[str]) -> Cells:
    """Read a column of stamps and columns of numbers; every other column is passed over. `LogError`: the file cannot be read as a table."""
    wanted = list(dict.fromkeys(columns))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            frame = _collect_columns(path, [stamp, *(name for name in wanted if name != stamp)], numbers=wanted)
            stamps = frame[stamp]
            stamps = _parse_times(stamps) if stamps.dtype == pl.String else stamps
            if is_time := stamps.dtype.is_temporal():
                stamps = stamps.cast(pl.Datetime("ns")).cast(pl.Int64)
            numbers = {name: frame[name].cast(pl.Float64, strict=False) for name in wanted}
            texts = {
                name: odd for name in wanted if numbers[name].null_count() and (odd := _find_non_number(path, name))
            }
        except (pl.exceptions.PolarsError, OSError) as error:
            raise LogError(f"{path}: it cannot be read as a table ({str(error).splitlines()[0]})") from None
    whole = stamps.dtype.is_integer()
    made = stamps.cast(pl.Int64 if whole else pl.Float64, strict=False)
    return Cells(
        made.fill_null(0).to_numpy(),
        (made.is_not_null() & made.is_finite()).to_numpy() if not whole else made.is_not_null().to_numpy(),
        is_time,
        {name: values.fill_null(np.nan).to_numpy() for name, values in numbers.items()},
        texts,
        tuple(dict.fromkeys(f"{path.name}: {str(line.message).splitlines()[0]}" for line in said)),
    )


def _collect_columns(path: Path, columns: list[str], numbers: list[str] | None) -> pl.DataFrame:
    """Return columns of a table; a quote that nothing closes (a log that broke off) costs its own line only."""
    try:
        return _scan(path, numbers).select(columns).collect()
    except pl.exceptions.ComputeError:
        return _scan(path, numbers, quote=None).select(columns).collect()


def _parse_times(texts: pl.Series) -> pl.Series:
    """Return texts as times; where they are none, null: ISO 8601 with and without a zone, UTC where none is told."""
    for zone in ("", "%#z"):
        for between in ("T", " "):
            found = texts.str.to_datetime(f"%Y-%m-%d{between}%H:%M:%S%.f{zone}", time_unit="ns", strict=False)
            if found.null_count() <= len(found) // 2:
                return found.dt.convert_time_zone("UTC").dt.replace_time_zone(None) if zone else found
    return texts.cast(pl.Float64, strict=False)


def _find_non_number(path: Path, name: str) -> tuple[int, int, str] | None:
    """Return how many cells of a column hold what is no number, and the row (from 1) and text of the first."""
    texts = _collect_columns(path, [name], numbers=None)[name].cast(pl.String)
    odd = texts.is_not_null() & (texts.str.strip_chars() != "") & texts.cast(pl.Float64, strict=False).is_null()
    rows = odd.arg_true()
    return (len(rows), int(rows[0]) + 1, str(texts[int(rows[0])])) if len(rows) else None


def _scan(path: Path, numbers: list[str] | None = None, *, quote: str | None = '"') -> pl.LazyFrame:
    """Return a table's lazy frame, with ``numbers`` read as such; None reads every cell of a text as it stands."""
    if path.suffix == ".parquet":
        return pl.scan_parquet(path)
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        raise LogError(f"{path}: it cannot be read ({error.strerror})") from None
    comments, lines = _split_comment_lines(head)
    if not lines:
        raise LogError(f"{path}: it contains no table: it is empty")
    separator = next((sign for sign in (b",", b";", b"\t") if sign in lines[0]), b" ")
    first = (_DAY_AND_TIME.sub(rb"\1-\2-\3T", lines[0]) if separator == b" " else lines[0]).split(
        None if separator == b" " else separator
    )
    names = None if any(map(_is_name, first)) else _find_column_names(comments, len(first), spaced=separator == b" ")
    source: Path | BytesIO = path
    if separator == b" ":  # several of them are one
        text = _SPACES.sub(b" ", _DAY_AND_TIME.sub(rb"\1-\2-\3T", path.read_bytes().replace(b"\r", b"")))
        source = BytesIO(_EDGES.sub(b"", text))
    return pl.scan_csv(
        source,
        separator=separator.decode(),
        quote_char=quote,
        has_header=names is None,
        with_column_names=None if names is None else lambda _: names,
        comment_prefix=comments[0][:1].decode() if comments else None,
        decimal_comma=separator == b";" and any(b"," in line for line in lines[1:2]),
        schema_overrides=dict.fromkeys(numbers, pl.Float64) if numbers and names is None else None,
        infer_schema=numbers is not None,
        infer_schema_length=_INFERRED_ROWS,
        ignore_errors=True,
        truncate_ragged_lines=True,
    )


def _split_comment_lines(head: bytes) -> tuple[list[bytes], list[bytes]]:
    """Return the first lines that are comments, and those that are not."""
    lines = [line.strip() for line in head.splitlines() if line.strip()]
    count = next((at for at, line in enumerate(lines) if not _COMMENT.match(line)), len(lines))
    return lines[:count], lines[count:]


def _is_name(field: bytes) -> bool:
    """Return whether a field of the first line is a name: no number, no time, and not empty."""
    text = field.strip().strip(b'"')
    try:
        float(text or b"0")
    except ValueError:
        return not re.match(rb"\d{4}[-/]\d\d[-/]\d\d|\d\d:\d\d", text)
    return False


def _find_column_names(comments: list[bytes], count: int, *, spaced: bool) -> list[str]:
    """Return the names of a table without a header: those of its last comment where they are as many, TUM's, or numbers."""
    told = comments[-1].lstrip(b"#% ").replace(b",", b" ").split() if comments else []
    if len(told) == count:
        return [name.decode(errors="replace") for name in told]
    if spaced and count == len(TUM):
        return list(TUM)
    return [f"column_{number}" for number in range(1, count + 1)]
