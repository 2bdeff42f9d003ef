"""Assignment of topics to roles by the topic list, with the reason; ambiguous ones need a line of the recipe.

Rules, in this order: the recipe; outputs of other estimators are not used (fusing them would count a sensor twice);
the message type; the topic's name, unless it covers only a small part of what another covers; topics that follow each
other are joined. If several remain, tcpipe asks. Missing roles, and topics that are not used, are findings.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

from tcpipe.logs.power_fields import SIDES
from tcpipe.logs.topics import (
    LISTED,
    Topic,
    ask_which_robot,
    find_left_out,
    find_missing_roles,
    find_robot,
    find_robot_namespaces,
    find_short_topics,
    find_undecodable,
    format_coverage,
    format_topic_names,
    format_topics,
    list_undecodable,
    select_successive,
)
from tcpipe.power.sources import BATTERY_STATE, FLOAT_TYPES, find_quantity, is_corrected, make_rail_name
from tcpipe.recipe.suggestions import RecipeFragment, suggest
from tcpipe.robots import Profiles
from tcpipe.tables.findings import Finding, Findings, Subject, make_finding

NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
NMEA_SENTENCE = "nmea_msgs/msg/Sentence"
IMU = "sensor_msgs/msg/Imu"
ODOMETRY = "nav_msgs/msg/Odometry"
TWIST = "geometry_msgs/msg/Twist"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
TWIST_WITH_COVARIANCE_STAMPED = "geometry_msgs/msg/TwistWithCovarianceStamped"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE_STAMPED = "geometry_msgs/msg/PoseWithCovarianceStamped"
GPS_FIXES = ("gps_common/msg/GPSFix", "gps_msgs/msg/GPSFix")
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

_MEASURED_TWISTS = (ODOMETRY, TWIST_WITH_COVARIANCE_STAMPED, TWIST_STAMPED)

OVERLAY = "/tcpipe/"
"""Prefix of topics that `tcpipe overlay` added to a log: they have no role, so that results are never inputs."""

ROLE_TYPES: dict[str, tuple[str, ...]] = {
    "gnss": (NAV_SAT_FIX, *GPS_FIXES, NMEA_SENTENCE),
    "imu": (IMU,),
    "wheel_odometry": _MEASURED_TWISTS,
    "visual_odometry": _MEASURED_TWISTS,
    "gnss_velocity": (TWIST_WITH_COVARIANCE_STAMPED, *GPS_FIXES, TWIST_STAMPED, NMEA_SENTENCE),
    "power": FLOAT_TYPES,
    "command": (TWIST_STAMPED, TWIST),
    "pose": (POSE_WITH_COVARIANCE_STAMPED, ODOMETRY, POSE_STAMPED),
}
"""Message types for each role, best first; for power, types of profiles come before these."""

MOTION_ROLES = ("wheel_odometry", "visual_odometry", "gnss", "pose")
"""Roles of which a log needs one."""


@dataclass(frozen=True, slots=True)
class PlayedRole:
    """A role, its topics (power is their sum, else they are used in turn), the type of the first, and the reason."""

    name: str
    topics: tuple[str, ...]
    type_name: str
    why: str


@dataclass(frozen=True, slots=True)
class RoleAssignment:
    """Topics used as each role.

    ``left_out`` gives the reason why a topic of a fitting type is not used; ``problems`` are the plain lines of what
    the user has to decide; ``findings`` are the roles that are missing and the topics that are not used; ``transforms``
    are the topics that may place sensors, static ones first.
    """

    robot: str
    robot_why: str
    roles: Mapping[str, PlayedRole]
    left_out: Mapping[str, str]
    transforms: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    findings: Findings = ()
    choices: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Roles that several topics could be used as, and these."""

    @property
    def static_transforms(self) -> tuple[str, ...]:
        """The topics of static transforms, by name."""
        return tuple(topic for topic in self.transforms if topic.endswith("tf_static"))


@dataclass(slots=True)
class _Decisions:
    """The decisions while they are made."""

    types: Mapping[str, tuple[str, ...]]
    """Message types that fit each role, best first."""
    propulsion: Sequence[str]
    """Message types that measure propulsion separately, best first."""
    refusals: Mapping[str, str]
    """Message types whose currents are not drawn from the battery, with the reason."""
    roles: dict[str, PlayedRole] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    passed_over: dict[tuple[str, str], str] = field(default_factory=dict)
    """By role and topic, the reason why tcpipe does not use a topic that has data."""
    problems: list[str] = field(default_factory=list)
    ambiguous: list[str] = field(default_factory=list)
    choices: dict[str, tuple[str, ...]] = field(default_factory=dict)
    undecided: set[str] = field(default_factory=set)

    def pass_over(self, role: str, topic: Topic, why: str, reason: str) -> None:
        """Leave a candidate out, for a reason that is one word or several in kebab case."""
        self.left_out[topic.name] = why
        self.passed_over[role, topic.name] = reason


RoleName = TypeVar("RoleName", bound=str)


def assign_roles(
    topics: Iterable[Topic],
    chosen: Mapping[RoleName, Sequence[str]],
    ignored: Sequence[str] = (),
    robot: str | None = None,
    *,
    known: Profiles,
    namespace: str | None = None,
    mapped: Collection[str] = (),
    pose_sources: Collection[str] = (),
) -> RoleAssignment:
    """Return which topic plays which role, and why; `RecipeError`: no profile is called ``robot``.

    ``chosen`` is the recipe's ``read.topics``: of power all are summed; of other roles the first is used, and those
    named after it while it has no messages; an empty list means that no topic is used. Outside ``namespace`` only
    topics that are chosen by name are used. Those of the ``mapped`` roles (``read.fields``) may be of any type.
    """
    topics_by_name = {topic.name: topic for topic in sorted(topics, key=lambda topic: topic.name)}
    named = {name for names in chosen.values() for name in names}
    listed = {name: topic for name, topic in topics_by_name.items() if _is_in(namespace, topic) or name in named}
    wanted = {str(role): names for role, names in chosen.items()}
    name, robot_why = find_robot(listed.values(), robot, known.robots)
    types = {**ROLE_TYPES, "power": tuple(dict.fromkeys([*known.types(), *FLOAT_TYPES]))}
    propulsion = [type_name for type_name in known.types(propulsion=True) if type_name not in FLOAT_TYPES]
    decided = _Decisions(types, propulsion, known.refusals())
    if namespace is not None and not any(topic.type_name not in TRANSFORMS for topic in listed.values()):
        decided.problems.append(
            f"recipe read.namespace: no topic below {namespace}; the log has {format_topics(topics_by_name.values())}"
        )
    _take_chosen(decided, listed, wanted, mapped)
    taken = {name for role in decided.roles.values() for name in role.topics}
    free = [topic for topic in listed.values() if topic.name not in taken and _is_usable(decided, topic, ignored)]
    settled = dict.fromkeys(wanted, "the recipe chooses the topic for {role}")
    if "pose" in decided.roles:
        _let_stand_in(decided, settled, pose_sources)
    found = {
        role: candidates
        for role, candidates in _iterate_candidates(decided, free, settled)
        if role not in decided.roles and role not in settled
    }
    poses, velocities = found.pop("pose", []), found.pop("gnss_velocity", [])
    if not found.get("gnss", velocities):
        found["gnss"] = [candidate for candidate in velocities if candidate[2].type_name in GPS_FIXES]
    robots = find_robot_namespaces({role: [topic.name for _, _, topic in ranked] for role, ranked in found.items()})
    if robots:
        decided.problems += ask_which_robot(robots)
        decided.undecided |= set(found)
    else:
        for role, candidates in found.items():
            _decide(decided, role, candidates)
    _decide_pose(decided, poses, taken="gnss" in {*decided.roles, *decided.undecided} or "pose" in wanted)
    if "gnss_velocity" not in settled:
        apart = [
            candidate
            for candidate in velocities
            if "gnss" not in decided.roles or candidate[2].name not in decided.roles["gnss"].topics
        ]
        _decide_velocity(decided, apart + _collect_own_velocities(decided, listed.values(), ignored))
    elif "gnss_velocity" in decided.roles and "gnss" not in decided.roles:
        decided.problems.append(f"recipe read.topics.gnss_velocity: {_NO_FIXES}")
    no_motion, proposed = _find_no_motion(decided, list(listed.values()))
    lines = [_format_recipe_line(role, names) for role, names in decided.choices.items()]
    head = RecipeFragment({"read.topics": {}}).toml()
    how = ["decide in the recipe (tcpipe.toml), for example:", head, *lines] if decided.ambiguous else []
    problems = decided.problems + (no_motion or [*decided.ambiguous, *how])
    return RoleAssignment(
        name,
        robot_why,
        {role: decided.roles[role] for role in ROLE_TYPES if role in decided.roles},
        decided.left_out,
        _transform_topics(listed.values(), ignored),
        tuple(problems),
        (
            *find_missing_roles({*decided.roles, *decided.undecided}),
            *find_left_out(decided.passed_over),
            *proposed,
            *find_undecodable(listed.values(), {type_name for types in decided.types.values() for type_name in types}),
        ),
        decided.choices,
    )


def _is_in(namespace: str | None, topic: Topic) -> bool:
    """Whether a topic belongs to the robot that was asked for; transforms of no namespace belong to all."""
    below = namespace is None or topic.name.startswith(f"/{namespace.strip('/')}/")
    return below or (topic.type_name in TRANSFORMS and topic.name.count("/") == 1)


def _let_stand_in(decided: _Decisions, settled: dict[str, str], pose_sources: Collection[str]) -> None:
    """Exclude GNSS, which the pose replaces, and the roles that the pose was computed from."""
    pose = decided.roles["pose"].topics[0]
    for role in ("gnss", *pose_sources):
        if role in decided.roles:
            decided.problems.append(
                f"recipe read.topics names {decided.roles[role].topics[0]} as {role} and {pose} as pose: the pose replaces it; "
                f"remove one of them"
            )
        settled.setdefault(role, f"the pose {pose} is used instead")


def _decide_pose(decided: _Decisions, candidates: Ranked, *, taken: bool) -> None:
    """Use another program's pose if its name shows that, it is the only one, and no other topic measures positions."""
    best = [] if taken else _select_best("pose", candidates) if candidates else []
    for _, why, topic in candidates:
        if [topic] == [other for _, other in best]:
            decided.roles["pose"] = PlayedRole("pose", (topic.name,), topic.type_name, f"{why}, and there is no GNSS")
        elif topic.type_name == ODOMETRY:
            decided.pass_over(
                "wheel_odometry", topic, f"{why} that it is another estimator's output, not a sensor", "name"
            )
        else:
            decided.left_out[topic.name] = f"{why} that it is another estimator's output"


_NO_FIXES = "it needs the fixes of its receiver, and no topic is used as gnss"


def _decide_velocity(decided: _Decisions, candidates: Ranked) -> None:
    """Use the velocity of the receiver of the fixes; a velocity of an unknown receiver is not used, with a finding."""
    fixes = decided.roles["gnss"].topics[0] if "gnss" in decided.roles else ""
    receiver = fixes.rpartition("/")[0]
    near = [(rank, why, topic) for rank, why, topic in candidates if topic.name.rpartition("/")[0] == receiver]
    best = _select_best("gnss_velocity", near or candidates) if candidates and fixes else []
    why = best[0][0] if best else ""
    if len(best) == 1:
        topic = best[0][1]
        decided.left_out.pop(topic.name, None)
        decided.passed_over.pop(("gnss", topic.name), None)
        why = why or ("the receiver's sentences" if topic.type_name == NMEA_SENTENCE else f"the only {topic.type_name}")
        decided.roles["gnss_velocity"] = PlayedRole("gnss_velocity", (topic.name,), topic.type_name, why)
    taken = {name for role in decided.roles.values() for name in role.topics}
    if len(best) == 1:
        why, reason = f"{best[0][1].name} fits gnss_velocity better", "another-fits-better"
    else:
        why, reason = ("several could", "several-fit") if fixes else (_NO_FIXES, "no-gnss")
    for _, _, topic in candidates:
        if topic.name not in taken and topic.type_name != NMEA_SENTENCE:
            decided.pass_over("gnss_velocity", topic, why, reason)


def _collect_own_velocities(decided: _Decisions, topics: Iterable[Topic], ignored: Sequence[str]) -> Ranked:
    """Return the topics of NMEA sentences and of fixes that contain positions and velocities."""
    fixes = decided.roles["gnss"].topics if "gnss" in decided.roles else ()
    both = [
        topic
        for topic in topics
        if topic.type_name == NMEA_SENTENCE or (topic.type_name in GPS_FIXES and topic.name in fixes)
    ]
    rank = ROLE_TYPES["gnss_velocity"].index
    return [((rank(topic.type_name),), "", topic) for topic in both if _is_usable(decided, topic, ignored)]


def _take_chosen(
    decided: _Decisions, topics: Mapping[str, Topic], chosen: Mapping[str, Sequence[str]], mapped: Collection[str]
) -> None:
    for role, names in chosen.items():
        if role not in ROLE_TYPES:
            decided.problems.append(f"recipe read.topics: there is no role {role!r}; there are {', '.join(ROLE_TYPES)}")
            continue
        present = [name for name in names if name in topics]
        readable = [name for name in present if topics[name].problem is None and topics[name].message_count != 0]
        fits = [name for name in readable if topics[name].type_name in decided.types[role] or role in mapped]
        wanted = present if role == "power" else fits or present[:1]
        missing = [name for name in names if name not in topics]
        if missing and (role == "power" or not present):
            decided.undecided.add(role)
            decided.problems.append(
                f"recipe read.topics.{role} names {', '.join(missing)}, which the log does not have; "
                f"it has {format_topics(topics.values(), decided.types[role])}"
            )
        for name in wanted:
            if topics[name].type_name not in decided.types[role] and role not in mapped:
                wanted_types = " or ".join(decided.types[role])
                decided.problems.append(
                    f"recipe read.topics.{role}: {name} is {topics[name].type_name}; expected {wanted_types}"
                )
            elif topics[name].problem is not None:
                decided.problems.append(f"recipe read.topics.{role}: {name} cannot be read: {topics[name].problem}")
        if wanted:
            decided.roles[role] = PlayedRole(role, tuple(wanted), topics[wanted[0]].type_name, "set in the recipe")


def _is_usable(decided: _Decisions, topic: Topic, ignored: Sequence[str]) -> bool:
    if not any(topic.type_name in types for types in decided.types.values()):
        return False
    if topic.type_name in FLOAT_TYPES and find_quantity(topic.name) is None:
        return False
    why = None
    if topic.name in ignored:
        why = "the recipe ignores it"
    elif topic.problem is not None:
        why = f"it cannot be read: {topic.problem}"
    elif topic.message_count == 0:
        why = "it has no messages"
    elif topic.name.startswith(OVERLAY):
        why = "tcpipe made it from another log (tcpipe overlay): ingest that log"
    if why is not None:
        decided.left_out[topic.name] = why
    return why is None


# Words of topic names, matched from the start of a word: zed matches zed, zed2i and zedx.
_FUSED = re.compile(
    r"filtered|fused|fusion|ekf|ukf|kalman|icp|truth|groundtruth|gazebo|amcl|locali[sz]|loam|lio|lidar|laser|scan|"
    r"cartographer|hector|slam$|slam_toolbox|map$|mapping|global|world|gt$|kf$"
)
_FUSED_FIXES = re.compile(r"filtered|fused|fusion|ekf|ukf|truth")
_SLAM = re.compile(r"icp$|slam|loam|lego_?loam|(fast)?_?lio|liosam|cartographer|hector$|kiss$")
"""Poses from a laser, matched scan by scan, which no other topic of the log contains."""
_OF_GNSS = re.compile(r"gps|gnss|navsat|fix$|utm|ublox|novatel|septentrio|rtk")
_VISUAL = re.compile(
    r"zed|visual|vo$|vio$|svo|rtabmap|orb$|orbslam|stereo|camera|cam$|realsense|t265|rgbd|vins|mono|okvis|vslam"
)
_NOT_DOPPLER = re.compile(rf"{_FUSED.pattern}|ins$|odom|wheel|cmd")
_NO_SENSOR = ((_FUSED, "another estimator's output, not a sensor"), (_OF_GNSS, "made from GNSS"))
_OTHER_IMU = re.compile(r"odom|zed|camera|realsense|t265|d435|d455|oak|ouster|os_?cloud|velodyne|livox|lidar|phone")
_WHEEL = re.compile(r"wheel|velocity|base|platform|drive|diff|encoder|odom")
_COMMAND = re.compile(r"cmd|command|commands|cmdvel")
_HUMAN_OR_PLANNER = re.compile(r"joy|teleop|nav|move|interactive|marker|key|web|rc$|auto|external|smooth|safe|raw")


def _find_role_word(pattern: re.Pattern[str], name: str) -> str | None:
    """Return the first word of a topic's name that the pattern matches from its start."""
    return next((word for word in re.split(r"[/_\-.]+", name.lower()) if word and pattern.match(word)), None)


Ranked = list[tuple[tuple[int, ...], str, Topic]]
"""Candidates with their rank (smaller is better) and the reason for it."""


def _iterate_candidates(
    decided: _Decisions, topics: Sequence[Topic], settled: Mapping[str, str]
) -> Iterable[tuple[str, Ranked]]:
    """Yield each role with its ranked candidates; topics that cannot be candidates are left out with the reason."""
    found: dict[str, Ranked] = {role: [] for role in ROLE_TYPES}
    bare = [topic for topic in topics if topic.type_name in FLOAT_TYPES]
    for topic in topics:
        if topic.type_name in FLOAT_TYPES:
            continue
        role, rank, why = (_SORTERS.get(topic.type_name) or partial(_sort_power, decided))(topic)
        if role is None:
            decided.left_out[topic.name] = why
            usual = next(role for role, types in decided.types.items() if topic.type_name in types)
            if usual not in (*settled, "pose"):
                decided.pass_over(usual, topic, why, "message-type" if topic.type_name in decided.refusals else "name")
        elif role in settled and role != "pose":
            decided.left_out[topic.name] = settled[role].format(role=role)
        else:
            found[role].append((rank, why, topic))
    if "power" not in settled:
        found["power"] += _find_bare_power(decided, bare)
    return found.items()


Sorted = tuple[str | None, tuple[int, ...], str]


def _sort_gnss(topic: Topic, *, role: str, fused: re.Pattern[str]) -> Sorted:
    if word := _find_role_word(fused, topic.name):
        return None, (), f"its name ({word}) means output of another estimator"
    return role, (ROLE_TYPES[role].index(topic.type_name),), ""


def _sort_imu(topic: Topic) -> Sorted:
    if word := _find_role_word(_OTHER_IMU, topic.name):
        return "imu", (1,), f"its name ({word}) means another device, or computed from odometry"
    raw = bool(re.search(r"(^|[/_])raw$", topic.name))
    return "imu", (0, int(raw)), ""


def _sort_odometry(topic: Topic) -> Sorted:
    name = topic.name
    if topic.type_name == ODOMETRY and _find_role_word(_SLAM, name) and not _find_role_word(_VISUAL, name):
        return _sort_pose(topic)
    kind = ROLE_TYPES["wheel_odometry"].index(topic.type_name)
    for pattern, what in _NO_SENSOR:
        if word := _find_role_word(pattern, name):
            return None, (), f"its name ({word}) means {what}"
    if word := _find_role_word(_VISUAL, name):
        return "visual_odometry", (kind,), f"its name contains {word}"
    explicit = bool(re.search(r"wheel|velocity_controller|platform|encoder|diff_drive|drive_base", name.lower()))
    if topic.type_name != ODOMETRY and not explicit and not _find_role_word(_WHEEL, name):
        return None, (), "its name does not identify what it measures"
    return "wheel_odometry", (int(not explicit), kind), "its name means wheels" if explicit else ""


def _sort_twist(topic: Topic) -> Sorted:
    """Sort a twist without a pose: of a command, of a receiver (over ground), else of an odometry."""
    name, word = topic.name, _find_role_word(_OF_GNSS, topic.name)
    if topic.type_name == TWIST_STAMPED and _find_role_word(_COMMAND, name):
        return _sort_command(topic)
    if word and not _find_role_word(_NOT_DOPPLER, name):
        return "gnss_velocity", (ROLE_TYPES["gnss_velocity"].index(topic.type_name),), f"its name contains {word}"
    return _sort_odometry(topic)


def _sort_pose(topic: Topic) -> Sorted:
    if word := _find_role_word(_SLAM, topic.name):
        return "pose", (ROLE_TYPES["pose"].index(topic.type_name),), f"its name ({word}) means"
    return (
        None,
        (),
        "a pose is used if the recipe names it, or its name contains icp, slam, loam, lio, cartographer or hector",
    )


def _sort_command(topic: Topic) -> Sorted:
    name = topic.name.lower()
    if not _find_role_word(_COMMAND, name):
        return None, (), "a Twist whose name is not that of a command"
    stamped = ROLE_TYPES["command"].index(topic.type_name)
    if name.endswith("cmd_vel_out"):
        return "command", (0, stamped), "it is the output of the controller"
    if _find_role_word(_HUMAN_OR_PLANNER, name):
        return "command", (3, stamped), "the only command"
    if re.search(r"controller|platform|base", name):
        return "command", (1, stamped), "it is the input of the controller"
    return "command", (2, stamped), ""


_DRIVES = re.compile(r"drive|motor|wheel|traction")


def _sort_power(decided: _Decisions, topic: Topic) -> Sorted:
    """Rank messages that measure propulsion separately first, then currents of the drives, then whole batteries."""
    if topic.type_name in decided.refusals:
        return None, (), f"its type {decided.refusals[topic.type_name]}"
    if topic.type_name in decided.propulsion:
        return "power", (0, decided.propulsion.index(topic.type_name)), "its type measures propulsion separately"
    if topic.type_name == BATTERY_STATE:
        return "power", (1 if _find_role_word(_DRIVES, topic.name) else 4,), ""
    return "power", (3,), ""


def _find_bare_power(decided: _Decisions, topics: Iterable[Topic]) -> Ranked:
    """Return bare numbers that form power rails: a voltage and a current of similar names, of drives or batteries."""
    rails: dict[str, list[Topic]] = {}
    for topic in topics:
        if find_quantity(topic.name) is not None and re.search(r"drive|motor|traction|batter", topic.name.lower()):
            rails.setdefault(make_rail_name(topic.name), []).append(topic)
    found: Ranked = []
    for parts in rails.values():
        corrected = {find_quantity(topic.name) for topic in parts if is_corrected(topic.name)}
        used = [topic for topic in parts if is_corrected(topic.name) or find_quantity(topic.name) not in corrected]
        if sorted(str(find_quantity(topic.name)) for topic in used) == ["current", "voltage"]:
            found += [((2,), "", topic) for topic in used]
            decided.left_out |= {topic.name: "its corrected form is taken" for topic in parts if topic not in used}
    return found


_SORTERS: dict[str, Callable[[Topic], Sorted]] = {
    **dict.fromkeys(ROLE_TYPES["gnss"], partial(_sort_gnss, role="gnss", fused=_FUSED_FIXES)),
    **dict.fromkeys(GPS_FIXES, partial(_sort_gnss, role="gnss_velocity", fused=_FUSED)),
    **dict.fromkeys(ROLE_TYPES["command"], _sort_command),
    **dict.fromkeys(ROLE_TYPES["imu"], _sort_imu),
    **dict.fromkeys((POSE_STAMPED, POSE_WITH_COVARIANCE_STAMPED), _sort_pose),
    ODOMETRY: _sort_odometry,
    **dict.fromkeys((TWIST_STAMPED, TWIST_WITH_COVARIANCE_STAMPED), _sort_twist),
}


def _decide(decided: _Decisions, role: str, candidates: Ranked) -> None:
    if not candidates:
        return
    first = _select_best(role, candidates)
    topics = [topic for _, topic in first]
    # A topic that is renamed during the log goes on as another one.
    is_joined = role != "power" and len(topics) == len(select_successive(topics))
    if is_joined:
        same_type = [topic for _, _, topic in candidates if topic.type_name == topics[0].type_name]
        short = find_short_topics(same_type, topics, of_power=True)
        topics = select_successive([*topics, *(topic for topic in same_type if topic.name not in short)])
    names = tuple(topic.name for topic in topics)
    taken = set(names)
    others = [topic for _, _, topic in candidates if topic.name not in taken]
    thin = find_short_topics(others, topics, of_power=role == "power")
    # Bare numbers share a rail, other topics are one each.
    rails = tuple(dict.fromkeys(make_rail_name(t.name) if t.type_name in FLOAT_TYPES else t.name for t in topics))
    if is_joined and len(topics) > 1:
        why = "they follow each other"
    elif len(first) == 1:
        better = "it covers more" if thin and len(thin) == len(others) else "it fits better"
        better = f"{better} than {format_topic_names(others)}" if others else f"the only {topics[0].type_name}"
        why = first[0][0] or better
    elif role == "power" and _are_sides(rails):
        why = f"{len(rails)} sides of one robot, summed" if len(rails) > 1 else "voltage and current on two topics"
    else:
        decided.ambiguous.append(
            f"role {role} is ambiguous, {len(first)} topics could be used: {format_topics(topics)}"
        )
        decided.choices[role] = names
        decided.undecided.add(role)
        return
    decided.roles[role] = PlayedRole(role, names, topics[0].type_name, why)
    winner = " + ".join(names)
    little = f"it covers little of what {winner} covers ({format_coverage(topics[0])})"
    for topic in others:
        if topic.name in thin:
            decided.pass_over(role, topic, little, "covers-little")
        else:
            decided.pass_over(role, topic, f"{winner} fits {role} better", "another-fits-better")


def _select_best(role: str, candidates: Ranked) -> list[tuple[str, Topic]]:
    """Return the best-ranked candidates with their reasons, without those that cover little compared with another.

    Of power all of a rank are taken, since sides are summed, also a side without later messages.
    """
    topics = [topic for _, _, topic in candidates]
    thin = find_short_topics(topics, topics, of_power=role == "power")
    ample = [entry for entry in candidates if entry[2].name not in thin] or candidates
    best = min(rank for rank, _, _ in ample)
    return [(why, topic) for rank, why, topic in (candidates if role == "power" else ample) if rank == best]


def _are_sides(names: Sequence[str]) -> bool:
    """Whether there is one name, or the names are equal but for words that name a side, each side once."""
    if len(names) == 1:
        return True
    split = [re.split(r"([/_\-.]+)", name.lower()) for name in names]
    bare = {tuple("" if word in SIDES else word for word in words) for words in split}
    sides = {tuple(word for word in words if word in SIDES) for words in split}
    return len(bare) == 1 and len(sides) == len(names) and () not in sides


def _format_recipe_line(role: str, names: Sequence[str]) -> str:
    others = "".join(f' or ["{name}"]' for name in names[1:])
    how = "several to be summed" if role == "power" else "if they follow each other"
    several = f", or {how}: [{', '.join(f'{chr(34)}{name}{chr(34)}' for name in names)}]"
    line = RecipeFragment({"read.topics": {role: [names[0]]}}).toml().splitlines()[-1]
    return f"{line}  #{others}{several}"


def _find_no_motion(decided: _Decisions, topics: Sequence[Topic]) -> tuple[list[str], list[Finding]]:
    """If no topic has motion, return lines of the error, and a finding that proposes an unused topic."""
    if any(role in decided.roles or role in decided.undecided for role in MOTION_ROLES):
        return [], []
    findings = []
    lines = ["no motion in the log: no topic is used as wheel_odometry, visual_odometry or gnss"]
    able = {
        topic.name: role
        for role in reversed(MOTION_ROLES)
        for topic in topics
        if topic.message_count != 0 and topic.type_name in ROLE_TYPES[role]
    }
    could = {name: why for name, why in decided.left_out.items() if name in able}
    if could:
        reasons = "; ".join(f"{name} since {why}" for name, why in list(could.items())[:LISTED])
        readable = {topic.name for topic in topics if topic.problem is None and not topic.name.startswith(OVERLAY)}
        name = next((name for name in could if name in readable), "")
        lines.append(f"not used: {reasons}")
        if name:
            role = able[name]
            names, remedies = {"role": role, "reason": "name"}, suggest("use", {"read.topics": {role: [name]}})
            subject = Subject("topic", name)
            findings.append(make_finding("topic-left-out", subject, severity="warning", names=names, remedies=remedies))
    return [*lines, *list_undecodable(topics), f"the log has {format_topics(topics)}"], findings


def _transform_topics(topics: Iterable[Topic], ignored: Sequence[str]) -> tuple[str, ...]:
    usable = [topic for topic in topics if topic.type_name in TRANSFORMS and topic.name not in ignored]
    names = [topic.name for topic in usable if topic.problem is None and topic.message_count != 0]
    return tuple(sorted(names, key=lambda name: (not name.endswith("tf_static"), name)))
