"""The recipe that a log, or a folder of tables, proposes: what is found in it, with a value of each, and what a person has to decide."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.errors import UsageError
from tcpipe.formats.logs.log_file import list_logs_below
from tcpipe.formats.logs.log_joining import open_single_log
from tcpipe.formats.logs.rosbag2 import is_one_bag
from tcpipe.formats.logs.table_folders import is_table, list_table_files
from tcpipe.formats.object_storage import format_path, is_url
from tcpipe.formats.recipe_toml import load_profiles, parse_recipe, parse_toml
from tcpipe.logs.field_mapping import MAPPED, MAPPED_TYPES
from tcpipe.logs.messages import count_frames
from tcpipe.logs.roles import TWIST, TWIST_STAMPED, RoleAssignment
from tcpipe.power.sources import find_sources, list_power_lists, read_rails
from tcpipe.recipe import ReadConfig, Recipe, Role
from tcpipe.recipe.suggestions import ProposedLine, format_proposals
from tcpipe.robots import GENERIC, Profiles
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


def _make_recipe(head: Sequence[str], lines: Sequence[ProposedLine], log: str) -> ProposedRecipe:
    text = format_proposals(head, lines)
    parse_recipe(parse_toml(text), where="proposed recipe")
    return ProposedRecipe(text, sum(not line.is_certain for line in lines), log)


def _propose_for_tables(folder: Path, files: Sequence[Path]) -> ProposedRecipe:
    raise NotImplementedError


def _propose_for_log(log: Log | TableLog, robot: str | None) -> tuple[list[str], list[ProposedLine]]:
    config, known = ReadConfig(), load_profiles(Recipe())
    cast_ = decide_roles(config, log.topics.values(), robot, known=known)
    wanted = {name: role for role in cast_.roles.values() for name in role.topics}
    proposals = find_proposals(log, cast_, config, known)
    mapped = {
        name: role
        for of in proposals
        for role, (name, *_) in _get(of, "read.topics").items()
        if of.code == "role-proposed"
    }
    asked = {name: role for role, names in cast_.choices.items() for name in names}
    tables = log.tables(list(dict.fromkeys([*wanted, *mapped, *asked, *cast_.static_transforms])))
    lists = {name: list_power_lists(log.topics[name].type_name, known.power_sources) for name in wanted}
    columns = {name: make_message_arrays(table, lists.get(name, ())) for name, table in tables.items()}
    samples = {
        name: _sample(columns[name], log.topics[name].type_name, name, role.name, cast_, known)
        for name, role in wanted.items()
        if name in columns
    }
    places = _place(log, tables, columns, cast_, mapped, config)
    head = [
        f"Proposed from {log.path.name} by tcpipe init. Comments need a decision: remove the # and correct the value.",
        "",
    ]
    head += [
        f"{role.name}: {name}, {role.type_name}: {role.why}{samples.get(name, '')}{places.get(role.name, ('', ''))[1]}"
        for name, role in wanted.items()
    ]
    head += ["", "These need no line; the lines below are for the rest."] if wanted else []
    return head, [*_iterate_lines(cast_, proposals, columns, log, places)]


def _iterate_lines(
    assigned: RoleAssignment,
    proposals: Sequence[Finding],
    columns: Mapping[str, Mapping[str, NDArray[Any]]],
    log: Log | TableLog,
    places: Mapping[str, tuple[str, str]],
) -> Iterator[ProposedLine]:
    """Yield the lines for what the roles lack, with decisions as comments."""
    if assigned.robot == GENERIC:
        yield ProposedLine(
            "",
            "robot",
            "NAME",
            "the robot's profile, with its limits under [robots.NAME]; without one: generic",
            is_certain=False,
        )
    for of in proposals:
        doubt, numbers = of.names.get("doubt", ""), of.numbers
        ranges = [
            f"{numbers[f'low_{unit}']:.4g} to {numbers[f'high_{unit}']:.4g} {sign}"
            for unit, sign in (("volt", "V"), ("amp", "A"), ("watt", "W"))
            if f"low_{unit}" in numbers
        ]
        if sources := _get(of, "power_sources"):
            yield ProposedLine(
                "", "power_sources", sources, ", ".join([*ranges, *([doubt] if doubt else [])]), is_certain=not doubt
            )
    for role, names in assigned.choices.items():
        yield ProposedLine(
            "read.topics",
            role,
            [names[0]],
            " or ".join(f'["{name}"]' for name in names[1:]).join(("or ", "")),
            is_certain=False,
        )
    for of in proposals:
        doubt = of.names.get("doubt", "")
        for role, names in _get(of, "read.topics").items():
            yield ProposedLine("read.topics", role, names, doubt, is_certain=not doubt)
    if not {"command"} & {*assigned.roles, *assigned.choices}:
        for name in assigned.left_out:
            if log.topics[name].type_name in (TWIST, TWIST_STAMPED):
                yield ProposedLine("read.topics", "command", [name], "if it commands the velocity", is_certain=False)
    for of in proposals:
        for role, fields in _get(of, "read.fields").items():
            own = columns.get(of.subject.name, {})
            for field, text in fields.items():
                value = _first(own.get(text.partition(" ")[0]))
                yield ProposedLine(
                    "read.fields",
                    f"{role}.{field}",
                    text,
                    f"{text.partition(' ')[0]} is {value}",
                    is_certain=not of.names.get("doubt"),
                )
    for role, (frame, _) in places.items():
        if frame:
            zero = {"xyz_m": [0.0, 0.0, 0.0]} | ({"rpy_rad": [0.0, 0.0, 0.0]} if role != "gnss" else {})
            yield ProposedLine(
                "read.extrinsics", role, zero, f"nothing places {frame}: measure it from base_link", is_certain=False
            )


def _get(finding: Finding, table: str) -> Any:
    return next((of.recipe[table] for of in finding.remedies if table in of.recipe), {})


def _first(values: NDArray[Any] | None) -> str:
    """Return the first value that is a number beside zero."""
    if values is None or values.ndim != 1 or not np.issubdtype(values.dtype, np.number):
        return ""
    set_ = values[np.isfinite(values) & (values != 0)]
    return f"{set_[0]:.9g}" if set_.size else "0"


def _sample(
    columns: Mapping[str, NDArray[Any]], kind: str, topic: str, role: str, assigned: RoleAssignment, known: Profiles
) -> str:
    """Return values of a topic, by what its role needs."""
    if role == "power":
        platform = known.robots[assigned.robot].platform
        choices = find_sources(kind, topic, known.power_sources, platform=platform, husky_power="battery")
        rails = [] if isinstance(choices, Finding) else read_rails(columns, choices[0], topic)
        if isinstance(rails, Finding):
            return ""
        return "".join(f"; {_first(rail.voltage_volt)} V, {_first(rail.current_amp)} A" for rail in rails)
    needed = (
        [(name, of.message) for name, of in MAPPED[role].items() if of.needed and of.message in columns]
        if kind == MAPPED_TYPES[role]
        else []
    )
    return "".join(f"; {name} {_first(columns[message])}" for name, message in needed)


def _place(
    log: Log | TableLog,
    tables: Mapping[str, pa.Table],
    columns: Mapping[str, Mapping[str, NDArray[Any]]],
    assigned: RoleAssignment,
    mapped: Mapping[str, str],
    config: ReadConfig,
) -> dict[str, tuple[str, str]]:
    """Return by role the frame that nothing places, "" where it is placed, and where it is."""
    used = {role.topics[0]: name for name, role in assigned.roles.items()} | dict(mapped)
    used |= {names[0]: role for role, names in assigned.choices.items()}
    frames = {
        cast("Role", role): next(iter(count_frames(columns[name], log.topics[name].type_name)), "")
        for name, role in used.items()
        if name in columns
    }
    found = place_frames(log, tables, assigned, frames, config)
    return {
        role: (frames[role] or "an unnamed frame", "")
        if by == "assumed"
        else ("", f"; at {np.round(pose.xyz_m, 3).tolist()} m ({by})" if by == "tf_static" else "")
        for role, (pose, by) in found.items()
    }
