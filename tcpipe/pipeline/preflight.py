"""Check a short test log before a campaign: segments per hour, lost distance, uncertainty of labels, remedies.

The excerpt goes through the same stages as in ingest, in memory: the prediction for a log is the result that ingesting
it would give.
"""

import math
import shlex
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np

from tcpipe.arrays import Ints
from tcpipe.errors import TcpipeError, clean_lines
from tcpipe.formats.atomic import Location
from tcpipe.formats.finding_lines import describe_power, format_findings, format_loss, list_verdict
from tcpipe.formats.logs.log_joining import open_single_log
from tcpipe.formats.object_storage import format_path, is_url
from tcpipe.formats.recipe_toml import load_profiles, resolve_recipe
from tcpipe.logs.topics import MISSING
from tcpipe.motion.distance_breakdown import StoreLoss, find_largest_losses
from tcpipe.motion.vibration import LEAST_RATE_HZ
from tcpipe.pipeline.ingest_run import run_stages
from tcpipe.pipeline.log_inspection import InspectedLog, inspect_log
from tcpipe.pipeline.log_sources import find_logs_at
from tcpipe.recipe import ReadConfig, Recipe, Role
from tcpipe.stages.read import decide_roles, find_read_config, read_run
from tcpipe.tables.columns import to_integers
from tcpipe.tables.facts import NOTHING_FOUND, EnergyBudget, StageFacts
from tcpipe.tables.findings import (
    Finding,
    Findings,
    Subject,
    Verdict,
    judge,
    make_finding,
    read_threshold,
    sort_findings,
)
from tcpipe.tables.levels import LabelledSegments

WANTED_HZ: Mapping[str, float] = {
    "imu": LEAST_RATE_HZ,
    **{role: read_threshold("rate-too-low", f"{role}_hz") for role in ("gnss", "wheel_odometry", "visual_odometry")},
}
"""Slower topics cost precision or columns; the rate of power depends on its source (`tcpipe.cost.labels`)."""

_MIN_SHARE = 0.05
_MOST_LOSSES = 3
_WINDOW_S, _FEWEST_WINDOWS = 10.0, 3


@dataclass(frozen=True, slots=True)
class RoleTopic:
    """A topic with a role: its rate, the expected rate, and the share of the log that it covers at its rate."""

    role: str
    topic: str
    rate_hz: float | None
    wanted_hz: float | None
    present_fraction: float


@dataclass(frozen=True, slots=True)
class ExpectedYield:
    """Yield of the excerpt; rates are per hour of recording and of driving (without stationary time)."""

    span_s: float
    driven_m: float
    segments: int
    segments_per_hour: float
    segments_per_hour_std: float | None
    """By how windows of ten seconds differ; None of a log of fewer than three."""
    segments_per_driven_hour: float
    distance_by_reason_m: Mapping[str, float]
    relative_std_median: Mapping[str, float | None]
    """One sigma of duration, velocity, power, energy, as a share [1]; None without segments or power."""
    energy_budget: EnergyBudget | None

    def lines(self) -> Iterator[str]:
        """Yield the prediction as lines of text."""
        total = sum(self.distance_by_reason_m.values())
        shares = (
            (metres / total, name)
            for name, metres in self.distance_by_reason_m.items()
            if total and metres >= _MIN_SHARE * total
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
    """Result of a preflight: expected yield, topics, problems and findings."""

    log: str
    robot: str | None
    expected_yield: ExpectedYield | None
    """None where ingest would fail."""
    topics: tuple[RoleTopic, ...]
    problems: tuple[str, ...]
    """Why ingest would fail."""
    findings: Findings
    """Findings of ingest, and on topics that are too slow, missing or offset, the worst first."""
    verdict: Verdict
    losses: tuple[StoreLoss, ...]
    """Where most metres go that are no segments."""
    recipe: str
    """The recipe of ``tcpipe init --from`` without the keys that the given recipe has [TOML]."""
    exit_code: int
    """0 ready; 3 there are warnings, errors or no segments; 1 ingest would fail."""

    def __str__(self) -> str:
        """Return it as lines."""
        lines = [
            f"{self.log}: robot {self.robot or 'unknown'}",
            *(self.expected_yield.lines() if self.expected_yield else ()),
        ]
        for topic in self.topics:
            rate = "" if topic.rate_hz is None else f" at {topic.rate_hz:.3g} Hz"
            wanted = "" if topic.wanted_hz is None else f" (needed {topic.wanted_hz:g})"
            lines.append(f"topic     {topic.role}: {topic.topic}{rate}{wanted}")
        lines += [f"fails     {line}" for line in self.problems]
        if self.expected_yield:
            lines += [f"verdict   {line}" for line in list_verdict(self.verdict)] + describe_power(self.verdict)
        lines += format_findings(self.findings, more=f"tcpipe preflight {shlex.quote(self.log)} --json")
        lines += [f"loss      {format_loss(loss)}" for loss in self.losses]
        lines += ["ready: no problems found"] if self.exit_code == 0 else []
        return clean_lines([*lines, "", *self.recipe.splitlines()])


def preflight(
    log: Location,
    *,
    recipe: Recipe | Location | None = None,
    robot: str | None = None,
    message_definitions: Path | None = None,
) -> Preflight:
    """Predict the result of recording in the same way.

    ``log`` is a path or URL of a log of at least a minute, all of which is read; of a folder, the first log is used.
    The other parameters are those of `tcpipe.pipeline.ingest.ingest`. `LogError`, `RecipeError`: there is no log, or it
    cannot be read.
    """
    recipe = resolve_recipe(recipe)
    robot = robot or recipe.robot
    path = log if is_url(log) else Path(log)
    if isinstance(path, Path) and path.is_dir():
        path = find_logs_at(path, recipe.tables)[0][0]
    with open_single_log(path, message_definitions=message_definitions, tables=recipe.tables) as found:
        inspected = replace(inspect_log(found, recipe, robot, full=False, reads_roles=True), path=format_path(log))
        read = find_read_config(recipe, found.topics)
        roles = decide_roles(read, found.topics.values(), robot, known=load_profiles(recipe)).roles
        missing = tuple(find_missing(roles, read))
        labelled, problems, causes = None, tuple[str, ...](), Findings()
        try:
            streams = read_run(found, read, robot=robot, known=load_profiles(recipe))
            labelled = run_stages(streams, recipe.ingest, run_id="preflight")[2]
        except TcpipeError as error:
            problems, causes = error.problems, error.findings
    return _summarize(inspected, labelled, (*missing, *causes), problems)


def _summarize(
    inspected: InspectedLog, labelled: LabelledSegments | None, missing: Findings, problems: tuple[str, ...]
) -> Preflight:
    report = labelled.info.report if labelled else NOTHING_FOUND
    expected_yield = _estimate_yield(labelled) if labelled else None
    topics = tuple(_iterate_topics(report.facts, inspected.duration_s or 0.0))
    findings = [*missing, *find_slow(topics, expected_yield, inspected.duration_s or 0.0)]
    for more in (inspected.findings or (), report.findings):
        made = {(finding.code, finding.subject) for finding in findings}
        findings += [finding for finding in more if (finding.code, finding.subject) not in made]
    losses = find_largest_losses([expected_yield.distance_by_reason_m] if expected_yield else [])
    ready = (
        expected_yield is not None
        and expected_yield.segments
        and all(finding.severity == "note" for finding in findings)
    )
    return Preflight(
        log=inspected.path,
        robot=inspected.robot,
        expected_yield=expected_yield,
        topics=topics,
        problems=problems,
        findings=tuple(sort_findings(findings)),
        verdict=judge(findings),
        losses=tuple(loss for loss in losses if loss.share > _MIN_SHARE)[:_MOST_LOSSES],
        recipe=inspected.recipe or "",
        exit_code=0 if ready else 3 if expected_yield else 1,
    )


def _estimate_yield(labelled: LabelledSegments) -> ExpectedYield:
    """Return the yield of an excerpt per hour of recording and of driving."""
    facts, distance_by_reason_m = labelled.info.report.facts, labelled.distance_by_reason_m
    cut, label = facts.segment, facts.label
    seconds = cut.duration_by_reason_s if cut else {}
    span_s, count = math.fsum(seconds.values()), labelled.table.num_rows
    hourly = 3600.0 * count / span_s if span_s else 0.0
    moving_s = span_s - seconds.get("stationary", 0.0)
    return ExpectedYield(
        span_s=span_s,
        driven_m=math.fsum(distance_by_reason_m.values()),
        segments=count,
        segments_per_hour=hourly,
        segments_per_hour_std=_compute_hourly_std(to_integers(labelled.table, "start_ns"), span_s),
        segments_per_driven_hour=3600.0 * count / moving_s if moving_s > 0.0 else 0.0,
        distance_by_reason_m=distance_by_reason_m,
        relative_std_median=label.relative_std_median if label and count else {},
        energy_budget=label.energy_budget if label else None,
    )


def _compute_hourly_std(start_ns: Ints, span_s: float) -> float | None:
    windows = int(span_s // _WINDOW_S)
    if windows < _FEWEST_WINDOWS:
        return None
    into_s = (start_ns - start_ns.min(initial=np.iinfo(np.int64).max)) / 1e9
    counts = np.bincount((into_s // _WINDOW_S).astype(np.intp), minlength=windows)
    return float(3600.0 / span_s * math.sqrt(windows) * counts.std(ddof=1))


def _iterate_topics(facts: StageFacts, span_s: float) -> Iterator[RoleTopic]:
    for role, topics in facts.roles.items():
        shares = {
            name: topic.rows / (topic.rate_hz * span_s) if topic.rate_hz and span_s else 1.0
            for name, topic in topics.items()
        }
        for name, topic in topics.items():
            share = shares[name] if role == "power" else sum(shares.values())  # others follow each other
            yield RoleTopic(role, name, topic.rate_hz, WANTED_HZ.get(role), min(share, 1.0))


def find_missing(roles: Collection[str], read: ReadConfig) -> Iterator[Finding]:
    """Yield a warning for each role without a topic, unless the recipe does without it; the role could be recorded.

    Without GNSS or power there are no samples: they are reported for every recipe.
    """
    present = {*roles, "gnss"} if "pose" in roles else {*roles}
    for code, role in {**MISSING, "no-command": "command"}.items():
        is_needless = role not in ("gnss", "power") and read.topics.get(cast("Role", role)) == []
        if role not in present and not is_needless:
            finding = make_finding(code, Subject("role", role))
            yield replace(finding, severity="warning") if finding.severity == "note" else finding


def find_slow(topics: Sequence[RoleTopic], expected_yield: ExpectedYield | None, span_s: float) -> Iterator[Finding]:
    """Yield findings on topics that are slow or absent for a part of the time, and on a log that is too short."""
    for topic in topics:
        subject, names = Subject("role", topic.role), {"topic": topic.topic}
        least_hz = read_threshold("rate-too-low", "min_rate_fraction") * (topic.wanted_hz or 0.0)
        if topic.rate_hz is not None and topic.wanted_hz is not None and topic.rate_hz < least_hz:
            yield make_finding("rate-too-low", subject, names=names, rate_hz=topic.rate_hz, wanted_hz=topic.wanted_hz)
        if topic.role != "command" and topic.present_fraction < read_threshold(
            "topic-incomplete", "min_present_fraction"
        ):
            yield make_finding("topic-incomplete", subject, names=names, present_fraction=topic.present_fraction)
    budget = expected_yield.energy_budget if expected_yield else None
    code = "power-rate-dominates"
    least_share, gain = (read_threshold(code, f"{end}_fraction") for end in ("min_variance", "max_remaining"))
    if budget and budget.rate**2 > least_share * budget.total**2 and budget.at_20_hz < gain * budget.total:
        subject = Subject("role", "power")
        yield make_finding(code, subject, total_fraction=budget.total, at_20_hz_fraction=budget.at_20_hz)
    if expected_yield is not None and span_s < read_threshold("log-too-short", "min_span_s"):
        yield make_finding("log-too-short", Subject("log", "log"), length_s=span_s)
