"""What the tables in a folder could be read as: roles, columns and stamps by name, judged by their values; polars is loaded here."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import LogError
from tcpipe.formats.logs.table_folders import list_table_files
from tcpipe.formats.logs.table_log import describe_duplicate, read_cells, read_column_names, read_values
from tcpipe.formats.object_storage import format_path
from tcpipe.logs.expressions import UNITS, parse_expression, split_unit
from tcpipe.logs.field_mapping import (
    CALLED,
    MAPPED,
    STAMP_UNITS,
    FieldSource,
    find_other_unit,
    match_field_names,
    parse_stamps_ns,
    read_fields,
)
from tcpipe.logs.fix_quality import find_quality
from tcpipe.logs.power_fields import match_power_fields, match_sided_velocities
from tcpipe.power.sources import RailReadings, find_quantity, find_rejection, make_rail_name
from tcpipe.recipe.suggestions import (
    ProposedLine,
    ProposedRecipe,
    TomlValue,
    format_first,
    propose_decisions,
    propose_quality,
)
from tcpipe.robots import MAX_PLAUSIBLE_MPS
from tcpipe.stages.proposals import NO_VOLTAGE, NOMINAL, judge_fields

Floats = NDArray[np.float64]

_COMMAND = re.compile(r"cmd|command|joy")
_STAMP = re.compile(r"t|stamp|.*time(stamp|string)?|gpst|utc|date")
_PLAIN = re.compile(r"[A-Za-z_]\w*")
_NUMBER = re.compile(r"\d+(?=\D*$)")
_OVER_TRACK = "/ 0.5"


@dataclass(frozen=True, slots=True)
class _Table:
    """A table, or one of several alike of as many runs: ``file`` as the recipe names it, and its stamps."""

    file: str
    path: Path
    names: Sequence[str]
    stamp: str
    stamp_unit: str
    """What the recipe has to state, "" where nothing."""
    is_absolute: bool
    """Whether its stamps count from 1970."""
    span_ns: tuple[int, int]
    rows: int
    """Number of different stamps."""

    def overlap_ns(self, other: _Table) -> int:
        """Return the time that two tables have in common."""
        if self.is_absolute != other.is_absolute:
            return 0
        return max(min(self.span_ns[1], other.span_ns[1]) - max(self.span_ns[0], other.span_ns[0]), 0)


def propose_tables(path: Path) -> ProposedRecipe:
    """Return the recipe for a table, or those in a folder, that have known names; its head lists their columns and what cannot be read.

    Of several tables for a role, that is used which covers the drive of the others best.
    """
    folder, files = (path, list_table_files(path)) if path.is_dir() else (path.parent, [path])
    columns: dict[str, Sequence[str]] = {}
    head = [""]
    for file in files:
        try:
            columns[file.relative_to(folder).as_posix()] = read_column_names(file)
        except LogError as error:
            head.append(str(error))
    roles: dict[str, list[tuple[_Table, list[ProposedLine]]]] = {}
    for name, largest in _group_files(folder, [folder / file for file in columns]).items():
        names = columns[largest.relative_to(folder).as_posix()]
        table = _read_table(name, largest, names)
        found = [(role, (table, lines)) for role, lines in _iterate_roles(table)] if table else []
        for role, candidate in found:
            roles.setdefault(role, []).append(candidate)
        unused = "" if found else ", not used: no known fields" if table else ", not used: no stamps"
        head.append(f"{name}{unused}; columns {', '.join(names)}")
    ranked = [
        candidate
        for candidates in roles.values()
        for candidate in sorted(candidates, key=lambda candidate: -candidate[0].rows)[:1]
    ]
    lines, log = list[ProposedLine](), path
    for role, candidates in roles.items():
        first = ranked[0][0]
        candidates.sort(key=lambda candidate: (-candidate[0].overlap_ns(first), -candidate[0].rows))
        table, mine = candidates[0]
        apart = "" if table.overlap_ns(first) else "no time in common with the others: another clock, or another drive"
        lines += [replace(line, note=f"{line.note}: {apart}", is_certain=False) for line in mine] if apart else mine
        log = table.path if "*" in table.file else log
        head += [f"{other.file}, {other.rows} rows, could be {role} as well" for other, _ in candidates[1:]]
    with_voltage = {make_rail_name(line.table) for line in lines if line.key == "columns.voltage"}
    lines = [line for line in lines if line.note != NO_VOLTAGE or make_rail_name(line.table) not in with_voltage]
    lines += propose_decisions([(role, "") for role in roles if role in ("gnss", "imu", "pose")], roles)
    return ProposedRecipe(head, lines, format_path(log))


def _group_files(folder: Path, files: Sequence[Path]) -> dict[str, Path]:
    """Return by the name for the recipe the largest of files that are called alike; with a * where they differ by a number.

    Numbers tell runs apart only where every table has one: else they may be those of motors.
    """
    numbered = {file: _NUMBER.sub("*", file.name) for file in files}
    alike = [{file.name for file, name in numbered.items() if name == each} for each in set(numbered.values())]
    of_runs = len(alike) > 1 and all(len(names) > 1 for names in alike)
    named: dict[str, list[Path]] = {}
    for file in files:
        named.setdefault(numbered[file] if of_runs else file.name, []).append(file)
    return {
        name if len(group) > 1 else group[0].relative_to(folder).as_posix(): max(
            group, key=lambda path: path.stat().st_size
        )
        for name, group in named.items()
    }


def _read_table(file: str, path: Path, names: Sequence[str]) -> _Table | None:
    """Return a table with the stamps that suit best: those since 1970, of these the finest; None where there are none."""
    found: list[tuple[tuple[bool, int, bool], _Table]] = []
    named = [name for name in names if _STAMP.fullmatch(split_unit(name)[0].lower())]
    for stamp in named or ([] if _is_measured(names[0], names) else names[:1]):
        cells = read_cells(path, stamp=stamp, columns=[])
        known, unit = cells.stamp[cells.stamp_known], split_unit(stamp)[1] or ""
        if known.size < 2:
            continue
        stated = ""
        stamp_ns = known if cells.stamp_is_time else parse_stamps_ns(known, "auto")
        if is_absolute := not isinstance(stamp_ns, str):
            span_ns = int(stamp_ns.min()), int(stamp_ns.max())
        else:
            step = float(np.median(np.diff(known)))  # ten rows in a minute at least, in the coarsest unit that fits
            fitting = (unit for unit, ns in reversed(STAMP_UNITS.items()) if 0 < step * ns / 1e9 <= 6.0)
            stated = "" if unit in STAMP_UNITS else next(fitting, "none")
            factor = STAMP_UNITS.get(stated or unit, 0)
            span_ns = int(known.min() * factor), int(known.max() * factor)
        rows = len(np.unique(known))
        made = _Table(file, path, names, stamp, stated, is_absolute, span_ns, rows)
        if stated != "none":
            found.append(((is_absolute, rows, not cells.stamp_is_time), made))  # texts are often cut to seconds
    return max(found, key=lambda candidate: candidate[0])[1] if found else None


def _is_measured(name: str, names: Sequence[str]) -> bool:
    """Return whether a role takes this column: a table that begins with latitudes has no stamps."""
    power = match_power_fields([_quote(each) for each in names])
    found = [match_field_names(role, names) for role in CALLED] + [*(power.rails if power else ())]
    return any({name, _quote(name)} & set(fields.values()) for fields in found)


def _iterate_roles(table: _Table) -> Iterator[tuple[str, list[ProposedLine]]]:
    """Yield the lines for each role that a table has columns for; a speed or place beside fixes or wheels was computed from them."""
    is_command = _COMMAND.search(table.file.lower())
    commands = [name for name in table.names if is_command or _COMMAND.search(name.lower())]
    measured = [name for name in table.names if name not in commands]
    found = {"gnss": match_field_names("gnss", measured), "imu": match_field_names("imu", measured)}
    found["command"] = match_field_names("command", commands)
    sided = match_sided_velocities([_quote(name) for name in measured])
    if sided and (other := find_other_unit(parse_expression(sided["angular_z"]), "rad/s")):
        to_mps = f"* {UNITS['m/s'][other]:.9g} {_OVER_TRACK}"
        sided["angular_z"] = sided["angular_z"].removesuffix(_OVER_TRACK) + to_mps
    found["wheel_odometry"] = (not found["gnss"] and match_field_names("wheel_odometry", measured)) or sided
    is_moving = found["gnss"] or found["wheel_odometry"]
    found["pose"] = {} if is_moving else match_field_names("pose", measured)
    for role, columns in found.items():
        if columns and (lines := _make_lines(table, role, role, columns)):
            yield role, lines
    yield from _iterate_power(table)


def _quote(name: str) -> str:
    return name if _PLAIN.fullmatch(name) else f"`{name}`"


def _iterate_power(table: _Table) -> Iterator[tuple[str, list[ProposedLine]]]:
    matched = match_power_fields([_quote(name) for name in table.names])
    rails, doubt = (matched.rails, matched.doubt) if matched else ((), "")
    named = find_quantity(table.path.stem) if len(table.names) == 2 else None
    found = {f"power_{number}" if len(rails) > 1 else "power": rail for number, rail in enumerate(rails, 1)}
    if named and not found:
        found = {re.sub(r"\W+", "_", table.path.stem): {named: table.names[1]}}
    counters = [name for name in table.names if split_unit(name)[1] in UNITS["J"]]
    if counters and not found:
        found = {"power": {"energy": counters[0]}}
    for name, rail in found.items():
        if lines := _make_lines(table, name, "power", rail, doubt):
            yield name, lines


def _make_lines(table: _Table, name: str, role: str, columns: Mapping[str, str], doubt: str = "") -> list[ProposedLine]:
    """Return the lines of a table's mapping; [] where its values cannot be what its columns are called."""
    values = _read_values(table, role, columns)
    mapped = {field: text for field, text in columns.items() if field in values}
    if not mapped or any(field not in mapped for field, known in MAPPED[role].items() if known.needed):
        return []
    used = [name for name in table.names if name in " ".join(mapped.values())]
    twice = next(filter(None, (describe_duplicate(name, table.names) for name in used)), "")
    doubt = doubt or _find_doubt(role, mapped, values) or twice
    if doubt == _IMPOSSIBLE:
        return []
    keys: dict[str, tuple[TomlValue, str]] = {"role": ("power", "")} if name != role else {}
    keys |= {"file": (table.file, doubt), "stamp": (table.stamp, "")}
    keys |= {"stamp_unit": (table.stamp_unit, "by its steps")} if table.stamp_unit else {}
    samples = {field: "" if field == "quality" else format_first(values[field]) for field in mapped}
    keys |= {f"columns.{field}": (text, samples[field]) for field, text in mapped.items()}
    units = _find_units(table, role, mapped)
    turn_unit = units.pop("angular_z", None)
    keys |= {f"units.{field}": (unit, "") for field, unit in units.items()}
    head = f"tables.{name}"
    lines = [ProposedLine(head, key, value, note, is_certain=not doubt) for key, (value, note) in keys.items()]
    if mapped.get("angular_z", "").endswith(_OVER_TRACK):
        note = "state the track width in place of 0.5 m"
        lines = [
            replace(line, note=note, is_certain=False) if line.key == "columns.angular_z" else line for line in lines
        ]
        lines += [ProposedLine(head, "units.angular_z", turn_unit, is_certain=False)] if turn_unit else []
    if role == "gnss" and "quality" not in mapped:
        lines += [_propose_quality(table, head, quality) for quality in find_quality(table.names)]
    if role == "power" and set(mapped) == {"current"}:
        lines += [ProposedLine(head, key, volt, NO_VOLTAGE, is_certain=False) for key, volt in NOMINAL.items()]
    return lines


def _propose_quality(table: _Table, head: str, source: str) -> ProposedLine:
    """Return the line of a fix quality: texts are words, what numbers mean is for a person to decide."""
    column = source.partition(": ")[2]
    values = read_cells(table.path, stamp=table.stamp, columns=[], words=[column]).columns[column]
    if np.issubdtype(values.dtype, np.number):
        return propose_quality(head, "columns.quality", source)
    return ProposedLine(head, "columns.quality", f"words: {column}", str(values[0]))


def _find_units(table: _Table, role: str, columns: Mapping[str, str]) -> dict[str, str]:
    """Return the units that the recipe has to state: of expressions whose columns have another one than the field."""
    found: dict[str, str] = {}
    for field, text in columns.items():
        unit, expression = MAPPED[role][field].unit, parse_expression(text.rpartition(": ")[2], table.names)
        if expression.column is None and (other := find_other_unit(expression, unit)):
            found[field] = other if other in UNITS[unit] else unit
    return found


def _read_values(table: _Table, role: str, columns: Mapping[str, str]) -> dict[str, Floats]:
    """Return the values of columns by field, in its unit; without those that hold no number."""
    units, fields = _find_units(table, role, columns), dict[str, FieldSource]()
    for name, text in columns.items():  # one that cannot be read takes no other with it
        read = read_fields(
            "", role, {name: text}, {field: unit for field, unit in units.items() if field == name}, table.names
        )
        fields |= read if isinstance(read, dict) else {}
    _, found = read_values(table.path, table.stamp, fields)
    return {name: values for name, values in found.items() if np.isfinite(values).any()}


_IMPOSSIBLE = "impossible"


def _find_doubt(role: str, mapped: dict[str, str], values: Mapping[str, Floats]) -> str:
    """Return what the values leave unclear, and correct ``mapped`` by the factors that they show."""
    if role in ("gnss", "imu"):
        judged, doubt = judge_fields(role, mapped, values)
        factors = {field: text.removeprefix(mapped[field]) for field, text in judged.items()}
        held = {
            field: f"{_quote(mapped[field])}{factor}" if factor else mapped[field] for field, factor in factors.items()
        }
        mapped.clear()
        mapped.update(held)
        return doubt
    if "energy" in values and np.ptp(values["energy"]) == 0.0:
        return _IMPOSSIBLE
    if role == "power" and not {"power", "energy"} & set(values):
        volt, amp = (values.get(field, np.full(1, np.nan)) for field in ("voltage", "current"))
        return _IMPOSSIBLE if find_rejection(RailReadings("", volt, amp), "", {}) else ""
    speed = values.get("linear_x", np.zeros(1))
    is_fast = float(np.nanquantile(np.abs(speed), 0.99)) > MAX_PLAUSIBLE_MPS
    return "its largest values are no m/s: state the unit" if is_fast else ""
