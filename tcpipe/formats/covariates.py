"""Covariates such as ground or weather, from tables in CSV or Parquet; a sample gets the last row before it."""

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import polars as pl
import pyarrow as pa

from tcpipe.arrays import Ints, Mask
from tcpipe.errors import DatasetError
from tcpipe.formats.integrity import Checksum, compute_checksum
from tcpipe.formats.logs.table_stamps import read_clock
from tcpipe.logs.field_mapping import STAMP_UNITS
from tcpipe.recipe.suggestions import format_recipe_key
from tcpipe.tables.findings import Finding, Findings, Subject, make_finding

TimeUnit = Literal["auto", "s", "ms", "us", "ns"]

_TIME_NAMES = ("time", "stamp", "timestamp", "datetime", "date", "date_time", "time_utc", "utc")
_NO_VALUE = ["", "NA", "N/A", "n/a", "NaN", "nan", "null", "NULL", "None"]
_LONGEST_HEAD = 65_536  # [byte], of a line of column names
_STAMP, _FOUND, _ROW = "tcpipe stamp", "tcpipe found", "tcpipe row"
_MOSTLY = 0.5


@dataclass(frozen=True, slots=True)
class CovariateTable:
    """Covariates with rising, unique stamps; ``findings``: omitted rows, and number columns made text by few words."""

    name: str
    checksum: Checksum
    time_column: str
    rows: pl.DataFrame
    """Values by column, numbers as float64 and all else as text, behind the stamps [ns]."""
    findings: Findings

    @property
    def span(self) -> tuple[str, str]:
        """First and last stamp, ISO 8601."""
        return _format_utc(self.rows[_STAMP][0]), _format_utc(self.rows[_STAMP][-1])

    def join(self, stamp_ns: Ints, *, max_age_s: float) -> tuple[pa.Table, Mask]:
        """Return the last row at or before each stamp that is not older than the limit; and which stamps a row reaches.

        ``stamp_ns`` (UTC, shape (N,)) may be in any order; columns are called as the file, without its ending, and the
        column. They are null if no row is near enough, or its value is missing.
        """
        wanted = pl.DataFrame({_STAMP: stamp_ns}).with_row_index(_ROW).sort(_STAMP)
        there = self.rows.with_columns(pl.col(_STAMP).alias(_FOUND))
        joined = wanted.join_asof(there, on=_STAMP, strategy="backward", tolerance=round(max_age_s * 1e9)).sort(_ROW)
        prefix, columns = Path(self.name).stem, [name for name in self.rows.columns if name != _STAMP]
        found = {
            f"{prefix}_{name}": joined[name]
            .to_arrow()
            .cast(pa.float64() if joined[name].dtype.is_float() else pa.string())
            for name in columns
        }
        fields = [
            pa.field(
                name,
                values.type,
                metadata={"unit": "", "doc": f"{column} of {self.name}, the last row before the sample"},
            )
            for column, (name, values) in zip(columns, found.items(), strict=True)
        ]
        return pa.table(list(found.values()), schema=pa.schema(fields)), joined[_FOUND].is_not_null().to_numpy()


def read_covariates(path: Path, *, time_column: str | None = None, time_unit: TimeUnit = "auto") -> CovariateTable:
    """Read a table of covariates.

    Without ``time_column`` the only one that has its name; ``time_unit`` is of stamps that are numbers, text is ISO
    8601, and UTC where it names no zone. `DatasetError`: it cannot be read, has no time, or two rows of one time
    differ.
    """
    table = _read_rows(path)
    column = _time_column(path, table, time_column)
    stamps = _parse_stamps(path, table[column], time_unit)
    known = stamps.is_not_null()
    values, findings = _parse_values(path, table.drop(column))
    rows = (
        pl.DataFrame([stamps.alias(_STAMP), *values])
        .filter(known)
        .unique(maintain_order=True)
        .sort(_STAMP, maintain_order=True)
    )
    if lost := int((~known).sum()):
        subject = Subject("file", path.name)
        findings.append(make_finding("covariates-without-time", subject, names={"column": column}, row_count=lost))
    if rows.is_empty() or rows.width == 1:
        raise DatasetError(
            f"{path}: {rows.height} rows of {rows.width - 1} columns besides {column}; expected at least one of each"
        )
    if len(twice := rows[_STAMP].filter(rows[_STAMP].is_duplicated())):
        raise DatasetError(
            f"{path}: rows of {_format_utc(twice[0])} differ; expected one row per stamp: split the table by station and depth"
        )
    return CovariateTable(path.name, compute_checksum(path), column, rows, tuple(findings))


def _read_rows(path: Path) -> pl.DataFrame:
    """Return the columns of a CSV or Parquet file, categories as text; `DatasetError` if it cannot be read."""
    try:
        if path.suffix.lower() == ".parquet":
            rows = pl.scan_parquet(path, glob=False)
        else:
            with path.open("rb") as file:
                head = file.readline(_LONGEST_HEAD).decode("utf-8", "replace")
            mark = max(",;\t", key=head.count)
            rows = pl.scan_csv(path, separator=mark, infer_schema_length=None, null_values=_NO_VALUE, glob=False)
        return rows.cast({pl.Categorical: pl.String}).collect()
    except (pl.exceptions.PolarsError, OSError, ValueError) as error:
        raise DatasetError(
            f"{path}: not a readable table ({str(error).splitlines()[0]}); expected CSV or Parquet"
        ) from None


def _format_utc(stamp_ns: int) -> str:
    """Return a stamp as ISO 8601 to the second."""
    return datetime.fromtimestamp(stamp_ns // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


_COLUMN = format_recipe_key("covariates.time_column")


def _time_column(path: Path, table: pl.DataFrame, wanted: str | None) -> str:
    columns = ", ".join(table.columns)
    if wanted is not None:
        if wanted not in table.columns:
            raise DatasetError(f"{path}: no column {wanted!r} ({_COLUMN}); there are {columns}")
        return wanted
    endings = ("", *(f"_{unit}" for unit in STAMP_UNITS))
    found = [
        name
        for name in table.columns
        if name.lower() in {f"{time_name}{end}" for time_name in _TIME_NAMES for end in endings}
    ]
    if len(found) != 1:
        problem = (
            f"{len(found)} columns tell the time ({', '.join(found)})"
            if found
            else "no column is called as one of time"
        )
        raise DatasetError(f"{path}: {problem}; name it ({_COLUMN}); there are {columns}")
    return found[0]


def _parse_stamps(path: Path, column: pl.Series, unit: TimeUnit) -> pl.Series:
    """Return stamps [ns since 1970, UTC], null if a row has none; times without a zone are UTC, dates midnight."""
    if not column.count():
        return column.cast(pl.Int64)
    if column.dtype == pl.String:
        column = column.str.replace(r"^\s*(\d{4}-\d\d-\d\d)\s*$", "${1}T00:00:00")
    clock = read_clock(column, unit=unit)
    if isinstance(clock, str):
        raise DatasetError(f"{path}: {column.name}: {clock}")
    if clock.unit or clock.kind == "day":
        key, units = format_recipe_key("covariates.time_unit"), ", ".join(STAMP_UNITS)
        raise DatasetError(
            f"{path}: {column.name}: its stamps do not count from 1970; set their unit, one of {units} ({key})"
        )
    return clock.ns


def _parse_values(path: Path, table: pl.DataFrame) -> tuple[list[pl.Series], list[Finding]]:
    """Return numbers as float64 without NaN, all else as text; findings name number columns made text by few words."""
    made, findings = list[pl.Series](), list[Finding]()
    for column in table:
        if column.dtype.is_numeric():
            values = column.cast(pl.Float64)
            made.append(values.set(~values.is_finite(), None))
            continue
        text = column.cast(pl.String)
        invalid = text.filter(text.cast(pl.Float64, strict=False).is_null() & text.is_not_null())
        if 0 < len(invalid) < _MOSTLY * text.count():
            finding = make_finding(
                "column-is-text",
                Subject("column", f"{path.stem}_{column.name}"),
                names={"file": path.name, "example": str(invalid[0])},
                odd_count=len(invalid),
                value_count=text.count(),
            )
            findings.append(finding)
        made.append(text)
    return made, findings
