"""The recipe proposed for a log or a folder of tables: findings with a value of each, and the user's decisions."""

from __future__ import annotations

import re
import shlex
import tomllib
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from os.path import commonprefix
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, cast

import numpy as np
import pyarrow.compute as pc

from tcpipe.arrays import Columns, Floats
from tcpipe.errors import LogError, TcpipeError, UsageError, clean_line
from tcpipe.formats.atomic import Location
from tcpipe.formats.finding_lines import describe_finding, format_number
from tcpipe.formats.logs.log_file import list_logs_below
from tcpipe.formats.logs.log_joining import open_single_log
from tcpipe.formats.logs.rosbag2 import is_one_bag
from tcpipe.formats.logs.table_folders import is_table, list_table_files
from tcpipe.formats.object_storage import format_path, is_url
from tcpipe.formats.recipe_toml import load_profiles
from tcpipe.logs.expressions import UNITS, parse_expression, simplify_name, split_unit
from tcpipe.logs.field_mapping import (
    MAPPED,
    MAPPED_TYPES,
    find_other_unit,
    list_number_fields,
    match_field_names,
    match_known_fields,
    match_table_roles,
    read_fields,
)
from tcpipe.logs.fix_quality import find_quality
from tcpipe.logs.messages import count_frames
from tcpipe.logs.power_fields import match_power_fields, quote
from tcpipe.logs.roles import TWIST, TWIST_STAMPED, RoleAssignment
from tcpipe.logs.topics import Topic
from tcpipe.power.sources import RailReadings, find_quantity, find_rejection, make_rail_name
from tcpipe.recipe import Recipe, Role
from tcpipe.recipe.checking import as_toml, from_values
from tcpipe.recipe.suggestions import Keys, TomlValue, format_first, make_place_to_measure
from tcpipe.robots import MAX_PLAUSIBLE_MPS
from tcpipe.stages.message_arrays import make_message_arrays
from tcpipe.stages.proposals import NO_VOLTAGE, NOMINAL, find_proposals, judge_fields
from tcpipe.stages.read import decide_roles, find_read_config, read_run
from tcpipe.stages.read_sources import place_frames
from tcpipe.store import is_store
from tcpipe.tables.findings import Finding, Findings
from tcpipe.tables.levels import Streams

if TYPE_CHECKING:
    from tcpipe.formats.logs.log_file import Log
    from tcpipe.formats.logs.message_tables import TableLog
    from tcpipe.formats.logs.table_stamps import Clock, RecipeKeys


@dataclass(frozen=True, slots=True)
class ProposedLine:
    """One line of a recipe that is proposed for a log; one that a person has to decide is a comment.

    ``table`` is the dotted name of its table, "" for keys before all tables; ``note`` is a value of the log, or what
    there is to decide.
    """

    table: str
    key: str
    value: TomlValue
    note: str = ""
    is_certain: bool = True


@dataclass(frozen=True, slots=True)
class ProposedRecipe:
    """The recipe that is proposed for a log: the comment above it, its lines, and a path to try it on."""

    head: Sequence[str]
    lines: Sequence[ProposedLine]
    log: str

    def describe_next_step(self, path: Path) -> str:
        """Return the remaining steps for a recipe at a path."""
        decisions = sum(not line.is_certain for line in self.lines)
        decisions_text = f"{decisions} comments in it are yours to decide; " if decisions else ""
        stated = "" if path.parent.resolve() == Path.cwd() else f" --recipe {shlex.quote(str(path))}"
        return f"{decisions_text}then: tcpipe preflight {shlex.quote(self.log)}{stated}"

    def toml(self) -> str:
        """Return the text of the recipe file; the head of a table is a comment if all its lines are."""
        is_open = any(not line.is_certain for line in self.lines)
        what = " Comments below it need a decision: remove the # and correct the value." if is_open else ""
        text = [f"# Proposed by tcpipe init --from.{what}", *(f"# {clean_line(line)}".rstrip() for line in self.head)]
        tables = dict.fromkeys(line.table for line in sorted(self.lines, key=lambda line: bool(line.table)))
        for table in tables:
            mine = [line for line in self.lines if line.table == table]
            is_head = any(line.is_certain for line in mine) or table.startswith("read.")
            text += ["", *([f"{'' if is_head else '# '}[{table}]"] if table else [])]
            for line in mine:
                note = f"  # {' '.join(line.note.split())}" if line.note else ""
                text.append(f"{'' if line.is_certain else '# '}{line.key} = {as_toml(line.value)}{note}")
        return "\n".join(text) + "\n"


def propose_lines(
    tables: Mapping[str, Keys | Sequence[Keys]], notes: Mapping[str, str], doubt: str
) -> Iterator[ProposedLine]:
    """Yield the lines of a remedy; ``notes`` are by key or array name, ``doubt`` is a decision for the user."""
    for table, keys in tables.items():
        if not isinstance(keys, Mapping):
            yield ProposedLine("", table, keys, "; ".join(filter(None, [notes.get(table), doubt])), not doubt)
            continue
        for key, value in keys.items():
            for name, text in value.items() if isinstance(value, Mapping) else [("", value)]:
                dotted = f"{key}.{name}" if name else key
                yield ProposedLine(table, dotted, text, notes.get(name or key, doubt), not doubt)


def propose_places(frames: Iterable[tuple[str, str]]) -> Iterator[ProposedLine]:
    """Yield a line for each sensor whose extrinsics must be measured; ``frames`` are pairs of role and frame."""
    for role, frame in frames:
        note = f"measure it from base_link: nothing places {frame or 'it'}"
        yield ProposedLine("read.extrinsics", role, make_place_to_measure(role), note, is_certain=False)


_CODES_NOTE = "if these are its codes; else rtklib, ublox, mavlink, navsat, gps_common or words"


def propose_recipe(
    path: Location, *, robot: str | None = None, message_definitions: Path | None = None
) -> ProposedRecipe:
    """Return the recipe for a log, for the first log of a folder, or for the tables in a folder without logs.

    The recipes in use are ignored. Raises `LogError`, `UsageError`: there is no readable log.
    """
    path, others, recipe = path if is_url(path) else Path(path), list[str](), Recipe()
    if isinstance(path, Path) and (is_store(path) or (path / "dataset.json").is_file()):
        raise UsageError(f"{path}: tcpipe wrote this; expected a log or a folder of tables")
    if isinstance(path, Path) and (is_table(path.name) or (path.is_dir() and not is_one_bag(path))):
        logs = list_logs_below(path) if path.is_dir() else []
        if not logs:
            return propose_tables(path)
        others += [f"proposed for the first of {len(logs)} logs"] if len(logs) > 1 else []
        if tables := [file.name for file in list_table_files(path)]:
            others += [f"tables, not used: {', '.join(tables)}; to use them, tcpipe init --from a folder without logs"]
        path = logs[0]
    with open_single_log(path, message_definitions=message_definitions, tables=None) as log:
        config, known = recipe.read, load_profiles(recipe)
        assigned = decide_roles(config, log.topics.values(), robot, known=known)
        proposals = find_proposals(log, assigned, config, known)
        found = propose_for_log(log, assigned, recipe, proposals, is_complete=True)
        return replace(found, head=[*others, *found.head], log=format_path(path))


def propose_for_log(
    log: Log | TableLog, assigned: RoleAssignment, recipe: Recipe, proposals: Iterable[Finding], *, is_complete: bool
) -> ProposedRecipe:
    """Return the recipe for a log, as ``init --from`` writes it: keys that the current recipe does not define.

    ``proposals`` come from `find_proposals`. With ``is_complete``, all messages are read; otherwise values are from the
    first messages, without extrinsics from moving transforms.
    """
    config = find_read_config(recipe, log.topics)
    used = {name: role for role, names in assigned.choices.items() for name in names}
    used |= {name: role.name for role in assigned.roles.values() for name in role.topics}
    used |= {
        proposal.subject.name: proposal.names["role"] for proposal in proposals if proposal.code == "role-proposed"
    }
    static = assigned.static_transforms
    if is_complete:
        tables, placing = log.tables(list(dict.fromkeys([*used, *static]))), assigned
    else:
        tables, placing = {**log.first_rows(used), **log.tables(static)}, replace(assigned, transforms=static)
    columns = {name: make_message_arrays(tables[name]) for name in used if name in tables}
    frames: dict[Role, str] = {}
    for name, arrays in columns.items():
        frame = next(iter(count_frames(arrays, log.topics[name].type_name)), "")
        frames.setdefault(cast("Role", used[name]), frame)
    places = place_frames(log, tables, placing, frames, config)
    head = ["", f"robot: {assigned.robot}, {assigned.robot_why}"]
    for role in assigned.roles.values():
        pose, by = places.get(cast("Role", role.name), (None, ""))
        place = f"; at {np.round(pose.xyz_m, 3).tolist()} m ({by})" if pose and by in ("tf_static", "recipe") else ""
        for name in role.topics:
            sample = _describe_sample(columns.get(name, {}), log.topics[name], role.name)
            head.append(f"{role.name}: {name}{sample}{place}")
    decided = {*assigned.roles, *assigned.choices, *config.topics}
    lacking = [role for role in ("gnss", "imu", "wheel_odometry", "power", "command") if role not in decided]
    head += [f"not found: {', '.join(lacking)}"] if lacking else []
    lines = [*_iterate_questions(assigned, log)]
    for finding in proposals:
        notes = {**finding.names, "power_sources": _format_ranges(finding.numbers)}
        for remedy in finding.remedies:
            lines += propose_lines(remedy.recipe, notes, finding.names.get("doubt", ""))
        if finding.names.get("role") == "gnss" and not any(line.key == "gnss.quality" for line in lines):
            for field in find_quality(list_number_fields(log.topics[finding.subject.name])):
                lines.append(ProposedLine("read.fields", "gnss.quality", field, _CODES_NOTE, is_certain=False))
    unplaced = [
        (role, frames[role]) for role, (_, by) in places.items() if by == "assumed" and role != "wheel_odometry"
    ]
    lines += propose_places(unplaced if is_complete or {*assigned.transforms} <= {*static} else ())
    return ProposedRecipe([*head, "", "These need no line."], lines, str(log.path))


def _format_ranges(numbers: Mapping[str, float]) -> str:
    """Return the lowest to the highest value of each unit, as ``24.1 V to 25.2 V``."""
    units = [name.removeprefix("low_") for name in numbers if name.startswith("low_")]
    ends = ([f"low_{unit}", f"high_{unit}"] for unit in units)
    return ", ".join(" to ".join(format_number(name, numbers[name]) for name in both) for both in ends)


def _iterate_questions(assigned: RoleAssignment, log: Log | TableLog) -> Iterator[ProposedLine]:
    """Yield the lines for roles with several possible topics, and for a command topic that no name identifies."""
    for role, names in assigned.choices.items():
        others = " or ".join(f'["{name}"]' for name in names[1:])
        yield ProposedLine("read.topics", role, [names[0]], f"or {others}", is_certain=False)
    twists = [name for name in assigned.left_out if log.topics[name].type_name in (TWIST, TWIST_STAMPED)]
    if twists and not {"command"} & {*assigned.roles, *assigned.choices}:
        yield ProposedLine("read.topics", "command", twists[:1], "if it commands the velocity", is_certain=False)


def _describe_sample(columns: Columns, topic: Topic, role: str) -> str:
    """Return how many messages a topic has, and values of a message that is usual for its role."""
    count = "" if topic.message_count is None else f", {topic.message_count} messages"
    shown = [
        (name, field.message)
        for name, field in MAPPED[role].items()
        if (field.needed or role == "power") and field.message in columns and topic.type_name == MAPPED_TYPES[role]
    ]  # of an IMU the last three are accelerations, which show gravity
    return count + "".join(f", {name} {format_first(columns[message])}" for name, message in shown[-3:])


# Value, note and certainty of each key of one of the recipe's tables.
_Values: TypeAlias = dict[str, tuple[TomlValue, str, bool]]
_STAMP = re.compile(
    r".*time(stamp|string)?(_(utc|local))?|(.*_)?(t|stamp|gpst|utc|date|epoch|millis|micros|ms_today|ms_of_day)|ms|us"
)
# Parts of a file's name that differ between runs: the last number, date and time, the first word.
_RUN_TEXT = (r"\d+(?=\D*$)", r"\d(?:[\d_.:T-]*\d)?", r"^[^_. -]+(?=[_ -])")
_TRIAL_NS = 60_000_000_000
_SCALE_TOLERANCE = 0.03
# Findings of the first minute that contradict a table of wheel odometry or of an IMU.
_CONTRADICTIONS = ("distance-contradicted", "drives-backwards", "yaw-rate-sign")
# Findings on fixes of the first minute that come from wrong wheel odometry, except where few fixes are rejected.
_DIFFERENCES = ("measurements-rejected", "gnss-contradicts-odometry", "sensor-changed")
_HINTS = {
    "gnss": r"(.*_)?(lat|lon|lng|gps|gnss|alt)\w*",
    "imu": r"(.*_)?(a|g|w|acc|gyr|imu|omega|rot)([a-z]*_?[xyz]|\w{2,})",
    "wheel_odometry": r".*(speed|vel|rpm|wheel|odo|enc|tach).*",
    "power": r".*(volt|curr|amp|power|watt|bat|energy|^[uiv]).*",
}
"""Names in English of columns that may be of a role, in lower case."""


@dataclass(frozen=True, slots=True)
class _Table:
    """A table, or one of several runs: ``file`` as in the recipe, numeric columns, clock, and its stamps' keys."""

    file: str
    path: Path
    names: Sequence[str]
    numbers: Mapping[str, Floats]
    clock: Clock
    stamp_lines: RecipeKeys
    duplicates: Mapping[str, str]

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last time [ns]."""
        ns = self.clock.ns.drop_nulls().to_numpy()
        return int(ns.min()), int(ns.max())

    def overlap_ns(self, other: _Table) -> int:
        """Return the common time of two tables; unknown for stamps of different kinds, except counters."""
        spans = [self.span_ns, other.span_ns]
        kinds = {self.clock.kind, other.clock.kind}
        if len(kinds) > 1:
            return 0 if "counter" in kinds else min(end_ns - start_ns for start_ns, end_ns in spans)
        return max(min(end_ns for _, end_ns in spans) - max(start_ns for start_ns, _ in spans), 0)


def propose_tables(path: Path) -> ProposedRecipe:
    """Return the recipe for tables with known names; its head lists their columns and the unreadable ones.

    Of several tables for a role, the one that shares most time with the others is used. Tables that contradict others in
    the first minute become comments.
    """
    from tcpipe.formats.logs.table_log import read_table_header  # noqa: PLC0415  polars only where a table is read

    folder, files = (path, list_table_files(path)) if path.is_dir() else (path.parent, [path])
    columns, head = dict[Path, Sequence[str]](), [""]
    for file in files:
        try:
            columns[file] = read_table_header(file)
        except LogError as error:
            head.append(str(error))
    tables, roles = list[_Table](), defaultdict[str, list[tuple[_Table, list[ProposedLine]]]](list)
    for name, example in _group_files(folder, columns).items():
        table, unused = _read_table(name, example, columns[example]), ", not used: no stamps"
        if table is not None:
            tables.append(table)
            found = [*_iterate_roles(table)]
            unused = "" if found else ", not used: no known fields"
            for role, mine in found:
                roles[role].append((table, mine))
        head.append(f"{name}{unused}; columns {', '.join(columns[example])}")
    if not roles:
        what = f"{path}: it contains no log, and no table with stamps and columns of known names"
        raise UsageError(what, *filter(None, head))
    reference = max(next(iter(roles.values())), key=lambda candidate: candidate[0].clock.count_stamps())[0]
    lines, log, used, separate = list[ProposedLine](), path, set[str](), dict[str, _Table]()
    for role, candidates in roles.items():
        candidates.sort(key=lambda candidate: (-candidate[0].overlap_ns(reference), -candidate[0].clock.count_stamps()))
        table, mine = candidates[0]
        if not table.overlap_ns(reference):
            separate[role] = table
        lines += mine
        used |= {line.value for line in mine if isinstance(line.value, str)}
        log = table.path if "*" in table.file else log
        head += [f"{other.file} could be {role} as well" for other, _ in candidates[1:]]
    rails = {make_rail_name(line.table) for line in lines if line.key == "columns.voltage"}
    needless = [line for line in lines if line.key == "stamp_zone"][1:]
    needless += [line for line in lines if line.note == NO_VOLTAGE and make_rail_name(line.table) in rails]
    lines = [line for line in lines if line not in needless]
    lines, unaligned = _align_clocks(lines, log, separate, reference) if len(tables) > 1 else (lines, [])
    lines = _try_lines(lines, log, dict.fromkeys(unaligned, _UNALIGNED))
    found_roles = {*roles, *(line.value for line in lines if line.key == "role")}
    for role in ("gnss", "imu", "wheel_odometry", "power"):
        lines += [] if role in found_roles else _propose_rest(role, tables, " ".join(used))
    lines += propose_places((role, "") for role in roles if role in ("gnss", "imu", "pose"))
    return ProposedRecipe(head, lines, format_path(log))


def _group_files(folder: Path, columns: Mapping[Path, Sequence[str]]) -> dict[str, Path]:
    """Return the files of the largest run by their names in the recipe, with * for the part that differs between runs.

    A part of a name differs between runs if every table has several such files with the same columns. Files of one kind
    of table are logs of all sensors; else the numbers may be those of motors.
    """
    names = {file: file.relative_to(folder).as_posix() for file in columns}
    if len(names) == 1:  # the next log of this recorder has another number
        return {re.sub(_RUN_TEXT[1], "*", name, count=1): file for file, name in names.items()}
    for pattern in _RUN_TEXT:
        groups, sizes = defaultdict[str, dict[str, Path]](dict), Counter[str]()
        for file in columns:
            run = "".join(re.findall(pattern, file.name)[:1])
            groups[re.sub(pattern, "*", file.name, count=1)][run] = file
            sizes[run] += file.stat().st_size
        kinds = [{tuple(columns[file]) for file in runs.values()} for runs in groups.values()]
        is_alike = all(len(runs) > 1 and len(kind) == 1 for runs, kind in zip(groups.values(), kinds, strict=True))
        if is_alike and (len(groups) > 1 or match_field_names("gnss", next(iter(columns.values()), ()))):
            best = max(sizes, key=lambda run: sizes[run])
            return {name: runs.get(best, next(iter(runs.values()))) for name, runs in groups.items()}
    shared = re.match(r".*\d(?=[_ -])", commonprefix([*names.values()]))  # noqa: RUF071  of characters, not of folders
    return {f"*{name[shared.end() :]}" if shared else name: file for file, name in names.items()}


def _read_table(file: str, path: Path, names: Sequence[str]) -> _Table | None:
    """Return a table with the stamps that suit best, None without stamps."""
    from tcpipe.formats.logs.table_log import describe_duplicates, read_cells, read_numbers  # noqa: PLC0415  polars only where a table is read
    from tcpipe.formats.logs.table_stamps import choose_clock  # noqa: PLC0415

    is_measured = bool(match_power_fields(names[:1]) or find_quantity(names[0])) or any(
        names[0] in columns.values() for columns, _ in match_table_roles(file, names).values()
    )
    named = [name for name in names if _STAMP.fullmatch(simplify_name(name))]
    candidates = named or ([] if is_measured else names[:1])
    chosen = choose_clock(read_cells(path, stamps=candidates, columns=[]).stamps) if candidates else None
    return _Table(file, path, names, read_numbers(path, names), *chosen, describe_duplicates(names)) if chosen else None


def _iterate_roles(table: _Table) -> Iterator[tuple[str, list[ProposedLine]]]:
    """Yield each role that a table has columns for, with its lines."""
    names = [name for name in table.names if name != table.stamp_lines["stamp"][0]]
    for role, (columns, doubt) in match_table_roles(table.file, names).items():
        if lines := _make_lines(table, role, role, columns, doubt):
            yield role, lines
    live = [name for name in names if np.any(np.nan_to_num(table.numbers.get(name, np.zeros(1))))]
    matched = match_power_fields([quote(name) for name in live])
    rails, doubt = (matched.rails, matched.doubt) if matched else ((), "")
    quantity = find_quantity(table.path.stem) if len(table.names) == 2 else None
    counters = [name for name in table.names if split_unit(name)[1] in UNITS["J"]]
    found: dict[str, Mapping[str, str]] = {
        f"power_{number}" if len(rails) > 1 else "power": rail for number, rail in enumerate(rails, 1)
    }
    if quantity and not found:
        found = {re.sub(r"\W+", "_", table.path.stem): {quantity: table.names[1]}}
    elif counters and not found:
        found = {"power": {"energy": counters[0]}}
    for name, rail in found.items():
        if lines := _make_lines(table, name, "power", rail, doubt):
            yield name, lines


def _make_lines(table: _Table, name: str, role: str, columns: Mapping[str, str], doubt: str = "") -> list[ProposedLine]:
    """Return the lines of a table's mapping; [] if its values contradict the names of its columns."""
    values, units = _read_values(table, role, columns)
    mapped = {field: text for field, text in columns.items() if field in values}
    judged = None if _list_lacking(role, mapped) else _judge_values(role, mapped, values)
    if judged is None:
        return []
    mapped, unclear = judged
    twice = [note for column, note in table.duplicates.items() if column in " ".join(mapped.values())]
    doubt = doubt or unclear or "".join(twice[:1])
    keys: _Values = {"role": ("power", "", True)} if name != role else {}
    keys |= {"file": (table.file, doubt, True), **table.stamp_lines}
    for field, text in mapped.items():
        is_assumed = text.endswith(_OVER_TRACK)
        sample = format_first(values[field]) if field != "quality" else ""
        keys[f"columns.{field}"] = (text, _TRACK_NOTE if is_assumed else sample, not is_assumed)
    keys |= {f"units.{field}": (units[field], "", keys[f"columns.{field}"][2]) for field in mapped if field in units}
    for source in find_quality(table.names) if role == "gnss" and "quality" not in mapped else ():
        column = source.partition(": ")[2]
        is_text = column not in table.numbers
        keys["columns.quality"] = (f"words: {column}", "", True) if is_text else (source, _CODES_NOTE, False)
    if role == "power" and set(mapped) == {"current"}:
        keys |= {key: (volt, NO_VOLTAGE, False) for key, volt in NOMINAL.items()}
    return [
        ProposedLine(f"tables.{name}", key, value, note, is_certain=not doubt and sure)
        for key, (value, note, sure) in keys.items()
    ]


def _list_lacking(role: str, fields: Collection[str]) -> list[str]:
    """Return the fields that a role needs and that are missing; power needs at least one of voltage and current."""
    needed = [field for field, known in MAPPED[role].items() if known.needed and field not in fields]
    return needed if fields or needed else ["voltage", "current"]


_OVER_TRACK, _TRACK_NOTE = "/ 0.5", "state the track width in place of 0.5 m"
_TIMES_RADIUS = " * 0.1"  # end of a speed by revolutions, for wheels with a radius of 0.1 m


def _read_values(table: _Table, role: str, columns: Mapping[str, str]) -> tuple[dict[str, Floats], dict[str, str]]:
    """Return the values of fields in their units, without columns that have no numbers, and the units to state.

    A unit must be stated for an expression whose columns have another unit than the field.
    """
    values, units = dict[str, Floats](), dict[str, str]()
    for field, text in columns.items():
        unit, expression = MAPPED[role][field].unit, parse_expression(text, table.names)
        other_unit = None if expression.column else find_other_unit(expression, unit)
        units |= {field: other_unit if other_unit in UNITS[unit] else unit} if other_unit else {}
        read = read_fields("", role, {field: text}, units, table.names)
        if field == "quality":
            values[field] = np.zeros(1)
        elif isinstance(read, dict) and {name for name, _ in expression.operands()} <= table.numbers.keys():
            rows = len(next(iter(table.numbers.values())))
            values[field] = read[field].evaluate(lambda name, _: table.numbers[name], rows)
    return values, units


def _judge_values(
    role: str, mapped: Mapping[str, str], values: Mapping[str, Floats]
) -> tuple[dict[str, str], str] | None:
    """Return the columns with factors that their values suggest, and doubts; None if they are not a power."""
    if role in ("gnss", "imu"):
        judged, doubt = judge_fields(role, {field: quote(text) for field, text in mapped.items()}, values)
        return {field: mapped[field] if text == quote(mapped[field]) else text for field, text in judged.items()}, doubt
    if role == "power" and not {"power", "energy"} & set(values):
        volt, amp = (values.get(field, np.full(1, np.nan)) for field in ("voltage", "current"))
        return None if find_rejection(RailReadings("", volt, amp), "", {}) else (dict(mapped), "")
    if "energy" in values and np.ptp(values["energy"]) == 0.0:
        return None
    fastest = np.nanquantile(np.abs(values.get("linear_x", np.zeros(1))), 0.99)
    return dict(mapped), "its largest values are no m/s: state the unit" if fastest > MAX_PLAUSIBLE_MPS else ""


def _propose_rest(role: str, tables: Sequence[_Table], used: str) -> Iterator[ProposedLine]:
    """Yield a table for a role that was not found, as comments, for the first file with likely columns."""
    units = {unit for field in MAPPED[role].values() if field.unit not in ("1", "m") for unit in UNITS[field.unit]}
    for table in tables:
        stamp = table.stamp_lines["stamp"][0]
        free = [name for name in table.numbers if name not in used and name != stamp]
        likely = [of for of in free if re.fullmatch(_HINTS[role], simplify_name(of)) or split_unit(of)[1] in units]
        if not likely:
            continue
        values = (", ".join(f"{value:.4g}" for value in table.numbers[name][:3]) for name in likely)
        pick = ", ".join(f"{name} ({three})" for name, three in zip(likely, values, strict=True))
        fields = {**dict.fromkeys(_list_lacking(role, ()), "column?"), **match_known_fields(role, free)}
        keys = {"file": table.file, "stamp": stamp, **{f"columns.{field}": name for field, name in fields.items()}}
        for key, value in keys.items():
            note = f"{role} is not recognised: pick from {pick}" if key == "file" else ""
            yield ProposedLine(f"tables.{role}", key, value, note, is_certain=False)
        return


_UNALIGNED = "no time in common with the others: another clock, or another drive"


def _align_clocks(
    lines: Sequence[ProposedLine], log: Path, separate: Mapping[str, _Table], reference: _Table
) -> tuple[list[ProposedLine], list[str]]:
    """Return the lines with the offsets of tables on another clock, and the names of tables whose offsets are unknown.

    Offsets are found by speed and turn rate. The tables ``separate`` have no time in common with the reference: their
    offsets are searched up to five minutes around the offset at which both tables begin at the same time. A table
    without motion has the clock of a table with which it has time in common.
    """
    from tcpipe.stages.fuse_clocks import find_late_sensors  # noqa: PLC0415  kernels load only where there is work

    begin_s = {name: (reference.span_ns[0] - table.span_ns[0]) / 1e9 for name, table in separate.items()}
    same_start = [ProposedLine(f"tables.{name}", "offset_s", each) for name, each in begin_s.items()]
    offset_s = dict[str, float]()
    with suppress(TcpipeError):
        recipe = _make_recipe([*lines, *same_start])
        late_s = find_late_sensors(_read_streams(log, recipe), recipe.fuse)
        offset_s = {name: round(begin_s.get(name, 0.0) - each, 2) for name, each in late_s.items()}
    for name, table in separate.items():
        clocks = [each for other, each in offset_s.items() if other in separate and separate[other].overlap_ns(table)]
        offset_s |= {name: clocks[0]} if name not in offset_s and clocks else {}
    aligned = [
        ProposedLine(f"tables.{name}", "offset_s", each, "aligned by speed and turns")
        for name, each in offset_s.items()
        if name in separate or abs(each) > 1.0  # fusing corrects less
    ]
    return [*lines, *aligned], [name for name in separate if name not in offset_s]


def _make_recipe(lines: Sequence[ProposedLine]) -> Recipe:
    """Return the recipe of the tables in certain lines, and in lines of time zone and format that a trial confirms."""
    tried = [line for line in lines if line.is_certain or line.key in ("stamp_zone", "stamp_format")]
    text = ProposedRecipe([], [replace(line, is_certain=True) for line in tried], "").toml()
    tables = {name: of for name, of in tomllib.loads(text).get("tables", {}).items() if "columns" in of}
    return from_values(Recipe, {"tables": tables}, where="proposed recipe")


def _try_lines(lines: Sequence[ProposedLine], log: Path, reasons: Mapping[str, str]) -> list[ProposedLine]:
    """Return the lines as the first minute corrects and completes them; tables that contradict others become comments.

    So do those of ``reasons``, by name of the table; they are not tried.
    """
    reasons = {f"tables.{name}": why for name, why in reasons.items()}
    recipe = _make_recipe([line for line in lines if line.table not in reasons])
    findings: Sequence[Finding] = ()
    try:
        findings = _fuse_first_minute(log, recipe) if recipe.tables else ()
    except LogError as error:
        found = ((re.search(r"recipe (tables\.\w+)", problem), problem) for problem in error.problems)
        reasons |= {named[1]: problem.partition(": ")[2] for named, problem in found if named}
    except TcpipeError:  # too little for a track; preflight explains it
        pass
    for finding in findings:
        why = f"in the first minute: {describe_finding(finding)}"
        blamed = finding.names.get("suspect", finding.subject.name)
        if finding.code in _DIFFERENCES and finding.subject.name == "gnss":  # a minute of fixes is seldom wrong
            reasons |= {"tables.wheel_odometry": why} if finding.numbers.get("rejected_fraction", 1.0) > 0.2 else {}
        elif finding.code == "distance-contradicted" and blamed == "wheel_odometry" and "suspect" not in finding.names:
            lines = _scale_speed(lines, finding.numbers["distance_ratio"], why)
        elif finding.code in _CONTRADICTIONS and blamed in ("imu", "wheel_odometry"):
            reasons[f"tables.{blamed}"] = why
        elif finding.code == "imu-units":
            remedies = (line for remedy in finding.remedies for line in propose_lines(remedy.recipe, {}, ""))
            lines = [*lines, *(replace(line, note=why) for line in remedies)]
        elif finding.code == "odometry-scale" and blamed == "wheel_odometry":
            lines = _scale_speed(lines, finding.numbers["scale"], why)
    if any(str(line.value).endswith(_TIMES_RADIUS) for line in lines):
        reasons["tables.wheel_odometry"] = "state the wheels' radius in place of 0.1 m"
    return [
        replace(line, is_certain=False, note=reasons[line.table] if line.key == "file" else line.note)
        if line.table in reasons
        else line
        for line in lines
    ]


def _scale_speed(lines: Sequence[ProposedLine], scale: float, why: str) -> list[ProposedLine]:
    """Return the lines with the radius of wheels by the scale of their speed, or with the unit that the scale shows."""
    of_revolutions = [line for line in lines if str(line.value).endswith(_TIMES_RADIUS)]
    if of_revolutions:
        text = str(of_revolutions[0].value).removesuffix(_TIMES_RADIUS)
        scaled = replace(of_revolutions[0], value=f"{text} * {0.1 / scale:.4g}", note=f"the wheels' radius {why}")
        return [scaled if line in of_revolutions else line for line in lines]
    unit = next((unit for unit, mps in UNITS["m/s"].items() if abs(scale * mps - 1.0) < _SCALE_TOLERANCE), "m/s")
    is_stated = unit == "m/s" or any(line.key == "units.linear_x" for line in lines)
    return [*lines] if is_stated else [*lines, ProposedLine("tables.wheel_odometry", "units.linear_x", unit, why)]


def _fuse_first_minute(log: Path, recipe: Recipe) -> Findings:
    """Return the findings of the first minute of a log."""
    from tcpipe.stages.fuse import fuse_run  # noqa: PLC0415  kernels load only where there is work

    streams = _read_streams(log, recipe)
    end_ns = min(pc.min(table["stamp_ns"]).as_py() for table in streams.tables.values()) + _TRIAL_NS
    cut = {role: table.filter(pc.less(table["stamp_ns"], end_ns)) for role, table in streams.tables.items()}
    streams = replace(streams, tables={role: table for role, table in cut.items() if table.num_rows})
    return fuse_run(streams, recipe.fuse, run_id="trial").info.report.findings


def _read_streams(log: Path, recipe: Recipe) -> Streams:
    with open_single_log(log, tables=recipe.tables) as opened:
        return read_run(opened, find_read_config(recipe, opened.topics), robot=None, known=load_profiles(recipe))
