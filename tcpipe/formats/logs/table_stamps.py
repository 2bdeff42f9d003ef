"""Stamps of tables: counters, dates and times as text, milliseconds of a day, and counters tied to UTC coarsely."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import polars as pl

from tcpipe.logs.expressions import simplify_name, split_unit
from tcpipe.logs.field_mapping import STAMP_UNITS, YEARS_S, parse_stamps_ns, utc_from_gps_ns
from tcpipe.recipe import TableMapping

DAY_FIRST, _MONTH_FIRST = "%d/%m/%Y %H:%M:%S%.f", "%m/%d/%Y %H:%M:%S%.f"
_FORMS = (
    *(f"%Y-%m-%d{between}%H:%M:%S%.f{zone}" for zone in ("", "%#z") for between in ("T", " ")),
    *("%d.%m.%Y %H:%M:%S%.f", "%Y/%m/%d %H:%M:%S%.f", DAY_FIRST, _MONTH_FIRST, "%m/%d/%Y %I:%M:%S%.f %p"),
    "%H:%M:%S%.f",
)
"""Formats of dates and times that are recognised; the last has no date."""
_GPS_TIME = "GPST"  # RTKLIB's name of a column of GPS time
_OF_UTC = re.compile(r"(.*_)?(utc|gmt|zulu)(_.*)?")
_OF_DAY = re.compile(r"(.*_)?ms_(today|of_day)")
# Units of counters, by column names that are a unit or a function of a microcontroller.
_COUNTERS = {"millis": "ms", "micros": "us", **{unit: unit for unit in STAMP_UNITS}}
_DATE_IN_NAME = re.compile(r"(?<!\d)(20\d\d)([-_.]?)([01]\d)\2([0-3]\d)(?!\d{3})")
_DAY_NS = 86_400_000_000_000
_SAMPLE_ROWS = 1000
_SLOWEST_STEP_S = 6.0  # ten rows in a minute: the unit of a counter is the coarsest with shorter steps
_MIN_FAST_SHARE = 0.9
_PREFERRED = ("counter", "day", "local", "utc")
_MAX_TIE_SPREAD_NS, _MAX_STRAY_SHARE = 2_000_000_000, 0.05
_COARSEST = tuple(reversed(STAMP_UNITS.items()))
# Which of two equal local times is meant at the end of summer time, before and after the clock was set back.
_REPEATED_HOUR: tuple[Literal["earliest", "latest"], ...] = ("earliest", "latest")
_LONGEST_STEP_BACK = timedelta(minutes=30)  # A larger step back in a table sets the clock back
_NO_STAMPS = "it contains neither numbers nor dates (expected seconds, or text as 2025-10-14T15:41:25.7Z)"
RecipeKeys: TypeAlias = dict[str, tuple[str, str, bool]]
"""Value, note and certainty of each key of one of the recipe's tables."""
Kind: TypeAlias = Literal["utc", "local", "day", "counter"]


@dataclass(frozen=True, slots=True)
class Clock:
    """Stamps of rows, shape (N,), null if unknown: [ns] since 1970 (UTC or local), since midnight, or of a counter.

    ``unit`` is guessed from the steps of numbers whose size and name state no unit, else ""; ``sample`` is the first
    text, "" for numbers; ``notes`` are assumptions.
    """

    kind: Kind
    ns: pl.Series
    unit: str = ""
    sample: str = ""
    notes: tuple[str, ...] = ()

    def count_stamps(self) -> int:
        """Return the number of different stamps."""
        return self.ns.drop_nulls().n_unique()


def find_stamps(
    columns: Mapping[str, pl.Series], stamp: str, mapping: TableMapping, *, zone: str, path: Path
) -> Clock | str:
    """Return the stamps of a mapped table, in UTC or of a counter, or the reason why they cannot be read.

    ``columns`` contains the columns that ``stamp``, ``stamp_date`` and ``stamp_utc`` name; ``zone`` is the zone of
    times without one.
    """
    try:
        clock = _read_stamps(columns, stamp, mapping, "UTC" if mapping.stamp_utc else zone, path)
        if isinstance(clock, Clock) and mapping.stamp_utc:
            as_utc = replace(mapping, stamp_unit="auto", stamp_format="")
            utc = _read_stamps(columns, mapping.stamp_utc, as_utc, "UTC", path)
            clock = f"stamp_utc, {mapping.stamp_utc}: {utc}" if isinstance(utc, str) else _tie_to_utc(clock, utc)
    except pl.exceptions.PolarsError as error:
        return str(error).splitlines()[0]
    return clock if isinstance(clock, str) else replace(clock, ns=clock.ns + round(mapping.offset_s * 1e9))


def _read_stamps(
    columns: Mapping[str, pl.Series], stamp: str, mapping: TableMapping, zone: str, path: Path
) -> Clock | str:
    """Return the clock of a column of stamps, in UTC if possible, or a message on what the recipe must state."""
    dates = columns.get(mapping.stamp_date)
    clock = _read_dated(columns[stamp], dates, form=mapping.stamp_format, unit=mapping.stamp_unit)
    if isinstance(clock, str):
        return clock
    zone = "UTC" if _is_utc(stamp) else zone
    if clock.kind in ("local", "day") and not zone:
        sample = f" ({clock.sample})" if clock.sample else ""
        return f'its times{sample} have no zone; state it, as stamp_zone = "Europe/Vienna" or "UTC"'
    if clock.unit:
        first, units = clock.ns.drop_nulls()[0] / STAMP_UNITS[clock.unit], ", ".join(STAMP_UNITS)
        advice = f"set their unit, one of {units} (stamp_unit; by their steps {clock.unit})"
        return f"its stamps ({first:.12g}) do not count from 1970; {advice}"
    return _convert_to_utc(clock, zone, mapping.stamp_date, path) if clock.kind in ("local", "day") else clock


def _read_dated(column: pl.Series, dates: pl.Series | None, *, form: str = "", unit: str = "auto") -> Clock | str:
    """Return the clock of a column of times, with ``dates`` added to times of day, or the reason why it is no clock."""
    clock = read_clock(column, form=form, unit=unit)
    if dates is None or column.dtype not in (pl.String, pl.Time) or getattr(clock, "kind", "day") != "day":
        return clock
    joined = read_clock((dates.cast(pl.String) + " " + column.cast(pl.String)).alias(column.name), form=form)
    return clock if isinstance(joined, str) and "stamp_format" not in joined else joined


def read_clock(column: pl.Series, *, form: str = "", unit: str = "auto") -> Clock | str:
    """Return the clock of a column of times, or the reason why it is no clock.

    ``form`` is the recipe's ``stamp_format`` for texts, ``unit`` its ``stamp_unit`` for numbers.
    """
    if not column.count() or column.dtype.is_nested() or column.dtype == pl.Duration:
        return _NO_STAMPS
    if column.dtype == pl.String:
        times = _parse_times(column, form)
        if times is not None:
            return times
        column = column.cast(pl.Float64, strict=False)
    if column.dtype.is_temporal():
        kind: Kind = "utc" if _has_zone(column.dtype) else "day" if column.dtype == pl.Time else "local"
        return _make_clock(kind, column, str(column.drop_nulls().first()))
    numbers = column if column.dtype.is_integer() else column.cast(pl.Float64, strict=False)
    numbers = numbers.set(~numbers.is_finite(), None)
    values = numbers.drop_nulls().to_numpy()
    if not values.size:
        return _NO_STAMPS
    filled, unknown = numbers.fill_null(numbers.drop_nulls()[0]).to_numpy(), numbers.is_null()
    if unit == "ms_today" or (unit == "auto" and _OF_DAY.fullmatch(simplify_name(column.name))):
        return Clock("day", _unwrap_days(pl.Series(parse_stamps_ns(filled, "ms")).set(unknown, None)))
    named = split_unit(column.name)[1] or _COUNTERS.get(simplify_name(column.name), "")
    ns, guessed = parse_stamps_ns(filled, named if unit == "auto" and named in STAMP_UNITS else unit), ""
    if isinstance(ns, str):
        step = float(np.median(np.diff(values))) if values.size > 1 else 0.0
        guessed = next((name for name, one in _COARSEST if 0 < step * one / 1e9 <= _SLOWEST_STEP_S), "s")
        ns = np.asarray(parse_stamps_ns(filled, guessed), np.int64)
    is_utc = YEARS_S[0] < float(np.median(ns)) / 1e9 < YEARS_S[1]
    return Clock("utc" if is_utc else "counter", pl.Series(ns).set(unknown, None), guessed)


def _make_clock(kind: Kind, times: pl.Series, sample: str) -> Clock:
    """Return the clock of dates or times; the name of the column may state GPS time."""
    ns = (times if kind == "day" else times.cast(pl.Datetime("ns"))).cast(pl.Int64)
    if kind == "local" and times.name == _GPS_TIME:
        utc = pl.Series(utc_from_gps_ns(ns.fill_null(0).to_numpy()))
        return Clock("utc", utc.set(ns.is_null(), None), sample=sample)
    return Clock(kind, _unwrap_days(ns) if kind == "day" else ns, sample=sample)


def _parse_times(column: pl.Series, form: str) -> Clock | str | None:
    """Return the clock that texts state, or None if most texts are not times.

    If the order of day and month is ambiguous, return a message that asks for ``stamp_format``.
    """
    texts = column.str.strip_chars().str.replace(r",(\d+)", ".${1}")
    sample = texts.filter(texts.is_not_null() & (texts != "")).head(_SAMPLE_ROWS)
    tried = {each: _parse(sample, each) for each in ([form] if form else _FORMS)}
    fitting = {each: times for each, times in tried.items() if 2 * times.null_count() < len(times)}
    first = "".join(sample.head(1).to_list())
    if not fitting:
        return f"stamp_format is {form!r}, and its first text is {first!r}" if form and first else None
    best = min(fitting, key=lambda each: fitting[each].null_count())
    rival = fitting.get(_MONTH_FIRST)
    if best == DAY_FIRST and rival is not None and not (rival == fitting[best]).all():
        return f"its dates ({first}) may begin with day or month; state stamp_format = {best!r} or {_MONTH_FIRST!r}"
    times = _parse(texts, best)
    kind: Kind = "day" if times.dtype == pl.Time else "utc" if "%#z" in best or "%z" in best else "local"
    return _make_clock(kind, times, first)


def _parse(texts: pl.Series, form: str) -> pl.Series:
    """Parse texts by a format; a text that does not match becomes null. A format without a year gives times of day."""
    if not re.search("%[YyGFDcs+]", form):
        return texts.str.to_time(form, strict=False)
    times = texts.str.to_datetime(form, time_unit="ns", strict=False)
    return times.dt.convert_time_zone("UTC").dt.replace_time_zone(None) if _has_zone(times.dtype) else times


def _has_zone(kind: pl.DataType) -> bool:
    return isinstance(kind, pl.Datetime) and kind.time_zone is not None


def _is_utc(name: str) -> bool:
    return _OF_UTC.fullmatch(simplify_name(name)) is not None


def _unwrap_days(ns: pl.Series) -> pl.Series:
    """Return times of day [ns] with a day added at each midnight that the rows pass."""
    return ns + _DAY_NS * (ns.forward_fill().diff() < -_DAY_NS // 2).fill_null(value=False).cum_sum().cast(pl.Int64)


def _convert_to_utc(clock: Clock, zone: str, stated: str, path: Path) -> Clock | str:
    """Convert local times, or times of day, to UTC; a time that the zone's clocks skip becomes null.

    A time in the hour that the clocks repeat means its first pass, and after a row that steps back its second pass. The
    date of times of day is ``stated``, else in the file's name, else the one that brings the last row nearest to the
    file's last change. Return a message if the date is wrong or every time is skipped. Raise `PolarsError` if the zone
    does not exist.
    """
    notes, ns = clock.notes, clock.ns
    if clock.kind == "day":
        named = _DATE_IN_NAME.search(path.stem)
        try:
            day = date.fromisoformat(stated or ("-".join(named.group(1, 3, 4)) if named else ""))
        except ValueError:
            if stated:
                return f"stamp_date is {stated!r}; expected a column of dates of {path.name}, or a date, as 2025-07-09"
            changed = pl.Series([datetime.fromtimestamp(path.stat().st_mtime, UTC)]).dt.convert_time_zone(zone)
            middle = changed.dt.replace_time_zone(None)[0] - timedelta(microseconds=ns.drop_nulls()[-1] // 1000)
            day = (middle + timedelta(hours=12)).date()
            notes = (f"{day} by the last change of the file; state stamp_date if that is wrong",)
        ns = ns + (day - date(1970, 1, 1)).days * _DAY_NS
    local = ns.cast(pl.Datetime("ns"))
    first, second = (
        local.dt.replace_time_zone(zone, ambiguous=which, non_existent="null")
        .dt.convert_time_zone("UTC")
        .cast(pl.Int64)
        for which in _REPEATED_HOUR
    )
    if first.null_count() == len(first):
        return f"no time of it exists in {zone}, whose clocks skip an hour then; correct stamp_zone"
    is_repeated = (local.diff() < -_LONGEST_STEP_BACK).fill_null(value=False).cum_sum() > 0
    return replace(clock, kind="utc", ns=second.zip_with(is_repeated, first), notes=notes)


def _tie_to_utc(clock: Clock, utc: Clock) -> Clock | str:
    """Return stamps shifted onto UTC by a coarser column: by the median over the rows in which that column changes."""
    differences = (utc.ns - clock.ns).set(utc.ns <= int(YEARS_S[0] * 1e9), None)
    at_changes = differences.filter((utc.ns.diff() != 0) & differences.is_not_null())
    differences = at_changes if len(at_changes) else differences.drop_nulls()
    if not len(differences):
        return "stamp_utc has no times since 1979"
    offset = int(np.median(differences.to_numpy()))
    share = float(np.mean(np.abs(differences.to_numpy() - offset) > _MAX_TIE_SPREAD_NS))
    notes = (f"{share:.0%} of its UTC stamps are 2 s or more from the others",) if share > _MAX_STRAY_SHARE else ()
    return replace(clock, kind="utc", ns=clock.ns + offset, notes=(*utc.notes, *notes))


def choose_clock(columns: Mapping[str, pl.Series]) -> tuple[Clock, RecipeKeys] | None:
    """Return the clock of the best column of stamps, and its keys in the recipe; None without a clock.

    The clock with the finest stamps is best, because rows of a wide table share coarse times, such as whole seconds of
    GNSS. Of equally fine clocks, dates come before counters, and numbers before texts, which are often cut to seconds.
    """
    dates = next((column for name, column in columns.items() if re.fullmatch("(.*_)?date", simplify_name(name))), None)
    read_columns = {name: _read_candidate(column, dates) for name, column in columns.items()}
    candidates = {
        name: candidate for name, candidate in read_columns.items() if candidate and candidate[0].ns.count() > 1
    }
    if not candidates:
        return None
    rows = {name: clock.count_stamps() for name, (clock, _) in candidates.items()}
    fast = [name for name in candidates if rows[name] >= _MIN_FAST_SHARE * max(rows.values())]
    clock, keys = candidates[
        max(fast, key=lambda name: (_PREFERRED.index(candidates[name][0].kind), not candidates[name][0].sample))
    ]
    utc = next((name for name, (other, _) in candidates.items() if other.kind == "utc"), "")
    if clock.unit or (clock.kind == "day" and not clock.sample):
        keys["stamp_unit"] = (clock.unit, "by its steps", True) if clock.unit else ("ms_today", "", True)
    if clock.kind != "utc" and utc and isinstance(tied := _tie_to_utc(clock, candidates[utc][0]), Clock):
        clock, keys["stamp_utc"] = tied, (utc, "coarser, but UTC", True)
    elif clock.kind in ("local", "day") and not _is_utc(keys["stamp"][0]):
        keys["stamp_zone"] = "UTC", 'or as "Europe/Vienna": the zone of times without one, of all tables', False
    return clock, keys


def _read_candidate(column: pl.Series, dates: pl.Series | None) -> tuple[Clock, RecipeKeys] | None:
    """Return the clock of a column and its keys in the recipe; None if the column is no clock."""
    clock, keys = _read_dated(column, dates), RecipeKeys()
    if isinstance(clock, str) and "stamp_format" in clock:
        keys["stamp_format"] = DAY_FIRST, clock, False
        clock = _read_dated(column, dates, form=DAY_FIRST)
    if isinstance(clock, str):
        return None
    if dates is not None and clock.kind != "day" and getattr(read_clock(column), "kind", "") == "day":
        keys["stamp_date"] = dates.name, "", True
    if clock.kind == "local" and _is_utc(column.name):
        clock = replace(clock, kind="utc")
    return clock, {"stamp": (column.name, clock.sample, True), **keys}
