"""The recipe that a log, or a folder of tables, proposes: what is found in it, with a value of each, and what a person has to decide."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from tcpipe.errors import UsageError, clean_line
from tcpipe.formats.finding_lines import format_number
from tcpipe.formats.logs.log_file import list_logs_below
from tcpipe.formats.logs.log_joining import open_single_log
from tcpipe.formats.logs.rosbag2 import is_one_bag
from tcpipe.formats.logs.table_folders import is_table, list_table_files
from tcpipe.formats.object_storage import format_path, is_url
from tcpipe.formats.recipe_toml import load_profiles
from tcpipe.logs.field_mapping import MAPPED, MAPPED_TYPES, Columns, list_number_fields
from tcpipe.logs.fix_quality import find_quality
from tcpipe.logs.messages import count_frames
from tcpipe.logs.roles import TWIST, TWIST_STAMPED, RoleAssignment
from tcpipe.logs.topics import Topic
from tcpipe.power.sources import find_sources, list_power_lists, read_rails
from tcpipe.recipe import Recipe, Role
from tcpipe.recipe.checking import as_toml
from tcpipe.recipe.suggestions import Keys, TomlValue, format_first, make_place_to_measure
from tcpipe.robots import Profiles
from tcpipe.stages.message_arrays import make_message_arrays
from tcpipe.stages.proposals import find_proposals
from tcpipe.stages.read import decide_roles, find_read_config
from tcpipe.stages.read_sources import place_frames
from tcpipe.store import is_store
from tcpipe.tables.findings import Finding

if TYPE_CHECKING:
    from tcpipe.formats.logs.log_file import Log
    from tcpipe.formats.logs.message_tables import TableLog


@dataclass(frozen=True, slots=True)
class ProposedLine:
    """One line of a recipe that is proposed for a log; one that a person has to decide is a comment.

    ``table`` is the dotted name of its table, "" for keys before all tables; ``note`` is a value of the log, or what there is to decide.
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

    def __str__(self) -> str:
        """Return what is left to do."""
        decisions = sum(not line.is_certain for line in self.lines)
        left = f"{decisions} comments in it are yours to decide; " if decisions else ""
        return f"{left}then: tcpipe preflight {shlex.quote(self.log)}"

    def toml(self) -> str:
        """Return the file. The head of a table of decisions alone is a comment too; those of ``read`` and ``mask`` may be empty."""
        is_open = any(not line.is_certain for line in self.lines)
        what = " Comments below it need a decision: remove the # and correct the value." if is_open else ""
        text = [f"# Proposed by tcpipe init --from.{what}", *(f"# {clean_line(line)}".rstrip() for line in self.head)]
        tables = dict.fromkeys(line.table for line in sorted(self.lines, key=lambda line: bool(line.table)))
        for table in tables:
            mine = [line for line in self.lines if line.table == table]
            is_head = any(line.is_certain for line in mine) or table.startswith(("read.", "mask"))
            text += ["", *([f"{'' if is_head else '# '}[{table}]"] if table else [])]
            for line in mine:
                note = f"  # {' '.join(line.note.split())}" if line.note else ""
                text.append(f"{'' if line.is_certain else '# '}{line.key} = {as_toml(line.value)}{note}")
        return "\n".join(text) + "\n"


def propose_lines(
    tables: Mapping[str, Keys | Sequence[Keys]], notes: Mapping[str, str], doubt: str
) -> Iterator[ProposedLine]:
    """Yield the lines of a remedy's tables; ``notes`` are by the name of a key or an array, ``doubt`` is what they leave to a person."""
    for table, keys in tables.items():
        if not isinstance(keys, Mapping):
            yield ProposedLine("", table, keys, "; ".join(filter(None, [notes.get(table), doubt])), not doubt)
            continue
        for key, value in keys.items():
            inner = (
                {f"{key}.{name}": text for name, text in value.items()} if isinstance(value, Mapping) else {key: value}
            )
            for name, text in inner.items():
                yield ProposedLine(table, name, text, notes.get(name.rpartition(".")[2], doubt), not doubt)


def propose_decisions(
    frames: Iterable[tuple[str, str]], roles: Collection[str], *, keeps_reversing: bool = False
) -> Iterator[ProposedLine]:
    """Yield what only a person knows: where sensors are mounted, by role and frame, and whether a robot with fixes alone reversed."""
    for role, frame in frames:
        note = f"measure it from base_link: nothing places {frame or 'it'}"
        yield ProposedLine("read.extrinsics", role, make_place_to_measure(role), note, is_certain=False)
    if not keeps_reversing and "gnss" in roles and not {"wheel_odometry", "visual_odometry"} & {*roles}:
        note = "if it never reversed: fixes alone do not tell forward from backward"
        yield ProposedLine("mask", "keep_reversing", True, note, is_certain=False)


def propose_quality(table: str, key: str, source: str) -> ProposedLine:
    """Return the line of a fix quality whose codes no name states."""
    note = "if these are its codes; else rtklib, ublox, mavlink, navsat, gps_common or words"
    return ProposedLine(table, key, source, note, is_certain=False)


def propose_recipe(
    path: Path | str, *, robot: str | None = None, message_definitions: Path | None = None
) -> ProposedRecipe:
    """Return the recipe for a log, or the first of a folder's, or the tables in a folder, whatever recipe there is.

    Raises `LogError`, `UsageError`: there is nothing to read.
    """
    path, others, recipe = path if is_url(path) else Path(path), list[str](), Recipe()
    if isinstance(path, Path) and (is_store(path) or (path / "dataset.json").is_file()):
        raise UsageError(f"{path}: tcpipe wrote this; expected a log or a folder of tables")
    if isinstance(path, Path) and (is_table(path.name) or (path.is_dir() and not is_one_bag(path))):
        logs = list_logs_below(path) if path.is_dir() else []
        if not logs:
            return _propose_tables(path)
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


def _propose_tables(path: Path) -> ProposedRecipe:
    from tcpipe.pipeline.table_proposals import propose_tables  # noqa: PLC0415  polars only where a table is read

    found = propose_tables(path)
    if not found.lines:
        what = f"{path}: it contains no log, and no table with stamps and columns of known names"
        raise UsageError(what, *filter(None, found.head))
    return found


def propose_for_log(
    log: Log | TableLog, assigned: RoleAssignment, recipe: Recipe, proposals: Iterable[Finding], *, is_complete: bool
) -> ProposedRecipe:
    """Return the recipe for a log as ``init --from`` writes it: what a recipe does not settle yet.

    ``proposals`` are what `find_proposals` finds in it. Unless it ``is_complete``, values are those of the first messages, and what only
    moving transforms could tell of a sensor's place is left out.
    """
    config, known = find_read_config(recipe, log.topics), load_profiles(recipe)
    used = {name: role for role, names in assigned.choices.items() for name in names}
    used |= {name: role.name for role in assigned.roles.values() for name in role.topics}
    used |= {
        proposal.subject.name: proposal.names["role"] for proposal in proposals if proposal.code == "role-proposed"
    }
    types = {name: log.topics[name].type_name for name in used}
    unread = set[str]()
    if is_complete:
        tables = log.tables(list(dict.fromkeys([*used, *assigned.static_transforms])))
    else:
        tables = {**log.first_rows(used), **log.tables(assigned.static_transforms)}
        unread = {*assigned.transforms} - {*assigned.static_transforms}
        assigned = replace(assigned, transforms=assigned.static_transforms)
    lists = {name: list_power_lists(kind, known.power_sources) for name, kind in types.items()}
    columns = {name: make_message_arrays(tables[name], lists[name]) for name in used if name in tables}
    frames: dict[Role, str] = {}
    for name, arrays in columns.items():
        frames.setdefault(cast("Role", used[name]), next(iter(count_frames(arrays, types[name])), ""))
    places = place_frames(log, tables, assigned, frames, config)
    head = ["", f"robot: {assigned.robot}, {assigned.robot_why}"]
    for role in assigned.roles.values():
        pose, by = places.get(cast("Role", role.name), (None, ""))
        place = f"; at {np.round(pose.xyz_m, 3).tolist()} m ({by})" if pose and by in ("tf_static", "recipe") else ""
        for name in role.topics:
            sample = _describe_sample(columns.get(name, {}), log.topics[name], role.name, (assigned, known))
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
            fields = find_quality(list_number_fields(log.topics[finding.subject.name]))
            lines += [propose_quality("read.fields", "gnss.quality", field) for field in fields]
    unplaced = [
        (role, frames[role])
        for role, (_, by) in places.items()
        if by == "assumed" and role != "wheel_odometry" and not unread
    ]
    lines += propose_decisions(unplaced, {*used.values()}, keeps_reversing=recipe.mask.keep_reversing)
    return ProposedRecipe([*head, "", "These need no line."], lines, str(log.path))


def _format_ranges(numbers: Mapping[str, float]) -> str:
    """Return the lowest to the highest value of each unit, as ``24.1 V to 25.2 V``."""
    units = [name.removeprefix("low_") for name in numbers if name.startswith("low_")]
    ends = {unit: [(name, numbers[name]) for name in (f"low_{unit}", f"high_{unit}")] for unit in units}
    return ", ".join(" to ".join(format_number(*end) for end in range_ends) for range_ends in ends.values())


def _iterate_questions(assigned: RoleAssignment, log: Log | TableLog) -> Iterator[ProposedLine]:
    """Yield the lines for roles that several topics could be used as, and for a command that no name shows."""
    for role, names in assigned.choices.items():
        others = " or ".join(f'["{name}"]' for name in names[1:])
        yield ProposedLine("read.topics", role, [names[0]], f"or {others}", is_certain=False)
    twists = [name for name in assigned.left_out if log.topics[name].type_name in (TWIST, TWIST_STAMPED)]
    if twists and not {"command"} & {*assigned.roles, *assigned.choices}:
        yield ProposedLine("read.topics", "command", twists[:1], "if it commands the velocity", is_certain=False)


def _describe_sample(columns: Columns, topic: Topic, role: str, by: tuple[RoleAssignment, Profiles]) -> str:
    """Return how many messages a topic has, and values by what its role needs."""
    (assigned, known), kind = by, topic.type_name
    count = "" if topic.message_count is None else f", {topic.message_count} messages"
    if role == "power":
        platform = known.robots[assigned.robot].platform
        choices = find_sources(kind, topic.name, known.power_sources, platform=platform, husky_power="battery")
        rails = [] if isinstance(choices, Finding) else read_rails(columns, choices[0], topic.name)
        read = [] if isinstance(rails, Finding) else rails
        return count + "".join(
            f", {format_first(rail.voltage_volt)} V, {format_first(rail.current_amp)} A" for rail in read
        )
    needed = [
        (name, definition.message)
        for name, definition in MAPPED[role].items()
        if definition.needed and definition.message in columns
    ]
    named = needed[-3:] if kind == MAPPED_TYPES[role] else []  # of an IMU the accelerations, which show gravity
    return count + "".join(f", {name} {format_first(columns[message])}" for name, message in named)
