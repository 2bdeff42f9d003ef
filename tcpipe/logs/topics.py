"""Topics of a log, as data and in words, and their coverage of a drive; findings on topics and on damage of the log.

The robot of a log is stated by the user, or found by message types that only one robot publishes or by its name in a
topic.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any, Literal

from tcpipe.errors import RecipeError, list_first
from tcpipe.recipe.suggestions import RecipeFragment
from tcpipe.robots import GENERIC, Robot
from tcpipe.tables.findings import Finding, Findings, Severity, Subject, make_finding

AutopilotKind = Literal["ulog", "dataflash"]
"""Logs of autopilots: PX4's and ArduPilot's."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a log, or of a file of it, by the index; None for values that the index lacks.

    ``type_name`` is ``package/msg/Name`` for ROS 1 and ROS 2 alike; ``encoding`` is ``cdr``, ``ros1``, or what else the
    log names; ``definition`` is the definition text in the log ("" if it has none), of the language
    ``schema_encoding``; ``problem`` is the reason why the topic cannot be read.
    """

    name: str
    type_name: str
    message_count: int | None
    start_ns: int | None
    end_ns: int | None
    encoding: str
    definition: str
    problem: str | None = None
    silent_ns: int = 0
    """Time without messages between the first and the last one, by the index [ns]."""
    schema_encoding: str = ""

    @property
    def span_s(self) -> float | None:
        """From the first message to the last."""
        return None if self.start_ns is None or self.end_ns is None else (self.end_ns - self.start_ns) / 1e9

    @property
    def rate_hz(self) -> float | None:
        """Messages a second."""
        span_s = self.span_s or 0.0
        return (self.message_count - 1) / span_s if self.message_count is not None and span_s > 0.0 else None

    def joined(self, other: Topic) -> Topic:
        """Return this topic with the messages of ``other``, the same topic in another file."""
        counts = (self.message_count, other.message_count)
        starts = [stamp for stamp in (self.start_ns, other.start_ns) if stamp is not None]
        ends = [stamp for stamp in (self.end_ns, other.end_ns) if stamp is not None]
        return replace(
            self,
            message_count=None if counts[0] is None or counts[1] is None else counts[0] + counts[1],
            start_ns=min(starts, default=None),
            end_ns=max(ends, default=None),
            definition=self.definition or other.definition,
            problem=self.problem or other.problem,
            silent_ns=self.silent_ns + other.silent_ns,
        )


@dataclass(frozen=True, slots=True)
class Damage:
    """A damaged part of a log, and its known losses.

    ``cause`` is a code in the catalogue of findings, ``file`` of a directory its name and that of the file, ``offset``
    [byte] where in the file, ``places`` the number of damaged parts counted together, ``reason`` what the template of
    the cause needs beside numbers.
    """

    cause: str
    file: str
    offset: int | None = None
    topic: str | None = None
    messages_lost: int | None = None
    bytes_lost: int | None = None
    places: int = 1
    reason: str = ""

    @property
    def is_loss(self) -> bool:
        """Whether something is or may be lost."""
        return self.messages_lost != 0 or bool(self.bytes_lost)


def find_damage(damage: Iterable[Damage]) -> list[Finding]:
    """Return one finding per cause and file or topic, with summed counts; without a loss it is a note."""
    groups: dict[tuple[str, Subject], list[Damage]] = {}
    for place in dict.fromkeys(damage):
        subject = Subject("topic", place.topic) if place.topic else Subject("file", place.file)
        groups.setdefault((place.cause, subject), []).append(place)
    return [_merge_damage(subject, places) for (_, subject), places in groups.items()]


def _merge_damage(subject: Subject, places: Sequence[Damage]) -> Finding:
    first, count = places[0], sum(place.places for place in places)
    numbers: dict[str, Any] = {
        "places_count": count if count > 1 else None,
        "first_offset": first.offset,
        "lost_messages_count": _add_known(place.messages_lost for place in places),
        "lost_bytes": _add_known(place.bytes_lost for place in places),
    }
    return make_finding(
        first.cause,
        subject,
        severity="warning" if any(place.is_loss for place in places) else "note",
        names={"reason": first.reason} if first.reason else None,
        **{name: number for name, number in numbers.items() if number is not None},
    )


def split_notes(findings: Iterable[Finding]) -> tuple[Findings, Findings]:
    """Return the findings on losses, and the notes."""
    found = list(findings)
    return tuple(finding for finding in found if finding.severity != "note"), tuple(
        finding for finding in found if finding.severity == "note"
    )


def _add_known(counts: Iterable[int | None]) -> int | None:
    known = [count for count in counts if count is not None]
    return sum(known) if known else None


def normalize_type_name(name: str) -> str:
    """Return ``package/msg/Name`` for the ROS 1 form ``package/Name``; other forms stay as they are."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name


LISTED = 8
"""Most entries of a list in a message."""


def format_topics(topics: Iterable[Topic], types: Sequence[str] | None = None) -> str:
    """Return topics as ``/name (type, n messages, rate)``, shortened if long; only those of ``types`` if any."""
    all_topics = list(topics)
    of_type = [topic for topic in all_topics if types is not None and topic.type_name in types]
    chosen = of_type or all_topics
    shown = ", ".join(_describe_topic(topic) for topic in chosen[:LISTED])
    more = f", and {len(chosen) - LISTED} more" if len(chosen) > LISTED else ""
    return shown + more if chosen else "no topic at all"


def _describe_topic(topic: Topic) -> str:
    parts = [topic.type_name]
    if topic.message_count is not None:
        parts.append(f"{topic.message_count} messages")
    if topic.rate_hz is not None:
        parts.append(f"{topic.rate_hz:.3g} Hz")
    return f"{topic.name} ({', '.join(parts)})"


def format_topic_names(topics: Sequence[Topic]) -> str:
    """Return the topics' names, the longest lists cut."""
    return list_first([topic.name for topic in topics], LISTED)


def list_undecodable(topics: Iterable[Topic]) -> Iterator[str]:
    """Yield one line for each reason why topics cannot be decoded; none if all can."""
    by_reason: dict[str, list[Topic]] = {}
    for topic in topics:
        if topic.problem is not None and topic.message_count != 0:
            by_reason.setdefault(topic.problem, []).append(topic)
    if by_reason:
        reasons = "; ".join(f"{format_topic_names(topics)}: {why}" for why, topics in list(by_reason.items())[:LISTED])
        more = f"; {len(by_reason) - LISTED} more reasons" if len(by_reason) > LISTED else ""
        yield f"topics with data that cannot be decoded: {reasons}{more}"


_LITTLE_SPAN = 0.5  # A sensor that was no messages for more than half of the drive does not win by its name
_LITTLE_SPAN_OF_POWER = 0.1
"""For power the coverage counts less, since topics measure propulsion or the whole battery: different quantities."""
_SILENCE_NS, _SILENT_PERIODS = 5_000_000_000, 10
_LITTLE_COUNT = 0.01
"""Largest ratio of rates of sensors for one role [1]: GNSS has 1 Hz to 20 Hz, odometry 10 Hz to 200 Hz."""


def find_short_topics(topics: Iterable[Topic], rivals: Iterable[Topic], *, of_power: bool = False) -> frozenset[str]:
    """Return topics by name that cover less than this share of a rival, or have less than a hundredth of its messages.

    A topic is not short if the index lacks its times or counts.
    """
    listed = list(rivals)
    little_span = _LITTLE_SPAN_OF_POWER if of_power else _LITTLE_SPAN
    least_s = little_span * max((_compute_covered_s(rival) or 0.0 for rival in listed), default=0.0)
    least = _LITTLE_COUNT * max((rival.message_count or 0 for rival in listed), default=0)
    spans = ((topic, _compute_covered_s(topic)) for topic in topics)
    return frozenset(
        topic.name
        for topic, span_s in spans
        if (span_s is not None and span_s < least_s)
        or (topic.message_count is not None and topic.message_count < least)
    )


def select_successive(topics: Sequence[Topic]) -> list[Topic]:
    """Return the first topic, and each other that ends before those in front of it begin, or begins after they end."""
    used: list[Topic] = []
    for one in topics:
        if all(_ends_before(one, other) or _ends_before(other, one) for other in used):
            used.append(one)
    return used


def _ends_before(one: Topic, other: Topic) -> bool:
    return one.end_ns is not None and other.start_ns is not None and one.end_ns < other.start_ns


def compute_dropouts_ns(spans_ns: Sequence[tuple[int, int]], count: int | None) -> int:
    """Return the total duration of a topic's dropouts [ns], from the spans (first, last time) with its messages.

    Only gaps of more than 5 s and ten mean periods count.
    """
    if len(spans_ns) < 2 or not count:
        return 0
    rising = sorted(spans_ns)
    ends = list(accumulate((end for _, end in rising), max))
    least_ns = max(_SILENCE_NS, _SILENT_PERIODS * (ends[-1] - rising[0][0]) // count)
    pauses = (start - end for (start, _), end in zip(rising[1:], ends, strict=False))
    return sum(pause for pause in pauses if pause > least_ns)


def format_coverage(topic: Topic) -> str:
    """Return ``658 messages over 65.7 s``, with the values that the index has."""
    span_s = topic.span_s
    count = "some messages" if topic.message_count is None else f"{topic.message_count} messages"
    silent = f", no messages for {topic.silent_ns / 1e9:.1f} s of them" if topic.silent_ns else ""
    return count if span_s is None else f"{count} over {span_s:.1f} s{silent}"


def _compute_covered_s(topic: Topic) -> float | None:
    return None if topic.span_s is None else topic.span_s - topic.silent_ns / 1e9


MISSING = {"no-gnss": "gnss", "no-power": "power", "no-imu": "imu", "no-wheel-odometry": "wheel_odometry"}
"""Role without which labels or checks are missing, by the code of the finding."""


def find_missing_roles(roles: Collection[str]) -> Findings:
    """Return a finding for each role that is not among ``roles`` and without which labels or checks are missing."""
    present = {*roles, "gnss"} if "pose" in roles else roles
    return tuple(make_finding(code, Subject("role", role)) for code, role in MISSING.items() if role not in present)


def find_left_out(reasons: Mapping[tuple[str, str], str]) -> Iterator[Finding]:
    """Yield a finding for each topic that is not used, by role and topic and with the reason."""
    for (role, name), reason in reasons.items():
        yield make_finding("topic-left-out", Subject("topic", name), names={"role": role, "reason": reason})


def find_undecodable(topics: Iterable[Topic], types: Collection[str]) -> Iterator[Finding]:
    """Yield a finding for each topic that cannot be decoded: a warning if its type can have a role."""
    for topic in topics:
        if topic.problem is not None and topic.message_count != 0:
            yield make_topic_not_decoded(topic, severity="warning" if topic.type_name in types else "note")


def make_topic_not_decoded(topic: Topic, *, severity: Severity = "warning") -> Finding:
    """Return the finding that a topic's messages cannot be decoded."""
    names = {"type": topic.type_name or "?", "encoding": topic.encoding or "?"}
    return make_finding("topic-not-decoded", Subject("topic", topic.name), severity=severity, names=names)


_POWER_OF_ANY_CLEARPATH = "clearpath_platform_msgs/msg/Power"
_FIRST_TO_PUBLISH_IT = "A200"
_SERIAL_NUMBER = re.compile(r"(?<![a-z0-9])([a-z]{1,2}\d{3})[_-]\d{4}(?!\d)")
"""How Clearpath names a robot in its topics: by platform and number."""


def find_robot(topics: Iterable[Topic], name: str | None, robots: Mapping[str, Robot]) -> tuple[str, str]:
    """Return the profile of a log, ``name`` if the user gave one, and the reason; `RecipeError` for an unknown name."""
    if name is not None:
        if name not in robots:
            raise RecipeError(f"robot: no profile {name!r}; known: {', '.join(sorted(robots))}")
        return name, "given"
    listed = sorted(topics, key=lambda topic: topic.name)
    if by_type := _find_only_topic(
        (n, t) for t in listed for n, robot in robots.items() if t.type_name in robot.status_types
    ):
        return by_type[0], f"topic {by_type[1].name} is {by_type[1].type_name}"
    if by_name := _find_only_topic((n, t) for t in listed for n, robot in robots.items() if _is_called(robot, t)):
        return by_name[0], f"topic {by_name[1].name} has its name"
    for topic in listed:
        if topic.type_name == _POWER_OF_ANY_CLEARPATH:
            if other := next((found for each in listed if (found := _SERIAL_NUMBER.search(each.name.lower()))), None):
                return GENERIC, f"topics are named after the platform {other[1].upper()}, which has no profile"
            first = next((n for n, robot in robots.items() if robot.platform == _FIRST_TO_PUBLISH_IT), GENERIC)
            return first, f"topic {topic.name} is {topic.type_name}, and nothing names another platform"
    return GENERIC, "no topic identifies the robot"


def _is_called(robot: Robot, topic: Topic) -> bool:
    words = "|".join(map(re.escape, robot.topic_words))
    return bool(words) and re.search(rf"(?<![a-z])({words})(?![a-z])", topic.name.lower()) is not None


def _find_only_topic(found: Iterable[tuple[str, Topic]]) -> tuple[str, Topic] | None:
    """Return the first pair if all of them agree on the robot."""
    pairs = list(found)
    return pairs[0] if pairs and len({name for name, _ in pairs}) == 1 else None


_ENOUGH = 3
_PLACES = frozenset({"gnss", "wheel_odometry"})


def find_robot_namespaces(candidates: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """Return the possible roles in each robot's namespace, or {} if one robot explains the topics.

    Two namespaces are two robots when three roles or more, GNSS or wheels among them, could be played in either. A
    camera that brings an IMU and an odometry of its own, or a controller that takes commands and gives odometry, is no
    robot.
    """
    roles_of: dict[str, set[str]] = {}
    for role, topics in candidates.items():
        for topic in topics:
            first, _, rest = topic.strip("/").partition("/")
            if rest:
                roles_of.setdefault(f"/{first}", set()).add(role)
    kinds = Counter(map(frozenset, roles_of.values()))  # few, however many namespaces there are
    robots = {
        name
        for name, roles in roles_of.items()
        for others, count in kinds.items()
        if count > (others == roles) and len(roles & others) >= _ENOUGH and roles & others & _PLACES
    }
    return {name: tuple(role for role in candidates if role in roles_of[name]) for name in sorted(robots)}


def ask_which_robot(robots: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the one question that a log of several robots asks, and the recipe line that answers it."""
    each = "; ".join(f"{name} ({', '.join(roles)})" for name, roles in robots.items())
    first, *others = robots
    other = "".join(f' or "{name}"' for name in others)
    return [
        f"the log contains {len(robots)} robots, but a run has one: {each}",
        "decide in the recipe (tcpipe.toml), for example:",
        *f"{RecipeFragment({'read': {'namespace': first}}).toml()}  #{other}".splitlines(),
    ]
