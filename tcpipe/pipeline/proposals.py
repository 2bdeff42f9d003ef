"""The recipe that a log, or a folder of tables, proposes: what is found in it, with a value of each, and what a person has to decide."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pyarrow as pa

from tcpipe.errors import UsageError
from tcpipe.formats.logs.log_file import list_logs_below
from tcpipe.formats.logs.log_joining import open_single_log
from tcpipe.formats.logs.rosbag2 import is_one_bag
from tcpipe.formats.logs.table_folders import is_table, list_table_files
from tcpipe.formats.object_storage import format_path, is_url
from tcpipe.formats.recipe_toml import load_profiles, parse_recipe, parse_toml
from tcpipe.logs.field_mapping import MAPPED, MAPPED_TYPES
from tcpipe.logs.messages import LOG_TIME, count_frames
from tcpipe.logs.roles import TWIST, TWIST_STAMPED, RoleAssignment
from tcpipe.power.sources import Columns, find_sources, list_power_lists, read_rails
from tcpipe.recipe import ReadConfig, Recipe, Role
from tcpipe.recipe.suggestions import ProposedLine, format_first, format_proposals, propose_extrinsics
from tcpipe.robots import Profiles
from tcpipe.stages.message_arrays import make_message_arrays
from tcpipe.stages.proposals import find_proposals
from tcpipe.stages.read_roles import decide_roles
from tcpipe.stages.read_sources import place_frames
from tcpipe.tables.findings import Finding

if TYPE_CHECKING:
    from tcpipe.formats.logs.log_file import Log
    from tcpipe.formats.logs.table_log import TableLog


@dataclass(frozen=True, slots=True)
class ProposedRecipe:
    """A recipe to write, the decisions in it that are comments, and a log to try it on."""

    text: str
    decisions: int
    log: str

    def __str__(self) -> str:
        """Return what is left to do."""
        left = f"{self.decisions} comments in it are yours to decide; " if self.decisions else ""
        return f"{left}then: tcpipe preflight {shlex.quote(self.log)}"


def propose_recipe(
    path: Path | str, *, robot: str | None = None, message_definitions: Path | None = None
) -> ProposedRecipe:
    """Return the recipe that a log proposes, or the first of a folder's, or the tables in a folder.

    Raises
    ------
    LogError, UsageError : there is nothing to read.
    """
    if not is_url(path):
        path = Path(path)
        if not path.exists():
            raise UsageError(f"{path}: there is no such file or directory")
        if path.is_dir() and not is_one_bag(path):
            if logs := list_logs_below(path):
                path = logs[0]
            elif tables := list_table_files(path):
                return _propose_for_tables(path, tables)
        elif is_table(path.name):
            return _propose_for_tables(path.parent, [path])
    with open_single_log(path, message_definitions=message_definitions, tables=None) as log:
        head, lines = _propose_for_log(log, robot)
    return _make_recipe(head, lines, format_path(path))


def _propose_for_tables(folder: Path, files: Sequence[Path]) -> ProposedRecipe:
    from tcpipe.pipeline.table_proposals import propose_tables  # noqa: PLC0415  polars only where a table is read

    found = propose_tables(folder, files)
    if not found.lines:
        raise UsageError(f"{folder}: no column of its tables has a known name", *found.problems.values())
    return _make_recipe(found.head, found.lines, format_path(found.log))


def _make_recipe(head: Sequence[str], lines: Sequence[ProposedLine], log: str) -> ProposedRecipe:
    text = format_proposals(head, lines)
    parse_recipe(parse_toml(text), where="proposed recipe")
    return ProposedRecipe(text, sum(not line.is_certain for line in lines), log)


@dataclass(frozen=True, slots=True)
class _Found:
    """What a log holds: its roles, the messages of their topics, what is proposed for others."""

    log: Log | TableLog
    assigned: RoleAssignment
    known: Profiles
    proposals: tuple[Finding, ...]
    tables: Mapping[str, pa.Table]
    columns: Mapping[str, Columns]


def _propose_for_log(log: Log | TableLog, robot: str | None) -> tuple[list[str], list[ProposedLine]]:
    config, known = ReadConfig(), load_profiles(Recipe())
    assigned = decide_roles(config, log.topics.values(), robot, known=known)
    proposals = find_proposals(log, assigned, config, known)
    used = _list_used(assigned, proposals)
    tables = log.tables(list(dict.fromkeys([*used, *assigned.static_transforms])))
    lists = {name: list_power_lists(log.topics[name].type_name, known.power_sources) for name in used}
    columns = {name: make_message_arrays(tables[name], lists[name]) for name in used if name in tables}
    found = _Found(log, assigned, known, proposals, tables, columns)
    frames = {
        cast("Role", role): next(iter(count_frames(columns[name], log.topics[name].type_name)), "")
        for name, role in used.items()
        if name in columns
    }
    places = place_frames(log, tables, assigned, frames, config)
    head = [
        f"Proposed from {log.path.name} by tcpipe init. Comments need a decision: remove the # and correct the value.",
        "",
    ]
    head += [f"robot: {assigned.robot}, {assigned.robot_why}"]
    for role in assigned.roles.values():
        pose, placed_by = places.get(cast("Role", role.name), (None, ""))
        place = f"; at {np.round(pose.xyz_m, 3).tolist()} m ({placed_by})" if pose and placed_by == "tf_static" else ""
        head += [f"{role.name}: {name}{_sample(found, name, role.name)}{place}" for name in role.topics]
    lacking = [role for role in ("gnss", "imu", "wheel_odometry", "power", "command") if role not in {*assigned.roles, *assigned.choices}]
    head += [f"not found: {', '.join(lacking)}"] if lacking else []
    unplaced = [(role, frames[role]) for role, (_, placed_by) in places.items() if placed_by == "assumed"]
    lines = [*_iterate_power(found), *_iterate_topics(found), *_iterate_fields(found), *propose_extrinsics(unplaced)]
    return [*head, "", "What is above needs no line." if lines else "Nothing is proposed beyond."], lines


def _list_used(assigned: RoleAssignment, proposals: Sequence[Finding]) -> dict[str, str]:
    """Return the role of each topic that is used, could be, or is proposed as another than power."""
    used = {name: role for role, names in assigned.choices.items() for name in names}
    used |= {name: role.name for role in assigned.roles.values() for name in role.topics}
    return used | {of.subject.name: of.names["role"] for of in proposals if of.code == "role-proposed"}


def _get_keys(finding: Finding, table: str) -> Any:
    return next((of.recipe[table] for of in finding.remedies if table in of.recipe), {})


def _iterate_power(found: _Found) -> Iterator[ProposedLine]:
    for of in found.proposals:
        if sources := _get_keys(of, "power_sources"):
            doubt, numbers = of.names.get("doubt", ""), of.numbers
            units = [
                (unit, sign) for unit, sign in (("volt", "V"), ("amp", "A"), ("watt", "W")) if f"low_{unit}" in numbers
            ]
            ranges = [f"{numbers[f'low_{unit}']:.3g} to {numbers[f'high_{unit}']:.3g} {sign}" for unit, sign in units]
            yield ProposedLine(
                "", "power_sources", sources, "; ".join(filter(None, [*ranges, doubt])), is_certain=not doubt
            )


def _iterate_topics(found: _Found) -> Iterator[ProposedLine]:
    for role, names in found.assigned.choices.items():
        others = "".join(f' or ["{name}"]' for name in names[1:])
        yield ProposedLine("read.topics", role, [names[0]], others.strip(), is_certain=False)
    for of in found.proposals:
        doubt = of.names.get("doubt", "")
        for role, names in _get_keys(of, "read.topics").items():
            yield ProposedLine("read.topics", role, names, doubt, is_certain=not doubt)
    twists = [name for name in found.assigned.left_out if found.log.topics[name].type_name in (TWIST, TWIST_STAMPED)]
    if twists and not {"command"} & {*found.assigned.roles, *found.assigned.choices}:
        yield ProposedLine("read.topics", "command", [twists[0]], "if it commands the velocity", is_certain=False)


def _iterate_fields(found: _Found) -> Iterator[ProposedLine]:
    for of in found.proposals:
        for role, fields in _get_keys(of, "read.fields").items():
            for field, text in fields.items():
                note = f"{format_first(found.columns[of.subject.name][text.partition(' ')[0]])} in the log"
                yield ProposedLine("read.fields", f"{role}.{field}", text, note, is_certain="doubt" not in of.names)


def _sample(found: _Found, topic: str, role: str) -> str:
    """Return the rate of a topic, and values by what its role needs."""
    columns, kind = found.columns.get(topic, {}), found.log.topics[topic].type_name
    rate = f", {len(columns[LOG_TIME])} messages" if columns else ""
    if role == "power":
        platform = found.known.robots[found.assigned.robot].platform
        choices = find_sources(kind, topic, found.known.power_sources, platform=platform, husky_power="battery")
        rails = [] if isinstance(choices, Finding) else read_rails(columns, choices[0], topic)
        known = [] if isinstance(rails, Finding) else rails
        return rate + "".join(f", {format_first(of.voltage_volt)} V, {format_first(of.current_amp)} A" for of in known)
    needed = [(name, of.message) for name, of in MAPPED[role].items() if of.needed and of.message in columns]
    named = needed[-3:] if kind == MAPPED_TYPES[role] else []  # of an IMU the accelerations, which show gravity
    return rate + "".join(f", {name} {format_first(columns[message])}" for name, message in named)
