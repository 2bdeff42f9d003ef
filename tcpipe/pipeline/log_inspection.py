"""Inspection of a log: topics and roles from its index; with everything read, also gaps, clocks and damage."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Literal

import numpy as np
import pyarrow as pa

from tcpipe.arrays import Ints, Mask
from tcpipe.cost.labels import find_wanted_rate, is_too_slow
from tcpipe.formats.logs.log_file import Log
from tcpipe.formats.logs.message_tables import TableLog
from tcpipe.formats.recipe_toml import load_profiles
from tcpipe.logs.clocks import CLOCK, LOG_CLOCK, SIMULATED_NS, TopicTimeline, TopicTimes, settle_clocks
from tcpipe.logs.messages import HEADER_STAMP, read_header_ns
from tcpipe.logs.roles import RoleAssignment
from tcpipe.logs.topics import Topic, split_notes
from tcpipe.pipeline.log_sources import find_damaged_log, find_total_loss
from tcpipe.pipeline.proposals import propose_for_log
from tcpipe.power.sources import find_sources
from tcpipe.recipe import Recipe
from tcpipe.robots import Profiles
from tcpipe.stages.proposals import find_proposals
from tcpipe.stages.read import decide_roles, find_read_config
from tcpipe.tables.columns import to_integers
from tcpipe.tables.facts import ClockStep
from tcpipe.tables.findings import Finding, Findings, Subject, make_finding, omit, sort_findings

_GAP_PERIODS, _GAP_NS = 3, 300_000_000
_TIMES = 2  # columns before the message's own: both times of the log


@dataclass(frozen=True, slots=True)
class StampCounts:
    """Counts over all messages of a topic; those of stamps are None if its messages have no header."""

    messages_read: int
    longest_gap_s: float | None
    gaps: int
    """Gaps by both log time and header stamps."""
    zero_stamps: int | None = None
    backward_stamps: int | None = None
    repeated_stamps: int | None = None
    duplicates: int | None = None
    """Messages that repeat the one before exactly."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedTopic:
    """Facts of a topic from the index, and, if all messages are read, from these.

    Facts that need all messages are None if only the index was read.
    """

    name: str
    type: str
    messages: int | None
    rate_hz: float | None
    role: str | None
    why: str | None
    """Why it is used as its role, or is not used."""
    stamps: StampCounts | None = omit()
    wrong_stamps: int | None = omit()
    """Number of stamps other than zero that were replaced."""
    time: Literal["header", "log"] | None = omit()
    """Which stamps are used."""
    time_why: str | None = omit()
    header_minus_log_s: float | None = None
    moved_s: tuple[float, ...] | None = omit()
    """Offsets added to its stamps to bring them to the clock of most topics, by clock epoch [s]."""
    simulated_time: bool | None = omit()


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedLog:
    """Content of a log; of one that cannot be read only its path and the problems."""

    kind: Literal["log"] = "log"
    path: str
    container: str | None = omit()
    size_bytes: int | None = omit()
    start_ns: int | None = None
    duration_s: float | None = None
    robot: str | None = omit()
    robot_why: str | None = omit()
    topics: tuple[InspectedTopic, ...] | None = omit()
    clock_steps: tuple[ClockStep, ...] | None = omit()
    problems: tuple[str, ...] = ()
    """Decisions that ingest needs, or why the log cannot be read."""
    findings: Findings | None = omit()
    damage: Findings | None = omit()
    notes: Findings | None = omit()
    recipe: str | None = omit()
    """Recipe of ``tcpipe init --from`` without the keys that the recipe has [TOML]."""


def inspect_log(
    log: Log | TableLog, recipe: Recipe, robot: str | None, *, full: bool, reads_roles: bool = False
) -> InspectedLog:
    """Return the content of a log.

    With ``full``, every message is read for counts, gaps, stamps, clock steps and damage; with ``reads_roles``, only
    the messages of used topics, for the proposed recipe.
    """
    known = load_profiles(recipe)
    config = find_read_config(recipe, log.topics)
    cast = decide_roles(config, log.topics.values(), robot, known=known)
    topics, steps = (
        tuple(_inspect_index(topic, cast) for topic in sorted(log.topics.values(), key=attrgetter("name"))),
        None,
    )
    if full:
        topics, steps = _read(log, topics)
    damage, notes = split_notes(log.findings)
    lost = find_total_loss(log.topics.values(), damage)
    proposals = find_proposals(log, cast, config, known)
    proposed = propose_for_log(log, cast, recipe, proposals, is_complete=reads_roles)
    findings = (
        *(() if lost else cast.findings),
        *(replace(finding, remedies=()) for finding in proposals),  # they are in the proposed recipe
        *_find_simulated_time(log.topics.values()),
        *_find_slow_power(log, cast, recipe, known),
        *find_damaged_log(damage, Subject("log", str(log.path))),
    )
    starts = [topic.start_ns for topic in log.topics.values() if topic.start_ns is not None]
    ends = [topic.end_ns for topic in log.topics.values() if topic.end_ns is not None]
    return InspectedLog(
        path=str(log.path),
        container=log.container,
        size_bytes=log.size_bytes,
        start_ns=min(starts, default=None),
        duration_s=(max(ends) - min(starts)) / 1e9 if starts and ends else None,
        robot=cast.robot,
        robot_why=cast.robot_why,
        topics=topics,
        clock_steps=steps,
        problems=lost or tuple(cast.problems),
        findings=tuple(sort_findings(findings)),
        damage=damage,
        notes=notes,
        recipe=proposed.toml(),
    )


def _inspect_index(topic: Topic, cast: RoleAssignment) -> InspectedTopic:
    """Return the facts of a topic in the index."""
    mine = {name: role.why for name, role in cast.roles.items() if topic.name in role.topics}
    if topic.name in cast.transforms:
        mine = {"transforms": "places the sensors"}
    why = "; ".join(mine.values()) or cast.left_out.get(topic.name) or topic.problem
    return InspectedTopic(
        name=topic.name,
        type=topic.type_name,
        messages=topic.message_count,
        rate_hz=topic.rate_hz and round(topic.rate_hz, 2),
        role=", ".join(mine) or None,
        why=why,
    )


def _read(
    log: Log | TableLog, topics: tuple[InspectedTopic, ...]
) -> tuple[tuple[InspectedTopic, ...], tuple[ClockStep, ...]]:
    """Read every message; return the topics with the facts of their messages, and the clock epochs."""
    facts: dict[str, TopicStamps] = {}
    for tables in log.batches(sorted(log.topics)):
        for name, table in tables.items():
            facts.setdefault(name, TopicStamps()).add(table)
    times = {name: stamps.topic_times() for name, stamps in facts.items()}
    clocks = {
        name: stamps for name, stamps in times.items() if stamps.header_ns is not None and len(stamps.log_time_ns)
    }
    published = any(topic.type_name == CLOCK and topic.message_count for topic in log.topics.values())
    settled = settle_clocks(clocks, clock_published=published)
    clock = settled.simulated
    simulated = clock.topics if clock is not None and clock.find_simulated_time() else frozenset()
    read = tuple(
        _add_stamps(topic, facts[topic.name], settled.timelines.get(topic.name), simulated=topic.name in simulated)
        if topic.name in facts
        else topic
        for topic in topics
    )
    return read, tuple(settled.steps)


def _add_stamps(
    topic: InspectedTopic, stamps: TopicStamps, timeline: TopicTimeline | None, *, simulated: bool
) -> InspectedTopic:
    """Return a topic with statistics of its messages; ``timeline`` is None if these have no header."""
    counts = stamps.counts()
    if timeline is None:
        return replace(topic, stamps=counts)
    wrong = timeline.notes.get("stamps_replaced", 0) - (counts.zero_stamps or 0)
    return replace(
        topic,
        stamps=counts,
        time=timeline.source,
        time_why=timeline.why,
        header_minus_log_s=timeline.offset_s,
        moved_s=tuple(moved for moved in timeline.moved_s if moved),
        wrong_stamps=max(wrong, 0),
        simulated_time=simulated,
    )


def _find_slow_power(log: Log | TableLog, cast: RoleAssignment, recipe: Recipe, known: Profiles) -> Iterable[Finding]:
    """Yield a finding for each power topic that is too slow for segments, with the setting of its rate if known."""
    robot = known.robots[cast.robot]
    for name in cast.roles["power"].topics if "power" in cast.roles else ():
        topic = log.topics[name]
        choices = find_sources(
            topic.type_name, name, known.power_sources, platform=robot.platform, husky_power=recipe.read.husky_power
        )
        rate_hz = topic.rate_hz and round(topic.rate_hz, 2)
        if (
            isinstance(choices, Finding)
            or rate_hz is None
            or not any(source.current or source.energy for source in choices[0])
        ):
            continue  # a voltage alone may be slow
        averaged = {"auto": choices[0][0].averaged, "yes": True, "no": False}[recipe.read.power_averaged]
        if is_too_slow(rate_hz, averaged=averaged):
            names = {"quantity": "current", "topic": name, "setting": choices[0][0].rate_setting}
            wanted_hz = find_wanted_rate(averaged=averaged)
            subject = Subject("role", "power")
            yield make_finding("power-too-slow", subject, names=names, rate_hz=rate_hz, wanted_hz=wanted_hz)


def _find_simulated_time(topics: Iterable[Topic]) -> Iterable[Finding]:
    """Yield the finding that the index shows simulated time: a clock topic, or a log that begins near 0."""
    listed = list(topics)
    starts_ns = [topic.start_ns for topic in listed if topic.start_ns is not None]
    clocks = [topic.name for topic in listed if topic.type_name == CLOCK]
    if clocks or (starts_ns and max(starts_ns) < SIMULATED_NS):
        yield make_finding("simulated-time", LOG_CLOCK, names={"topics": ", ".join(clocks)})


class TopicStamps:
    """The times of all messages of a topic, and which messages repeat the one before exactly."""

    def __init__(self) -> None:
        self._pieces: list[tuple[Ints, Ints | None, Mask]] = []
        self._last: pa.Table | None = None

    def add(self, table: pa.Table) -> None:
        """Add the next rows, in the order of log time."""
        if not table.num_rows:
            return
        rows = table if self._last is None else pa.concat_tables([self._last, table])
        stamps = {name: rows.column(name).to_numpy() for name in HEADER_STAMP if name in rows.column_names}
        header_ns, same = read_header_ns(stamps), np.zeros(rows.num_rows, bool)
        if header_ns is not None:
            again = np.flatnonzero((np.diff(header_ns) == 0) & (header_ns[1:] != 0)) + 1
            same[again] = _find_repeated_rows(rows, again)
            header_ns = header_ns[-table.num_rows :].copy()
        self._pieces.append((to_integers(table, "log_time_ns").copy(), header_ns, same[-table.num_rows :]))
        self._last = table.take([table.num_rows - 1])  # a slice would keep all of it

    def topic_times(self) -> TopicTimes:
        """Return the times for `tcpipe.logs.clocks`; exact repetitions of a message have equal content."""
        log_ns, header_ns, same = self._joined()
        return TopicTimes(log_ns, header_ns, (np.cumsum(~same).astype(float),))

    def counts(self) -> StampCounts:
        """Return the statistics."""
        log_ns, header_ns, same = self._joined()
        steps, odd = np.diff(log_ns), dict[str, int]()
        period_ns = float(np.median(steps)) if len(steps) else 0.0
        if header_ns is not None:
            steps = np.minimum(steps, np.where(header_ns[1:] != 0, np.diff(header_ns), steps))
            again = (np.diff(header_ns) == 0) & (header_ns[1:] != 0)
            odd = {
                "zero_stamps": int(np.count_nonzero(header_ns == 0)),
                "backward_stamps": int(np.count_nonzero(np.diff(header_ns[header_ns != 0]) < 0)),
                "repeated_stamps": int(np.count_nonzero(again & ~same[1:])),
                "duplicates": int(np.count_nonzero(same)),
            }
        return StampCounts(
            messages_read=len(log_ns),
            longest_gap_s=max(int(steps.max()), 0) / 1e9 if len(steps) else None,
            gaps=int(np.count_nonzero(steps > max(_GAP_PERIODS * period_ns, _GAP_NS))),
            **odd,
        )

    def _joined(self) -> tuple[Ints, Ints | None, Mask]:
        if not self._pieces:
            return np.zeros(0, np.int64), None, np.zeros(0, bool)
        log_ns, header_ns, same = zip(*self._pieces, strict=True)
        return (
            np.concatenate(log_ns),
            None if header_ns[0] is None else np.concatenate(header_ns),
            np.concatenate(same),
        )


def _find_repeated_rows(table: pa.Table, rows: Ints) -> Mask:
    """Mark the given rows that repeat the row before exactly, except in times of the log, shape (len(rows),)."""
    same = np.ones(len(rows), bool)
    for column in table.columns[_TIMES:]:
        undecided = np.flatnonzero(same)
        if not len(undecided):
            break
        own, before = (column.take(rows[undecided] - back).combine_chunks() for back in (0, 1))
        if pa.types.is_primitive(column.type) and not pa.types.is_boolean(column.type):
            values = [
                np.ascontiguousarray(column.to_numpy()).view(f"V{column.type.byte_width}") for column in (own, before)
            ]
            same[undecided] = values[0] == values[1]  # bit by bit: a NaN equals itself
        else:
            same[undecided] = [own.slice(row, 1).equals(before.slice(row, 1)) for row in range(len(undecided))]
    return same
