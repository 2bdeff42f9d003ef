"""What a minute of recording promises of a day: segments an hour, where the metres go, how sure labels are; and what mends it first.

The excerpt goes through the very stages that ingest runs, in memory: what is predicted of a log is what ingesting it would give.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import TcpipeError, plain_lines
from tcpipe.formats.logs.joined import opened
from tcpipe.formats.object_storage import is_url, shown_path
from tcpipe.formats.robot_files import profiles_of
from tcpipe.logs.roles import OVERLAY, ROLE_TYPES
from tcpipe.logs.simulated_clock import CLOCK
from tcpipe.logs.topics import Topic
from tcpipe.motion.remedies import REMEDIES
from tcpipe.motion.vibration import LEAST_RATE_HZ
from tcpipe.pipeline.log_inspection import InspectedLog, inspect_log
from tcpipe.pipeline.run_stages import run_stages
from tcpipe.recipe import ReadConfig, Recipe, Role
from tcpipe.recipe.suggestions import recipe_key
from tcpipe.stages.read import read_run
from tcpipe.stages.read_roles import find_read_config, roles_by
from tcpipe.tables.columns import integers
from tcpipe.tables.facts import EnergyBudget, NoPower, RunFacts
from tcpipe.tables.levels import LabelledSegments

MISSING: Mapping[Role, str] = {
    "gnss": "the track has no place on a map, and there are no samples",
    "imu": "attitude and turning rest on the other sensors alone, and there is no vibration",
    "wheel_odometry": "speed rests on fixes or a camera alone, and slip is not told",
    "power": "there are segments, but no energy and no sample",
    "command": "a commanded change of speed is not told from the terrain's, nor whether the robot was at its limit",
}
"""What a log without the role lacks."""

WANTED_HZ: Mapping[str, float] = {"gnss": 1.0, "imu": LEAST_RATE_HZ, "wheel_odometry": 10.0, "visual_odometry": 10.0}
"""Slower topics cost precision or columns; power's rate is a matter of its source (`tcpipe.cost.quality`)."""

LARGE_TYPES = frozenset(
    f"sensor_msgs/msg/{name}"
    for name in ("Image", "CompressedImage", "PointCloud", "PointCloud2", "LaserScan", "MultiEchoLaserScan")
) | {
    "stereo_msgs/msg/DisparityImage",
    "nav_msgs/msg/OccupancyGrid",
    "velodyne_msgs/msg/VelodyneScan",
    "livox_ros_driver2/msg/CustomMsg",
}
"""What fills disks and is of no use here."""

_NEARLY = 0.9
_OFTEN_THERE = 0.9
_CLOCK = re.compile(r"\bstamps?\b|log time|^clock:|its clock is")
_WORTH_SAYING = 0.05
_SHORT_S = 45.0
_TRANSFORMS = "/tf_static"
_WINDOW_S, _FEWEST_WINDOWS = 10.0, 3


@dataclass(frozen=True, slots=True)
class RoleTopic:
    """A topic that plays a role: how often it comes, how often it should, and which share of the log it covers at its rate."""

    role: str
    topic: str
    rate_hz: float | None
    wanted_hz: float | None
    there: float


@dataclass(frozen=True, slots=True)
class Promise:
    """What the excerpt gives; rates are an hour's, of recording and of driving (standing left out)."""

    span_s: float
    driven_m: float
    segments: int
    segments_per_hour: float
    segments_per_hour_std: float | None
    """By how windows of ten seconds differ; None of a log of fewer than three."""
    segments_per_driven_hour: float
    ledger_m: Mapping[str, float]
    relative_std_median: Mapping[str, float | None]
    """One sigma of duration, velocity, power, energy, as a share [1]; None without segments or power."""
    energy_budget: EnergyBudget | None

    def lines(self) -> Iterator[str]:
        """Yield it in words."""
        total = sum(self.ledger_m.values())
        shares = (
            (metres / total, name)
            for name, metres in self.ledger_m.items()
            if total and metres >= _WORTH_SAYING * total
        )
        where = ", ".join(f"{share:.0%} {name.replace('_', ' ')}" for share, name in sorted(shares, reverse=True))
        unsure = "" if self.segments_per_hour_std is None else f" ± {self.segments_per_hour_std:.0f}"
        yield (
            f"promises  {self.segments_per_hour:.0f}{unsure} segments an hour of recording, "
            f"{self.segments_per_driven_hour:.0f} of driving ({self.segments} in {self.span_s:.0f} s)"
        )
        yield f"metres    {self.driven_m:.1f} driven: {where}" if where else "metres    none driven"
        known = [
            f"{letter} ± {std:.1%}"
            for name, letter in _LETTERS.items()
            if (std := self.relative_std_median.get(name)) is not None
        ]
        yield f"labels    {', '.join(known) or 'none'} (1 sigma, median)"


_LETTERS = {"power": "w", "velocity": "v", "duration": "T", "energy": "E"}


@dataclass(frozen=True, slots=True)
class Preflight:
    """What to know before a day is recorded like this."""

    log: str
    robot: str | None
    promise: Promise | None
    """None where ingesting it would fail."""
    topics: tuple[RoleTopic, ...]
    missing: Mapping[str, str]
    """By role, what that costs."""
    problems: tuple[str, ...]
    """Why ingesting it would fail."""
    mend: tuple[str, ...]
    """What is too slow, absent or off, and what to do about it."""
    costs: tuple[str, ...]
    """Where most metres go that are no segments, and what would win them back."""
    clock: tuple[str, ...]
    warnings: tuple[str, ...]
    """What else ingest would warn of."""
    record: str
    """The command that records all that may be of use; "" where the log is no recording of ROS."""
    large: Mapping[str, float | None]
    """Images and point clouds, which it leaves out, with the messages that come of each a second."""
    no_power: NoPower | None
    """Why no power is read though the log may tell some, and the recipe that would read it."""
    exit_code: int
    """0 ready; 3 something is to be mended; 1 nothing would come of it."""

    def __str__(self) -> str:
        """Return it as lines."""
        said = [f"{self.log}: robot {self.robot or 'unknown'}", *(self.promise.lines() if self.promise else ())]
        said += [f"topic     {_rate(of)}" for of in self.topics]
        for name, lines in (
            ("fails", self.problems),
            ("mend", self.mend),
            ("costs", self.costs),
            ("clock", self.clock),
            ("warning", self.warnings),
        ):
            said += [f"{name:9} {line}" for line in lines]
        if self.no_power:
            said += [f"power     {self.no_power.why}", *(f"  {line}" for line in self.no_power.recipe.splitlines())]
        said += [f"record    {self.record}"] if self.record else []
        rates = ", ".join(name if hz is None else f"{name} at {hz:.3g} Hz" for name, hz in self.large.items())
        said += [f"large     images and point clouds, not recorded by that: {rates}"] if rates else []
        said += ["ready: nothing is to be mended"] if self.exit_code == 0 else []
        return plain_lines(said)


def _rate(of: RoleTopic) -> str:
    rate = "" if of.rate_hz is None else f" at {of.rate_hz:.3g} Hz"
    return f"{of.role}: {of.topic}{rate}" + ("" if of.wanted_hz is None else f" (wanted {of.wanted_hz:g})")


def preflight(
    log: Path | str, *, recipe: Recipe, robot: str | None = None, message_definitions: Path | None = None
) -> Preflight:
    """Return what recording like this promises.

    Parameters
    ----------
    log : a minute or more, of any container, or the URL of one; all of it is read.
    recipe, robot, message_definitions : as `tcpipe.pipeline.ingest.ingest` takes them.

    Raises
    ------
    LogError, RecipeError : it is no log, or cannot be read at all.
    """
    robot = robot or recipe.robot
    path = log if is_url(log) else Path(log)
    with opened(path, message_definitions=message_definitions, tables=recipe.tables) as found:
        seen = replace(inspect_log(found, recipe, robot, full=False), path=shown_path(log))
        topics = tuple(found.topics.values())
        read = find_read_config(recipe, found.topics)
        cast = roles_by(read, topics, robot, known=profiles_of(recipe))
        large = {of.name: of.rate_hz for of in seen.topics or () if of.type in LARGE_TYPES and of.role is None}
        kept = [of.name for of in topics if of.name not in large and not of.name.startswith(OVERLAY)]
        record = record_command(topics, kept)
        placed = bool(cast.transforms)
        record += "" if placed or not record else f" {_TRANSFORMS}"
        missing = dict(_missing_roles(cast.roles, read))
        try:
            streams = read_run(found, read, robot=robot, known=profiles_of(recipe))
            labelled = run_stages(streams, recipe.ingest, run_id="preflight")[2]
        except TcpipeError as error:
            return replace(_told(seen, None, missing, record, placed=placed, problems=error.problems), large=large)
    return replace(_told(seen, labelled, missing, record, placed=placed, problems=()), large=large)


def _told(
    seen: InspectedLog,
    labelled: LabelledSegments | None,
    missing: Mapping[str, str],
    record: str,
    *,
    placed: bool,
    problems: tuple[str, ...],
) -> Preflight:
    facts = labelled.info.report.facts if labelled else RunFacts()
    every = tuple(dict.fromkeys((*(labelled.info.report.findings if labelled else ()), *(seen.warnings or ()))))
    clock = tuple(line for line in every if _CLOCK.search(line))
    promise = _promise(labelled) if labelled else None
    topics = tuple(_topics(facts, seen.duration_s or 0.0))
    slow = tuple(line for line in every if line.startswith("power: ") and "too slowly" in line)
    unplaced = () if placed else _unplaced(every)
    mend = (*_missing(missing), *slow, *unplaced, *_mend(topics, promise, seen.duration_s or 0.0))
    ready = promise is not None and promise.segments and not any((mend, clock, seen.damage))
    return Preflight(
        log=seen.path,
        robot=seen.robot,
        promise=promise,
        topics=topics,
        missing=missing,
        problems=problems,
        mend=mend,
        costs=tuple(_costs(labelled)) if labelled else (),
        clock=clock,
        warnings=(
            *(line for line in every if line not in (*clock, *slow) and not line.startswith("no topic plays")),
            *(seen.damage or ()),
        ),
        record=record,
        large={},
        no_power=facts.no_power or seen.no_power,
        exit_code=0 if ready else 3 if promise else 1,
    )


def _promise(labelled: LabelledSegments) -> Promise:
    facts, ledger_m = labelled.info.report.facts, labelled.ledger_m
    cut, label = facts.segment, facts.label
    seconds = cut.ledger_s if cut else {}
    span_s, count = math.fsum(seconds.values()), labelled.table.num_rows
    hourly = 3600.0 * count / span_s if span_s else 0.0
    moving_s = span_s - seconds.get("standing", 0.0)
    return Promise(
        span_s=span_s,
        driven_m=math.fsum(ledger_m.values()),
        segments=count,
        segments_per_hour=hourly,
        segments_per_hour_std=_hourly_std(integers(labelled.table, "start_ns"), span_s),
        segments_per_driven_hour=3600.0 * count / moving_s if moving_s > 0.0 else 0.0,
        ledger_m=ledger_m,
        relative_std_median=label.relative_std_median if label and count else {},
        energy_budget=label.energy_budget if label else None,
    )


def _hourly_std(start_ns: NDArray[np.int64], span_s: float) -> float | None:
    windows = int(span_s // _WINDOW_S)
    if windows < _FEWEST_WINDOWS:
        return None
    into_s = (start_ns - start_ns.min(initial=np.iinfo(np.int64).max)) / 1e9
    counts = np.bincount((into_s // _WINDOW_S).astype(np.intp), minlength=windows)
    return float(3600.0 / span_s * math.sqrt(windows) * counts.std(ddof=1))


def _topics(facts: RunFacts, span_s: float) -> Iterator[RoleTopic]:
    for role, of in facts.roles.items():
        for name, topic in of.topics.items():
            whole = (topic.rate_hz or 0.0) * span_s
            yield RoleTopic(
                role, name, topic.rate_hz, WANTED_HZ.get(role), min(topic.rows / whole, 1.0) if whole else 1.0
            )


def _missing_roles(played: Collection[str], read: ReadConfig) -> Iterator[tuple[str, str]]:
    """Yield the roles that no topic plays and what that costs; nothing of one that the recipe does without, unless no sample is left."""
    for role, what in MISSING.items():
        without = role not in ("gnss", "power") and read.topics.get(role) == []
        if role not in played and not without and not (role == "gnss" and "pose" in played):
            yield role, what


def _missing(missing: Mapping[str, str]) -> Iterator[str]:
    for role, what in missing.items():
        types = "" if role == "power" else f" ({' or '.join(ROLE_TYPES[role][:2])})"
        yield f"{role}: no topic plays it: {what}; record one{types}, or name it ({recipe_key('read.topics')})"


def _unplaced(warnings: Sequence[str]) -> Iterator[str]:
    """Yield what records where the sensors sit, of a log without transforms."""
    roles = dict.fromkeys(line.partition(":")[0] for line in warnings if "nothing places frame" in line)
    if roles:
        yield f"{', '.join(roles)}: no {_TRANSFORMS} tells where they sit: record it, or say it ({recipe_key('read.placement')})"


def _mend(topics: Sequence[RoleTopic], promise: Promise | None, span_s: float) -> Iterator[str]:
    for of in topics:
        if of.rate_hz is not None and of.wanted_hz is not None and of.rate_hz < _NEARLY * of.wanted_hz:
            yield f"{of.role}: {of.topic} comes at {of.rate_hz:.3g} Hz, {of.wanted_hz:g} are wanted: raise the rate of its driver"
        if of.role != "command" and of.there < _OFTEN_THERE:
            yield f"{of.role}: {of.topic} is there for {of.there:.0%} of the log only: look at its cable, its driver, the recorder's disk"
    budget = promise.energy_budget if promise else None
    if budget is not None and budget.rate**2 > 0.5 * budget.total**2 and budget.at_20_hz < 0.8 * budget.total:
        yield f"power: its rate rules the error of E: {budget.total:.1%} would be {budget.at_20_hz:.1%} at 20 Hz"
    if promise is not None and span_s < _SHORT_S:
        yield f"the log is {span_s:.0f} s long: record a minute as it will be driven, for a prediction that holds"
    if promise is not None and not promise.segments:
        lost = max(promise.ledger_m, key=lambda name: promise.ledger_m[name], default="")
        cure = REMEDIES["gap"] if lost == "gap" else "drive straight at one speed for some metres"
        yield f"there is no segment in it: {cure}"


def _costs(labelled: LabelledSegments) -> Iterator[str]:
    total = math.fsum(labelled.ledger_m.values())
    lost = sorted(((metres, name) for name, metres in labelled.ledger_m.items() if name != "kept"), reverse=True)
    for metres, name in lost[:3]:
        if total and metres > _WORTH_SAYING * total:
            yield f"{metres / total:.0%} of the metres are {name.replace('_', ' ')}: {REMEDIES[name]}"


def record_command(topics: Iterable[Topic], names: Sequence[str]) -> str:
    """Return how ROS records exactly these topics, and a simulation's clock; "" where they come from no recording of ROS."""
    known = {topic.name: topic for topic in topics}
    clocks = [name for name, topic in known.items() if topic.type_name == CLOCK and names]
    wanted = [name for name in dict.fromkeys([*names, *clocks]) if name in known]
    encodings = {known[name].encoding for name in wanted}
    begin = "rosbag record --lz4 -O drive" if encodings == {"ros1"} else "ros2 bag record -s mcap -o drive"
    return " ".join([begin, *map(shlex.quote, wanted)]) if wanted and encodings <= {"ros1", "cdr"} else ""
