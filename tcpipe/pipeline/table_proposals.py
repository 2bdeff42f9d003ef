"""What the tables in a folder could be read as: roles, columns and stamps by name, judged by their values; polars is loaded here."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import LogError
from tcpipe.formats.logs.table_log import Cells, read_cells, read_column_names
from tcpipe.logs.expressions import split_unit
from tcpipe.logs.field_mapping import MAPPED, STAMP_UNITS, match_field_names, parse_stamps_ns, read_fields
from tcpipe.logs.power_fields import match_power_fields, match_sided_velocities
from tcpipe.power.sources import RailReadings, find_rejection
from tcpipe.recipe.suggestions import ProposedLine, TomlValue, format_first, propose_extrinsics
from tcpipe.stages.proposals import NO_VOLTAGE, NOMINAL, judge_fields

Floats = NDArray[np.float64]

_COMMAND = re.compile(r"cmd|command|joy")
_BARE = {"voltage": re.compile(r"volt"), "current": re.compile(r"curr|amp")}
_STAMP = re.compile(r"t|stamp|.*time(stamp|string)?|gpst|utc|date")
_PLAIN = re.compile(r"[A-Za-z_]\w*")
_NUMBER = re.compile(r"\d+(?=\D*$)")
_FASTEST_MPS = 15.0
_OVER_TRACK = "/ 0.5"


@dataclass(slots=True)
class TableProposals:
    """What is proposed for the tables of a folder, what is left out and why, and a path to try it on."""

    log: Path
    columns: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """By file, what its columns are called."""
    problems: dict[str, str] = field(default_factory=dict)
    """By file, why it cannot be read."""
    head: list[str] = field(default_factory=list)
    lines: list[ProposedLine] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _Table:
    """A table, or one of several alike of as many runs: ``file`` as the recipe names it."""

    file: str
    path: Path
    names: tuple[str, ...]
    stamp: str
    cells: Cells
    is_absolute: bool
    stamp_unit: str | None
    """What the recipe has to state."""

    @property
    def rows(self) -> int:
        """Number of different stamps."""
        return len(np.unique(self.cells.stamp[self.cells.stamp_known]))


def propose_tables(folder: Path, files: Sequence[Path]) -> TableProposals:
    """Return the columns of each table, why some cannot be read, and the recipe's lines for those that have known names."""
    found = TableProposals(folder)
    for file in files:
        name = file.relative_to(folder).as_posix()
        try:
            found.columns[name] = tuple(read_column_names(file))
        except LogError as error:
            found.problems[name] = str(error)
    groups = _group_files(folder, [file for file in files if file.relative_to(folder).as_posix() in found.columns])
    roles: dict[str, list[tuple[_Table, list[ProposedLine]]]] = {}
    for name, path in groups.items():
        columns = found.columns[path.relative_to(folder).as_posix()]
        try:
            table = _read_table(name, path, columns)
        except LogError:
            continue
        if table is not None:
            for role, lines in _iterate_roles(table):
                roles.setdefault(role, []).append((table, lines))
    found.head = [
        f"Proposed from the tables in {folder.name} by tcpipe init. Comments need a decision: remove the # and correct the value."
    ]
    for role, candidates in roles.items():
        candidates.sort(key=lambda of: -of[0].rows)
        found.lines += candidates[0][1]
        if "*" in candidates[0][0].file:
            found.log = candidates[0][0].path
        for table, _ in candidates[1:]:
            found.head.append(f"{table.file} could be {role} as well; it has fewer rows ({table.rows}).")
    found.lines += propose_extrinsics((role, "") for role in roles if role in ("gnss", "imu", "pose"))
    return found


def _group_files(folder: Path, files: Sequence[Path]) -> dict[str, Path]:
    """Return by the name for the recipe the largest of files that are called alike; with a * where they differ by a number.

    Numbers tell runs apart only where every table has one: else they may be those of motors.
    """
    named: dict[str, list[Path]] = {}
    for file in files:
        named.setdefault(_NUMBER.sub("*", file.name), []).append(file)
    counts = [len({file.name for file in alike}) for alike in named.values()]
    if len(named) == 1 or min(counts, default=1) == 1:
        named = {}
        for file in files:
            named.setdefault(file.name, []).append(file)
    found = {}
    for name, alike in named.items():
        largest = max(alike, key=lambda file: file.stat().st_size)
        found[name if len(alike) > 1 else alike[0].relative_to(folder).as_posix()] = largest
    return found


def _read_table(file: str, path: Path, names: tuple[str, ...]) -> _Table | None:
    """Return a table with the stamps that suit best: those since 1970, of these the finest; None where there are none."""
    best: tuple[tuple[bool, int, bool], _Table] | None = None
    for stamp in [name for name in names if _STAMP.fullmatch(split_unit(name)[0].lower())] or names[:1]:
        cells = read_cells(path, stamp=stamp, columns=[])
        known = cells.stamp[cells.stamp_known]
        if known.size < 2:
            continue
        unit = split_unit(stamp)[1]
        is_absolute = cells.stamp_is_time or not isinstance(parse_stamps_ns(known, "auto"), str)
        stated = None if is_absolute or unit in STAMP_UNITS else _guess_unit(known)
        if stated == "":
            continue
        made = _Table(file, path, names, stamp, cells, is_absolute, stated)
        rank = is_absolute, made.rows, not cells.stamp_is_time  # texts are often cut to seconds
        if best is None or rank > best[0]:
            best = rank, made
    return best and best[1]


def _guess_unit(stamps: NDArray[Any]) -> str:
    """Return the unit of stamps that count from somewhere: the coarsest with ten rows in a minute at least; "" where they do not rise."""
    step = float(np.median(np.diff(stamps)))
    return next((unit for unit, ns in reversed(STAMP_UNITS.items()) if 0 < step * ns / 1e9 <= 6.0), "")


def _iterate_roles(table: _Table) -> Iterator[tuple[str, list[ProposedLine]]]:
    """Yield the lines for each role that a table has columns for; a speed or place beside fixes or wheels was computed from them."""
    matched: dict[str, dict[str, str]] = {}
    commands = (
        table.names
        if _COMMAND.search(table.file.lower())
        else [name for name in table.names if _COMMAND.search(name.lower())]
    )
    measured = [name for name in table.names if name not in commands]
    for role in ("gnss", "imu", "command", "wheel_odometry", "pose"):
        if ("gnss" in matched and role in ("wheel_odometry", "pose")) or (
            role == "pose" and "wheel_odometry" in matched
        ):
            continue
        columns = match_field_names(role, commands if role == "command" else measured)
        if not columns and role == "wheel_odometry":
            columns = match_sided_velocities([_quote(name) for name in measured])
        if columns:
            matched[role] = columns
    for role, columns in matched.items():
        if lines := _make_lines(table, role, role, columns):
            yield role, lines
    yield from _iterate_power(table)


def _quote(name: str) -> str:
    return name if _PLAIN.fullmatch(name) else f"`{name}`"


def _unquote(text: str) -> str:
    alone = re.fullmatch(r"`([^`]*)`", text)
    return alone[1] if alone else text


def _iterate_power(table: _Table) -> Iterator[tuple[str, list[ProposedLine]]]:
    matched = match_power_fields([_quote(name) for name in table.names])
    rails: list[dict[str, str]] = [dict(rail) for rail in matched.rails] if matched else []
    for quantity, word in _BARE.items():
        if not rails and word.search(table.path.stem.lower()) and len(table.names) == 2:
            name = re.sub(r"\W+", "_", table.path.stem)
            yield name, _make_lines(table, name, "power", {quantity: table.names[1]})
            return
    for number, rail in enumerate(rails):
        name = "power" if len(rails) == 1 else f"power_{number + 1}"
        doubt = matched.doubt if matched else ""
        yield name, _make_lines(table, name, "power", {what: _unquote(text) for what, text in rail.items()}, doubt)


def _make_lines(table: _Table, name: str, role: str, columns: Mapping[str, str], doubt: str = "") -> list[ProposedLine]:
    """Return the lines of a table's mapping; [] where its values cannot be what its columns are called."""
    values = _read_values(table, role, columns)
    if values is None:
        return []
    mapped, why = _judge(role, columns, values)
    doubt = doubt or why
    if mapped is None:
        return []
    head = f"tables.{name}"
    keys: list[tuple[str, TomlValue, str]] = [("role", "power", "")] if name != role else []
    keys += [("file", table.file, ""), ("stamp", table.stamp, f"{table.cells.stamp[table.cells.stamp_known][0]}")]
    keys += [("stamp_unit", table.stamp_unit, "by its steps")] if table.stamp_unit else []
    keys += [(f"columns.{of}", text, format_first(values[of])) for of, text in mapped.items()]
    lines = [
        ProposedLine(head, key, value, f"{note}: {doubt}" if doubt and key == "file" else note, is_certain=not doubt)
        for key, value, note in keys
    ]
    if (turn := mapped.get("angular_z", "")).endswith(_OVER_TRACK):
        lines[-1] = ProposedLine(
            head, "columns.angular_z", turn, "state the track width in place of 0.5 m", is_certain=False
        )
    if role == "power" and set(mapped) == {"current"}:
        lines.append(
            ProposedLine(head, "nominal_voltage_volt", NOMINAL["nominal_voltage_volt"], NO_VOLTAGE, is_certain=False)
        )
    return lines


def _read_values(table: _Table, role: str, columns: Mapping[str, str]) -> dict[str, Floats] | None:
    """Return the values of columns by field, in its unit; None where they are no numbers."""
    fields = read_fields("", role, columns, {}, table.names)
    if isinstance(fields, list):
        return None
    used = [column for of, _ in fields.values() for column, _ in of.operands()]
    cells = read_cells(table.path, stamp=table.stamp, columns=used)
    found = {
        name: factor * of.evaluate(lambda column, _: cells.columns[column]) for name, (of, factor) in fields.items()
    }
    return (
        found
        if all(np.isfinite(found[of]).any() for of in found)
        else {of: value for of, value in found.items() if np.isfinite(value).any()}
    )


def _judge(role: str, columns: Mapping[str, str], values: Mapping[str, Floats]) -> tuple[dict[str, str] | None, str]:
    """Return the columns that can be what they are called, with the factors that their values show, and what is unclear."""
    held = {of: text for of, text in columns.items() if of in values}
    if not all(of in held for of, known in MAPPED[role].items() if known.needed):
        return None, ""
    if role in ("gnss", "imu"):
        judged, doubt = judge_fields(role, held, values)
        return {
            of: text if text == held[of] else text.replace(held[of], _quote(held[of])) for of, text in judged.items()
        }, doubt
    if role == "power":
        volt = values.get("voltage", np.full(1, np.nan))
        why = (
            find_rejection(RailReadings("", volt, values.get("current", np.full(1, np.nan))), "", {})
            if "power" not in values
            else None
        )
        return (held, "") if why is None else (None, "")
    speed = values.get("linear_x")
    fast = speed is not None and float(np.nanquantile(np.abs(speed), 0.99)) > _FASTEST_MPS
    return held, "its largest values are no m/s: state the unit" if fast else ""
