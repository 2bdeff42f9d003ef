"""The recipe that the tables in a folder propose: roles, columns and stamps by name, judged by values; polars is loaded here."""

from __future__ import annotations

import re
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pyarrow.compute as pc
from numpy.typing import NDArray

from tcpipe.errors import LogError, TcpipeError
from tcpipe.formats.finding_lines import describe_finding
from tcpipe.formats.logs.log_joining import open_single_log
from tcpipe.formats.logs.table_folders import list_table_files
from tcpipe.formats.logs.table_log import describe_duplicate, read_cells, read_column_names, read_numbers
from tcpipe.formats.logs.table_stamps import DAY_FIRST, Clock, read_clock
from tcpipe.formats.object_storage import format_path
from tcpipe.formats.recipe_toml import load_profiles
from tcpipe.logs.expressions import UNITS, parse_expression, simplify_name, split_unit
from tcpipe.logs.field_mapping import (
    MAPPED,
    find_other_unit,
    match_field_names,
    match_known_fields,
    match_table_roles,
    read_fields,
)
from tcpipe.logs.fix_quality import find_quality
from tcpipe.logs.power_fields import match_power_fields, quote
from tcpipe.pipeline.proposals import ProposedLine, ProposedRecipe, propose_decisions, propose_lines, propose_quality
from tcpipe.power.sources import RailReadings, find_quantity, find_rejection, make_rail_name
from tcpipe.recipe import Recipe
from tcpipe.recipe.checking import from_values
from tcpipe.recipe.suggestions import TomlValue, format_first
from tcpipe.robots import MAX_PLAUSIBLE_MPS
from tcpipe.stages.proposals import NO_VOLTAGE, NOMINAL, judge_fields
from tcpipe.stages.read import find_read_config, read_run
from tcpipe.tables.findings import Finding

Floats = NDArray[np.float64]
_Value: TypeAlias = tuple[TomlValue, str, bool]
_Values: TypeAlias = dict[str, _Value]
"""By key of a table of the recipe its value, a note, and whether it is certain."""
_TO_NAME = "column?"
"""In place of a column that a person has to name."""

_STAMP = re.compile(
    r"(.*_)?(t|stamp|.*time(stamp|string)?|gpst|utc|date|epoch|millis|micros|ms_today|ms_of_day)(_(utc|local))?|ms|us"
)
_DATE = re.compile(r"(.*_)?date")
_RUN_TEXT = (r"\d+(?=\D*$)", r"\d([\d_.:T-]*\d)?", r"^[^_. -]+(?=[_ -])")
"""Parts of a file's name that differ between runs: the last number, date and time, the first word."""
_LARGEST_GAP_NS = 14 * 3_600_000_000_000
"""Largest difference of local time from UTC [ns]."""
_MIN_FAST_SHARE = 0.9
_TRIAL_NS = 60_000_000_000
_SCALE_TOLERANCE = 0.03
_CONTRADICTIONS = (
    "unit-suspected",
    "distance-contradicted",
    "drives-backwards",
    "path-unlike",
    "gnss-contradicts-odometry",
)
"""Findings of the first minute that contradict a table of wheel odometry or of an IMU."""
_HINTS = {
    "gnss": r"(.*_)?(lat|lon|lng|gps|gnss|alt)\w*",
    "imu": r"(.*_)?(a|g|w|acc|gyr|imu|omega|rot)([a-z]*_?[xyz]|\w{2,})",
    "wheel_odometry": r".*(speed|vel|rpm|wheel|odo|enc|tach).*",
    "power": r".*(volt|curr|amp|power|watt|bat|energy|^[uiv]).*",
}
"""Names in English of columns that may be of a role, in lower case."""


@dataclass(frozen=True, slots=True)
class _Table:
    """A table, or one of as many runs: its ``file`` as the recipe names it, values of columns of numbers, and its clock.

    ``stamp_lines`` are the recipe's keys of stamps: value, note and whether it is certain.
    """

    file: str
    path: Path
    names: Sequence[str]
    numbers: Mapping[str, Floats]
    clock: Clock
    stamp_lines: _Values

    @property
    def rows(self) -> int:
        """Number of different stamps."""
        return len(np.unique(self.clock.ns[self.clock.known]))

    def overlap_ns(self, other: _Table) -> int:
        """Return the time that two tables have in common; local time and UTC differ by an unknown zone."""
        (start, end), (first, last) = (
            (int(known.min()), int(known.max()))
            for known in (table.clock.ns[table.clock.known] for table in (self, other))
        )
        kinds = {self.clock.kind, other.clock.kind}
        if len(kinds) > 1 and "counter" in kinds:
            return 0
        if len(kinds) > 1 and ("day" in kinds or abs(start - first) < _LARGEST_GAP_NS):
            return min(end - start, last - first)
        return max(min(end, last) - max(start, first), 0)


def propose_tables(path: Path) -> ProposedRecipe:
    """Return the recipe for a table, or those in a folder, that have known names; its head lists their columns and what cannot be read.

    Of several tables for a role, that is used which covers the drive of the others best. Tables that contradict others in the first minute
    are comments.
    """
    folder, files = (path, list_table_files(path)) if path.is_dir() else (path.parent, [path])
    columns, head = dict[Path, Sequence[str]](), [""]
    for file in files:
        try:
            columns[file] = read_column_names(file)
        except LogError as error:
            head.append(str(error))
    roles: dict[str, list[tuple[_Table, list[ProposedLine]]]] = {}
    tables = list[_Table]()
    for name, example in _group_files(folder, columns).items():
        table = _read_table(name, example, columns[example])
        found = [(role, (table, lines)) for role, lines in _iterate_roles(table)] if table else []
        for role, candidate in found:
            roles.setdefault(role, []).append(candidate)
        tables += [table] if table else []
        unused = "" if found else ", not used: no known fields" if table else ", not used: no stamps"
        head.append(f"{name}{unused}; columns {', '.join(columns[example])}")
    ranked = [max(candidates, key=lambda candidate: candidate[0].rows)[0] for candidates in roles.values()]
    lines, log, used = list[ProposedLine](), path, set[str]()
    for role, candidates in roles.items():
        candidates.sort(key=lambda candidate: (-candidate[0].overlap_ns(ranked[0]), -candidate[0].rows))
        table, mine = candidates[0]
        apart = (
            "" if table.overlap_ns(ranked[0]) else "no time in common with the others: another clock, or another drive"
        )
        lines += [replace(line, note=f"{line.note}: {apart}", is_certain=False) for line in mine] if apart else mine
        used |= {line.value for line in mine if isinstance(line.value, str)}
        log = table.path if "*" in table.file else log
        head += [f"{other.file}, {other.rows} rows, could be {role} as well" for other, _ in candidates[1:]]
    with_voltage = {make_rail_name(line.table) for line in lines if line.key == "columns.voltage"}
    lines = [line for line in lines if line.note != NO_VOLTAGE or make_rail_name(line.table) not in with_voltage]
    zones = [line for line in lines if line.key == "stamp_zone"]
    lines = [line for line in lines if line not in zones[1:]]
    lines, tried = _try_lines(lines, log) if lines else (lines, ())
    named = {line.value for line in lines if line.key == "role"} | {
        line.table.removeprefix("tables.") for line in lines
    }
    for role in ("gnss", "imu", "wheel_odometry", "power"):
        lines += [] if role in named else _propose_rest(role, tables, " ".join(used))
    lines += [*tried, *propose_decisions([(role, "") for role in roles if role in ("gnss", "imu", "pose")], roles)]
    return ProposedRecipe(head, lines, format_path(log))


def _group_files(folder: Path, columns: Mapping[Path, Sequence[str]]) -> dict[str, Path]:
    """Return by the name for the recipe the files of the largest run, with a * where names of runs differ.

    A part of a name tells runs apart if every table has several such files, with the same columns. Of one kind of table these are logs of
    all sensors; else the numbers may be those of motors.
    """
    names = {file: file.relative_to(folder).as_posix() for file in columns}
    for pattern in _RUN_TEXT:
        groups: dict[str, dict[str, Path]] = defaultdict(dict)
        for file in columns:
            starred = re.sub(pattern, "*", file.name, count=1)
            text = re.search(pattern, file.name)
            groups[starred][text[0] if text else ""] = file
        alike = all(
            len(runs) > 1 and len({tuple(columns[file]) for file in runs.values()}) == 1 for runs in groups.values()
        )
        if groups and alike and (len(groups) > 1 or match_field_names("gnss", next(iter(columns.values())))):
            sizes: dict[str, int] = defaultdict(int)
            for runs in groups.values():
                for text_of_run, file in runs.items():
                    sizes[text_of_run] += file.stat().st_size
            best = max(sizes, key=lambda text_of_run: sizes[text_of_run])
            return {starred: runs.get(best) or next(iter(runs.values())) for starred, runs in groups.items()}
    first = min(names.values())
    ends = [end.end() for end in re.finditer(r"\d(?=[_ -])", first)] if len(names) > 1 else []
    common = next(
        (end for end in reversed(ends) if all(name.startswith(first[: end + 1]) for name in names.values())), 0
    )
    if len(names) == 1:  # the next log of this recorder has another number
        return {re.sub(_RUN_TEXT[1], "*", name, count=1): file for file, name in names.items()}
    return {f"*{name[common:]}" if common else name: file for file, name in names.items()}


def _read_table(file: str, path: Path, names: Sequence[str]) -> _Table | None:
    """Return a table with the stamps that suit best, None without stamps.

    These are the finest: rows of a wide table share a coarse time. Of equally fine ones, dates go before counters, numbers before texts.
    """
    named = [name for name in names if _STAMP.fullmatch(simplify_name(name))]
    candidates = named or ([] if _is_measured(names[0], names) else list(names[:1]))
    if not candidates:
        return None
    raw = read_cells(path, stamps=candidates, columns=[]).stamps
    clocks, lines = dict[str, Clock](), dict[str, _Values]()
    date = next((name for name in candidates if _DATE.fullmatch(simplify_name(name))), "")
    for name in candidates:
        clock, more = read_clock(raw[name]), _Values()
        if isinstance(clock, str) and "stamp_format" in clock:
            more = {"stamp_format": (DAY_FIRST, clock, False)}
            clock = read_clock(raw[name], form=DAY_FIRST)
        elif not isinstance(clock, str) and clock.kind == "day" and clock.sample and date not in ("", name):
            joined = read_clock((raw[date] + " " + raw[name]).alias(name))
            more = {} if isinstance(joined, str) else {"stamp_date": (date, "", True)}
            clock = clock if isinstance(joined, str) else joined
        if not isinstance(clock, str) and np.count_nonzero(clock.known) > 1:
            clocks[name], lines[name] = clock, more
    if not clocks:
        return None
    rows = {name: len(np.unique(clock.ns[clock.known])) for name, clock in clocks.items()}
    fast = [name for name in clocks if rows[name] >= _MIN_FAST_SHARE * max(rows.values())]
    order = ("counter", "day", "local", "utc")
    stamp = max(fast, key=lambda name: (order.index(clocks[name].kind), not clocks[name].sample))
    clock, found = clocks[stamp], {"stamp": (stamp, clocks[stamp].sample, True), **lines[stamp]}
    found |= {"stamp_unit": (clock.unit, "by its steps", True)} if clock.is_guessed else {}
    found |= {"stamp_unit": ("ms_today", "", True)} if clock.kind == "day" and not clock.sample else {}
    slow = [name for name, other in clocks.items() if clock.kind != "utc" and name != stamp and other.kind != "counter"]
    utc = max(slow, key=lambda name: order.index(clocks[name].kind), default="")
    if utc and clocks[utc].kind == "utc":
        found["stamp_utc"] = (utc, "coarser, but UTC", True)
        shifted = clocks[utc]
        clock = replace(
            clock, kind="utc", ns=clock.ns + int(np.median((shifted.ns - clock.ns)[clock.known & shifted.known]))
        )
    elif clock.kind in ("local", "day"):
        found["stamp_zone"] = ("UTC", 'or as "Europe/Vienna": the zone of times without one, of all tables', False)
    return _Table(file, path, names, read_numbers(path, names), clock, found)


def _is_measured(name: str, names: Sequence[str]) -> bool:
    """Return whether a column is what some role measures, by its name, and so cannot be stamps."""
    is_power = match_power_fields([name]) is not None or find_quantity(name) is not None
    return is_power or any(
        name in found.values()
        for role in ("gnss", "imu", "wheel_odometry", "pose")
        if (found := match_field_names(role, names))
    )


def _iterate_roles(table: _Table) -> Iterator[tuple[str, list[ProposedLine]]]:
    """Yield each role that a table has columns for, with its lines."""
    names = [name for name in table.names if name != table.stamp_lines["stamp"][0]]
    for role, (columns, doubt) in match_table_roles(table.file, names).items():
        if lines := _make_lines(table, role, role, columns, doubt):
            yield role, lines
    live = [name for name in names if np.any(np.nan_to_num(table.numbers.get(name, np.zeros(1))))]
    matched = match_power_fields([quote(name) for name in live])
    rails, doubt = (matched.rails, matched.doubt) if matched else ((), "")
    named = find_quantity(table.path.stem) if len(table.names) == 2 else None
    found: dict[str, Mapping[str, str]] = {
        f"power_{number}" if len(rails) > 1 else "power": rail for number, rail in enumerate(rails, 1)
    }
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
    values, units = _read_values(table, role, columns)
    mapped = {field: text for field, text in columns.items() if field in values}
    if not mapped or any(field not in mapped for field, known in MAPPED[role].items() if known.needed):
        return []
    used = [column for column in table.names if column in " ".join(mapped.values())]
    twice = next(filter(None, (describe_duplicate(column, table.names) for column in used)), "")
    doubt = doubt or _find_doubt(role, mapped, values) or twice
    if doubt == _IMPOSSIBLE:
        return []
    head, certain = f"tables.{name}", not doubt
    keys: _Values = {"role": ("power", "", True)} if name != role else {}
    keys |= {"file": (table.file, doubt, True)} | table.stamp_lines
    for field, text in mapped.items():
        sample = "" if field == "quality" else format_first(values[field])
        measured = next((note for mark, note in _TO_STATE.items() if text.endswith(mark)), "")
        keys[f"columns.{field}"] = (text, measured or sample, not measured)
    keys |= {f"units.{field}": (units[field], "", keys[f"columns.{field}"][2]) for field in mapped if field in units}
    if role == "gnss" and "quality" not in mapped:
        keys |= {f"columns.{key}": value for key, value in _propose_quality(table)}
    if role == "power" and set(mapped) == {"current"}:
        keys |= {key: (volt, NO_VOLTAGE, False) for key, volt in NOMINAL.items()}
    return [
        ProposedLine(head, key, value, note, is_certain=certain and sure) for key, (value, note, sure) in keys.items()
    ]


_TO_STATE = {"/ 0.5": "state the track width in place of 0.5 m", "* 0.1": "state the wheels' radius in place of 0.1 m"}
"""By the end of an expression what it assumes."""


def _propose_quality(table: _Table) -> Iterator[tuple[str, _Value]]:
    """Yield the column of a fix quality: texts are words, what numbers mean is for a person to decide."""
    for source in find_quality(table.names):
        column = source.partition(": ")[2]
        if column in table.numbers:
            line = propose_quality("", "quality", source)
            yield "quality", (line.value, line.note, False)
        else:
            values = read_cells(table.path, stamps=[], columns=[], words=[column]).columns[column]
            yield "quality", (f"words: {column}", str(values[0]), True)


def _read_values(table: _Table, role: str, columns: Mapping[str, str]) -> tuple[dict[str, Floats], dict[str, str]]:
    """Return the values of columns by field in its unit, without those that hold no number, and the units that the recipe has to state.

    These are the units of expressions whose columns have another one than the field.
    """
    found, units = dict[str, Floats](), dict[str, str]()
    for field, text in columns.items():
        unit, expression = MAPPED[role][field].unit, parse_expression(text.rpartition(": ")[2], table.names)
        if expression.column is None and (other := find_other_unit(expression, unit)):
            units[field] = other if other in UNITS[unit] else unit
        read = read_fields(
            "", role, {field: text}, {name: of for name, of in units.items() if name == field}, table.names
        )
        if field == "quality":
            found[field] = np.zeros(1)
        elif isinstance(read, dict) and all(name in table.numbers for name, _ in expression.operands()):
            rows = len(table.clock.known)
            found[field] = read[field].evaluate(lambda name, _: table.numbers[name], rows)
    return found, units


_IMPOSSIBLE = "impossible"


def _find_doubt(role: str, mapped: dict[str, str], values: Mapping[str, Floats]) -> str:
    """Return what the values leave unclear, and correct ``mapped`` by the factors that they show."""
    if role in ("gnss", "imu"):
        judged, doubt = judge_fields(role, mapped, values)
        factors = {field: text.removeprefix(mapped[field]) for field, text in judged.items()}
        held = {
            field: f"{quote(mapped[field])}{factor}" if factor else mapped[field] for field, factor in factors.items()
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


def _propose_rest(role: str, tables: Sequence[_Table], used: str) -> Iterator[ProposedLine]:
    """Yield the table of a role that is not found as comments, with what its columns could be and three values of each."""
    for table in tables:
        free = [name for name in table.numbers if name not in used and name != table.stamp_lines["stamp"][0]]
        units = {field.unit for field in MAPPED[role].values()} - {"1", "m"}
        likely = [
            name
            for name in free
            if re.fullmatch(_HINTS[role], simplify_name(name))
            or any(split_unit(name)[1] in UNITS[unit] for unit in units)
        ]
        if not likely:
            continue
        known = match_known_fields(role, free)
        samples = (", ".join(f"{value:.4g}" for value in table.numbers[name][:3]) for name in likely)
        pick = ", ".join(f"{name} ({sample})" for name, sample in zip(likely, samples, strict=True))
        needed = [field for field, of in MAPPED[role].items() if of.needed] or ["voltage", "current"]
        keys: dict[str, TomlValue] = {"file": table.file, "stamp": table.stamp_lines["stamp"][0]}
        keys |= {f"columns.{field}": known.get(field, _TO_NAME) for field in dict.fromkeys([*needed, *known])}
        for key, value in keys.items():
            note = f"{role} is not recognised: pick from {pick}" if key == "file" else ""
            yield ProposedLine(f"tables.{role}", key, value, note, is_certain=False)
        return


def _try_lines(lines: Sequence[ProposedLine], log: Path) -> tuple[list[ProposedLine], list[ProposedLine]]:
    """Return the lines with those as comments that contradict others in the first minute, and lines that the trial adds."""
    recipe_of = [line for line in lines if line.is_certain or line.key in ("stamp_zone", "stamp_format")]
    values = tomllib.loads(ProposedRecipe([], [replace(line, is_certain=True) for line in recipe_of], "").toml())
    if not any(line.is_certain for line in lines):
        return [*lines], []
    tables = {name: table for name, table in values["tables"].items() if "columns" in table}
    recipe = from_values(Recipe, {"tables": tables}, where="proposed recipe")
    reasons, more = dict[str, str](), list[ProposedLine]()
    try:
        with open_single_log(log, tables=recipe.tables) as opened:
            streams = read_run(opened, find_read_config(recipe, opened.topics), robot=None, known=load_profiles(recipe))
        end = min(pc.min(table["stamp_ns"]).as_py() for table in streams.tables.values()) + _TRIAL_NS
        cut = {role: table.filter(pc.less(table["stamp_ns"], end)) for role, table in streams.tables.items()}
        cut = {role: table for role, table in cut.items() if table.num_rows}
        from tcpipe.stages.fuse import fuse_run  # noqa: PLC0415  kernels load only where there is work

        findings: Iterable[Finding] = fuse_run(
            replace(streams, tables=cut), recipe.fuse, run_id="trial"
        ).info.report.findings
    except LogError as error:
        findings = ()
        for problem in error.problems:
            if named := re.search(r"recipe tables\.(\w+)", problem):
                reasons[named[1]] = problem.partition(": ")[2]
    except TcpipeError:
        findings = ()
    for finding in findings:
        role, why = finding.subject.name, f"in the first minute: {describe_finding(finding)}"
        if finding.code == "imu-units":
            added = (line for remedy in finding.remedies for line in propose_lines(remedy.recipe, {}, ""))
            more += [replace(line, note=why) for line in added]
        elif finding.code == "odometry-scale" and role == "wheel_odometry":
            scale = finding.numbers["scale"]
            unit = next(
                (unit for unit, mps in UNITS["m/s"].items() if abs(scale * mps - 1.0) < _SCALE_TOLERANCE), "m/s"
            )
            line = ProposedLine("tables.wheel_odometry", "units.linear_x", unit, why)
            more += [line] if unit != "m/s" and not any(line.key == other.key for other in lines) else []
        elif finding.code in _CONTRADICTIONS and (of := finding.names.get("suspect", role)) in (
            "imu",
            "wheel_odometry",
        ):
            reasons[of] = why
    more = [line for line in more if line.table.removeprefix("tables.") not in reasons]
    return [
        replace(line, is_certain=False, note=reasons[name] if line.key == "file" else line.note)
        if (name := line.table.removeprefix("tables.")) in reasons
        else line
        for line in lines
    ], more
