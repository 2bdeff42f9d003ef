"""A folder of tables as a log: each mapped table is a topic, and its rows are messages of the type usual for its role.

It has the interface of a bag: topics, tables of messages, damage. All tables are read when the log is opened, because
they are small compared with a bag.

Tables are CSV files, text in columns (TUM trajectories, RTKLIB's .pos) or Parquet; polars scans them lazily. The first
lines of a text table determine its separator, the names of its columns (`column_1` and so on without a header), and its
comments. Cells that should be numbers and are not are counted.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import polars as pl

from tcpipe.arrays import Floats
from tcpipe.errors import LogError
from tcpipe.formats.logs.message_tables import Fields, TableLog, TopicMessages, make_stamp_fields, make_topic
from tcpipe.formats.logs.table_folders import TABLE_SUFFIXES, Mappings, is_table, list_table_files
from tcpipe.formats.logs.table_stamps import Clock, find_stamps
from tcpipe.logs.field_mapping import FieldSource, find_mapping_problems, find_topic, make_message_fields, read_fields
from tcpipe.logs.topics import Damage
from tcpipe.power.sources import FLOAT_TYPES
from tcpipe.recipe import TableMapping


def open_tables(path: Path, mappings: Mappings, files: Sequence[Path] | None = None) -> TableLog:
    """Read the mapped tables of a folder; ``files`` are the files of the log, by default all tables.

    `LogError` has a line for each contradiction between the mapping and the folder.
    """
    problems: list[str] = []
    read: list[TopicMessages] = []
    zone = next((mapping.stamp_zone for mapping in mappings.values() if mapping.stamp_zone), "")
    for name, mapping in mappings.items():
        table = _read_table(path, name, mapping, mapping.stamp_zone or zone)
        if isinstance(table, TopicMessages):
            read.append(table)
        else:
            problems += table
    problems += _find_clock_mismatch(read)
    if problems:
        raise LogError(*(f"{path}: {problem}" for problem in problems))
    return TableLog(path, "tables", read, list_table_files(path) if files is None else files)


def _read_table(folder: Path, name: str, mapping: TableMapping, zone: str) -> TopicMessages | list[str]:
    """Return a table's messages, or all problems of its mapping; ``zone`` is the zone of times without one, or ""."""
    where = f"recipe tables.{name}"
    role = mapping.role or name
    problems = list(find_mapping_problems(where, role, mapping.columns, mapping.units))
    path = folder / mapping.file
    if not is_table(mapping.file):
        problems.append(f"{where}.file is {mapping.file!r}; expected a name that ends in {', '.join(TABLE_SUFFIXES)}")
    elif not path.is_file():
        present = ", ".join(str(file.relative_to(folder)) for file in list_table_files(folder)[:20])
        problems.append(
            f"{where}.file: there is no {mapping.file} here; there are {present or 'no tables at all'}. "
            f"Add it, or ingest this run with a recipe without tables.{name}"
        )
    if problems:
        return problems
    try:
        names = read_table_header(path)
        stamp = names[0] if mapping.stamp is None else mapping.stamp
        fields = read_fields(f"{where}.columns", role, mapping.columns, mapping.units, names)
        problems = [f"{problem} ({mapping.file})" for problem in fields] if isinstance(fields, list) else []
        problems += [
            f"{where}.{key}: {mapping.file} has no column {column}; it has {', '.join(names)}"
            for key, column in (("stamp", stamp), ("stamp_utc", mapping.stamp_utc))
            if column and column not in names
        ]
        if isinstance(fields, list) or problems:
            return problems
        stamp_columns = (stamp, mapping.stamp_utc, mapping.stamp_date)
        cells, values = read_column_values(
            path, [column for column in stamp_columns if column and column in names], fields
        )
    except LogError as error:
        return [problem.removeprefix(f"{folder}/") for problem in error.problems]
    empty = [
        f"{where}: column {column} of {mapping.file} contains text ({text!r} in row {row}), expected numbers"
        for column, (_, row, text) in cells.texts.items()
        if not np.isfinite(cells.columns[column]).any()
    ]
    stamps = find_stamps(cells.stamps, stamp, mapping, zone=zone, path=path)
    if isinstance(stamps, str):
        return [*empty, f"{where}: {mapping.file}, column {stamp}: {stamps}"]
    if empty:
        return empty
    source = mapping.make_power_source(name)
    read_as = find_topic(name, role, mapping.columns, source.type if source else None)
    damage = [
        Damage("table-cells", mapping.file, messages_lost=count, reason=f"column {column}, row {row}: {text!r}")
        for column, (count, row, text) in cells.texts.items()
    ]
    damage += [
        Damage("table-cells", mapping.file, messages_lost=0, reason=note)
        for column, note in describe_duplicates(names).items()
        if column in (stamp, *cells.columns)
    ]
    return _read_messages((*read_as, role), mapping.file, values, stamps, damage)


def _read_messages(
    read_as: tuple[str, str, str], file: str, values: Mapping[str, Floats], stamps: Clock, damage: Sequence[Damage]
) -> TopicMessages:
    """Return the messages of a table, sorted by time, and its damage; ``read_as`` is topic, type and role.

    Rows without values are no messages: in a table that several sensors share, each row belongs to one sensor.
    """
    topic, kind, role = read_as
    has_value = np.any([np.isfinite(value) for value in values.values()], axis=0)
    is_used = stamps.ns.is_not_null().to_numpy() & (has_value if has_value.any() else True)
    lost = stamps.ns.null_count()
    damage = [*([Damage("time-invalid", file, messages_lost=lost)] if lost else []), *damage]
    damage += [Damage("stamps-assumed", file, messages_lost=0, reason=note) for note in stamps.notes]
    order = np.flatnonzero(is_used)
    stamp_ns = stamps.ns.fill_null(0).to_numpy()[order]
    if backward := int(np.count_nonzero(np.diff(stamp_ns) < 0)):
        damage.append(Damage("messages-unordered", file, messages_lost=0, places=backward))
        by_time = np.argsort(stamp_ns, kind="stable")
        order, stamp_ns = order[by_time], stamp_ns[by_time]
    values = {field: value[order] for field, value in values.items()}
    fields: Fields
    if kind in FLOAT_TYPES:
        fields = {"data": next(iter(values.values()))}
    else:
        fields = {**make_stamp_fields(stamp_ns), **make_message_fields(role, values, stamp_ns.size)}
    return make_topic(topic, kind, stamp_ns, lambda: fields, damage)


def _find_clock_mismatch(read: Iterable[TopicMessages]) -> Iterator[str]:
    """Yield a line for each table that does not overlap the longest one in time: another clock, or another drive."""
    spans = {found.topic.name: (found.topic.start_ns or 0, found.topic.end_ns or 0) for found in read}
    longest = max(spans, key=lambda name: spans[name][1] - spans[name][0], default="")
    for name, (first_ns, last_ns) in spans.items():
        start_ns, end_ns = spans[longest]
        if first_ns > end_ns or last_ns < start_ns:
            apart_s = (start_ns - first_ns) / 1e9
            yield (
                f"{name} and {longest} have no time in common (they begin {abs(apart_s):.3f} s apart): two clocks, or two drives; "
                f"add offset_s under its table to shift its stamps; 'tcpipe init --from' finds it by speed and turns "
                f"({apart_s:.3f} makes both begin at the same time)"
            )


TUM = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
"""Columns of a trajectory in the TUM format, which has no header; time in seconds, position in metres."""

_HEAD_BYTES = 1 << 16
_INFERRED_ROWS = 100
_SAMPLE_ROWS = 100_000
_COMMENT = re.compile(rb"[#%]")
_DAY_AND_TIME = re.compile(rb"^(\d{4})[/-](\d\d)[/-](\d\d)[ \t]+(?=\d\d:)", re.MULTILINE)
_SPACES = re.compile(rb"[ \t]+")
_EDGES = re.compile(rb"^ | (?=\r?$)", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Cells:
    """The columns of a table, each of shape (N,).

    ``stamps`` contains the columns of stamps as the file stores them. ``columns`` contains numbers; a cell without a
    number is NaN. ``texts`` gives, for each column with such text, the number of cells that are text, and the row (from
    1) and text of the first.
    """

    stamps: dict[str, pl.Series]
    columns: dict[str, Floats]
    texts: dict[str, tuple[int, int, str]]


@contextmanager
def _report_unreadable(path: Path) -> Iterator[None]:
    try:
        yield
    except (pl.exceptions.PolarsError, OSError) as error:
        raise LogError(f"{path}: it cannot be read as a table ({str(error).splitlines()[0]})") from None


def read_table_header(path: Path) -> list[str]:
    """Return the names of a table's columns; `LogError` if it cannot be read."""
    with _report_unreadable(path):
        return _scan(path).collect_schema().names()


def describe_duplicates(names: Sequence[str]) -> dict[str, str]:
    """Return a note on each column name that the header contains several times."""
    seconds = {name: f"{name}_duplicated_0" for name in names if name and f"{name}_duplicated_0" in names}
    return {
        name: f"several columns are called {name}: the first is read, {second} is the next"
        for name, second in seconds.items()
    }


def read_cells(path: Path, *, stamps: Sequence[str], columns: Sequence[str], words: Sequence[str] = ()) -> Cells:
    """Read the columns of stamps, of numbers, and of ``words`` as they are stored.

    `LogError`: the file cannot be read as a table.
    """
    wanted = [name for name in dict.fromkeys(columns) if name not in words]
    with _report_unreadable(path):
        frame = _collect_columns(path, [*dict.fromkeys([*stamps, *wanted, *words])], numbers=wanted)
        numbers = {name: frame[name].cast(pl.Float64, strict=False) for name in wanted}
        texts = {name: odd for name in wanted if numbers[name].null_count() and (odd := _find_non_number(path, name))}
    read = {name: values.fill_null(np.nan).to_numpy() for name, values in numbers.items()}
    read |= {name: frame[name].to_numpy() for name in words}
    return Cells({name: frame[name] for name in stamps}, read, texts)


def read_numbers(path: Path, names: Sequence[str]) -> dict[str, Floats]:
    """Return the first rows of numeric columns, shape (N,), NaN for cells without a number; `LogError`: no table."""
    with _report_unreadable(path):
        frame = _collect_columns(path, [*names], numbers=[*names], rows=_SAMPLE_ROWS)
    numbers = {name: frame[name].cast(pl.Float64) for name in names if frame[name].dtype.is_numeric()}
    return {name: of.fill_null(np.nan).to_numpy() for name, of in numbers.items() if of.null_count() < len(of)}


def read_column_values(
    path: Path, stamps: Sequence[str], fields: Mapping[str, FieldSource]
) -> tuple[Cells, dict[str, Floats]]:
    """Return the cells from which fields are computed, and the values of the fields, shape (N,) each."""
    used = {name: [column for column, _ in field.expression.operands()] for name, field in fields.items()}
    numbers = [column for name, columns in used.items() if name != "quality" for column in columns]
    cells = read_cells(path, stamps=stamps, columns=numbers, words=used.get("quality", ()))
    rows = len(cells.stamps[stamps[0]])
    return cells, {
        name: field.evaluate(lambda column, _: cells.columns[column], rows) for name, field in fields.items()
    }


def _collect_columns(
    path: Path, columns: list[str], numbers: list[str] | None, *, rows: int | None = None
) -> pl.DataFrame:
    """Return columns of a table; an unclosed quote (truncated log) only loses its own line."""
    try:
        return _scan(path, numbers).select(columns).slice(0, rows).collect()
    except pl.exceptions.ComputeError:
        return _scan(path, numbers, quote=None).select(columns).slice(0, rows).collect()


def _find_non_number(path: Path, name: str) -> tuple[int, int, str] | None:
    """Return the number of cells that are not numbers, and row (from 1) and text of the first."""
    texts = _collect_columns(path, [name], numbers=None)[name].cast(pl.String)
    is_invalid = texts.is_not_null() & (texts.str.strip_chars() != "") & texts.cast(pl.Float64, strict=False).is_null()
    rows = is_invalid.arg_true()
    return (len(rows), int(rows[0]) + 1, str(texts[int(rows[0])])) if len(rows) else None


def _scan(path: Path, numbers: list[str] | None = None, *, quote: str | None = '"') -> pl.LazyFrame:
    """Return a lazy frame of a table, with the columns ``numbers`` as numbers; None reads all cells as text."""
    if path.suffix == ".parquet":
        return pl.scan_parquet(path)
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    comments, lines = _split_comment_lines(head)
    if not lines:
        raise LogError(f"{path}: it contains no table: it is empty")
    separator = next((sign for sign in (b";", b"\t", b",") if sign in lines[0]), b" ")
    first = (_DAY_AND_TIME.sub(rb"\1-\2-\3T", lines[0]) if separator == b" " else lines[0]).split(
        None if separator == b" " else separator
    )
    names = None if any(map(_is_name, first)) else _find_column_names(comments, len(first), spaced=separator == b" ")
    source: Path | BytesIO = path
    try:
        lines[0].decode()
    except UnicodeDecodeError:  # as spreadsheets write it
        source = BytesIO(path.read_bytes().decode("cp1252", errors="replace").encode())
    if separator == b" ":  # several separators count as one
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
        return not re.match(rb"\d{4}[-/]\d\d[-/]\d\d|\d\d?[./]\d\d?[./]\d{4}|\d\d:\d\d", text)
    return False


def _find_column_names(comments: list[bytes], count: int, *, spaced: bool) -> list[str]:
    """Return column names of a table without a header: from its last comment if they fit, of TUM, or numbered."""
    names = comments[-1].lstrip(b"#% ").replace(b",", b" ").split() if comments else []
    if len(names) == count:
        return [name.decode(errors="replace") for name in names]
    if spaced and count == len(TUM):
        return list(TUM)
    return [f"column_{number}" for number in range(1, count + 1)]
