"""Which topic plays which role, from the topic list alone."""

from dataclasses import replace

import pytest

from tcpipe.errors import RecipeError
from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.logs import roles
from tcpipe.logs.roles import RoleAssignment
from tcpipe.logs.topics import (
    Topic,
    compute_dropouts_ns,
    find_robot,
    find_robot_namespaces,
    find_short_topics,
    format_coverage,
)
from tcpipe.tables.findings import select_findings

FIX, IMU = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu"
ODOMETRY, TWIST, STAMPED = "nav_msgs/msg/Odometry", "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
BATTERY, HUSKY, POWER = (
    "sensor_msgs/msg/BatteryState",
    "husky_msgs/msg/HuskyStatus",
    "clearpath_platform_msgs/msg/Power",
)


def assign_roles(*given, **named):
    return roles.assign_roles(*given, **named, known=load_shipped_profiles())


def topic(name: str, type_name: str, count: int | None = 101, problem: str | None = None) -> Topic:
    return Topic(name, type_name, count, 0, 10_000_000_000, "cdr", "", problem)


def assign(*topics: tuple[str, str], chosen=None, ignored=(), robot=None) -> RoleAssignment:
    return assign_roles([topic(name, kind) for name, kind in topics], chosen or {}, ignored, robot)


def played(assignment: RoleAssignment) -> dict[str, tuple[str, ...]]:
    assert assignment.problems == ()
    return {name: role.topics for name, role in assignment.roles.items()}


def left_out(assignment: RoleAssignment) -> list[tuple[str, str, str]]:
    """Role, topic and reason of what is not used though it could be."""
    found = select_findings(assignment.findings, "topic-left-out")
    return [(of.names["role"], of.subject.name, of.names["reason"]) for of in found]


def test_a_ros1_husky_with_everything() -> None:
    found = assign(
        ("/navsat/fix", FIX),
        ("/navsat/nmea_sentence", "nmea_msgs/msg/Sentence"),
        ("/imu/data", IMU),
        ("/imu/data_raw", IMU),
        ("/zed2/zed_node/imu/data", IMU),
        ("/husky_velocity_controller/odom", ODOMETRY),
        ("/odometry/filtered", ODOMETRY),
        ("/odometry/gps", ODOMETRY),
        ("/zed2/zed_node/odom", ODOMETRY),
        ("/status", HUSKY),
        ("/husky_velocity_controller/cmd_vel", TWIST),
        ("/joy_teleop/cmd_vel", TWIST),
        ("/move_base/cmd_vel", TWIST),
        ("/tf", "tf2_msgs/msg/TFMessage"),
        ("/tf_static", "tf2_msgs/msg/TFMessage"),
        ("/rosout", "rosgraph_msgs/msg/Log"),
    )
    assert played(found) == {
        "gnss": ("/navsat/fix",),
        "imu": ("/imu/data",),
        "wheel_odometry": ("/husky_velocity_controller/odom",),
        "visual_odometry": ("/zed2/zed_node/odom",),
        "power": ("/status",),
        "gnss_velocity": ("/navsat/nmea_sentence",),
        "command": ("/husky_velocity_controller/cmd_vel",),
    }
    assert found.robot == "husky"
    assert found.transforms == ("/tf_static", "/tf")
    assert left_out(found) == [
        ("wheel_odometry", "/odometry/filtered", "name"),
        ("wheel_odometry", "/odometry/gps", "name"),
        ("imu", "/imu/data_raw", "another-fits-better"),
        ("imu", "/zed2/zed_node/imu/data", "another-fits-better"),
        ("command", "/joy_teleop/cmd_vel", "another-fits-better"),
        ("command", "/move_base/cmd_vel", "another-fits-better"),
    ]
    assert {of.code for of in found.findings} == {"topic-left-out"}
    assert "filtered" in found.left_out["/odometry/filtered"]
    assert "gps" in found.left_out["/odometry/gps"]
    assert "/rosout" not in found.left_out


def test_a_ros2_husky_prefers_the_platform_over_the_estimators_and_bare_batteries() -> None:
    found = assign(
        ("/a200_0000/sensors/gps_0/fix", FIX),
        ("/a200_0000/sensors/imu_0/data", IMU),
        ("/a200_0000/platform/odom", ODOMETRY),
        ("/a200_0000/platform/odom/filtered", ODOMETRY),
        ("/a200_0000/platform/bms/state", BATTERY),
        ("/a200_0000/platform/mcu/status/power", POWER),
        ("/a200_0000/platform/cmd_vel", STAMPED),
        ("/a200_0000/platform/cmd_vel_unstamped", TWIST),
        ("/a200_0000/joy_teleop/cmd_vel", STAMPED),
        ("/a200_0000/tf_static", "tf2_msgs/msg/TFMessage"),
    )
    assert played(found) == {
        "gnss": ("/a200_0000/sensors/gps_0/fix",),
        "imu": ("/a200_0000/sensors/imu_0/data",),
        "wheel_odometry": ("/a200_0000/platform/odom",),
        "power": ("/a200_0000/platform/mcu/status/power",),
        "command": ("/a200_0000/platform/cmd_vel",),
    }
    assert found.robot == "husky"


FLOAT = "std_msgs/msg/Float64"
WARTHOG_DRIVES = [
    f"/lester/{side}_drive/status/battery_{what}" for side in ("left", "right") for what in ("current", "voltage")
]


def test_voltages_and_currents_apart_make_the_rails_of_both_drives() -> None:
    others = [
        ("/mcu/status", "warthog_msgs/msg/Status"),
        ("/computer/voltage", FLOAT),
        ("/left_drive/status/speed", FLOAT),
    ]
    found = assign(("/odom", ODOMETRY), *((name, FLOAT) for name in WARTHOG_DRIVES), *others)
    assert set(played(found)["power"]) == set(WARTHOG_DRIVES)
    assert found.roles["power"].why == "2 sides of one robot, summed"
    assert list(found.left_out) == ["/mcu/status"]  # its total current feeds more than the drives
    corrected = WARTHOG_DRIVES[0] + "_corrected"
    found = assign(("/odom", ODOMETRY), *((name, FLOAT) for name in [*WARTHOG_DRIVES, corrected]))
    assert set(played(found)["power"]) == {corrected, *WARTHOG_DRIVES[1:]}
    assert "corrected" in found.left_out[WARTHOG_DRIVES[0]]


def test_half_a_rail_is_no_power() -> None:
    found = assign(("/odom", ODOMETRY), ("/battery/voltage", FLOAT), ("/motor/current", FLOAT))
    assert "power" not in played(found)
    found = assign(("/odom", ODOMETRY), ("/battery/voltage", FLOAT), ("/battery/current", FLOAT))
    assert played(found)["power"] == ("/battery/current", "/battery/voltage")


@pytest.mark.parametrize(
    "names",
    [("/battery_1", "/battery_2"), ("/left/battery", "/right/battery", "/total/battery"), ("/left/a", "/right/b")],
)
def test_batteries_that_are_not_sides_are_asked_for(names: tuple[str, ...]) -> None:
    found = assign(("/odom", ODOMETRY), *((name, BATTERY) for name in names))
    assert "role power is ambiguous" in found.problems[0]
    assert all(name in found.problems[0] for name in names)
    assert "to be summed" in found.problems[-1]


def test_every_ambiguous_role_is_asked_for_at_once_with_lines_that_settle_it() -> None:
    topics = [
        ("/fix_a", FIX),
        ("/fix_b", FIX),
        ("/imu_a", IMU),
        ("/imu_b", IMU),
        ("/odom_a", ODOMETRY),
        ("/odom_b", ODOMETRY),
    ]
    found = assign(*topics)
    text = "\n".join(found.problems)
    for role in ("gnss", "imu", "wheel_odometry"):
        assert f"role {role} is ambiguous" in text
    assert "/fix_a (sensor_msgs/msg/NavSatFix, 101 messages, 10 Hz)" in text
    assert "[read.topics]" in found.problems
    chosen = {}
    for line in found.problems[found.problems.index("[read.topics]") + 1 :]:
        role, value = line.split("  #")[0].split(" = ")
        chosen[role] = [value.strip('[]"')]
    assert played(assign(*topics, chosen=chosen)) == {
        "gnss": ("/fix_a",),
        "imu": ("/imu_a",),
        "wheel_odometry": ("/odom_a",),
    }


def test_the_recipe_rules_over_types_names_and_ambiguity() -> None:
    topics = (("/odometry/filtered", ODOMETRY), ("/a/imu", IMU), ("/b/imu", IMU), ("/fix", FIX), ("/battery", BATTERY))
    chosen = {"wheel_odometry": ["/absent", "/odometry/filtered"], "imu": ["/b/imu"], "gnss": []}
    found = assign(*topics, chosen=chosen, ignored=["/battery"])
    assert played(found) == {"imu": ("/b/imu",), "wheel_odometry": ("/odometry/filtered",)}
    assert found.left_out["/battery"] == "the recipe ignores it"
    assert "recipe" in found.left_out["/fix"]
    assert {of.code for of in found.findings} == {"no-gnss", "no-power"}


def covering(name: str, type_name: str, count: int, span_s: float) -> Topic:
    return Topic(name, type_name, count, 0, round(span_s * 1e9), "cdr", "")


def test_a_named_topic_without_messages_leaves_the_role_to_the_next() -> None:
    log = [topic("/front/fix", FIX, 0), topic("/rear/fix", FIX), topic("/odom", ODOMETRY)]
    assert played(assign_roles(log, {"gnss": ["/front/fix", "/rear/fix"]}))["gnss"] == ("/rear/fix",)


@pytest.mark.parametrize(("little", "much"), [("/wheel/odom", "/odom"), ("/odom_a", "/odom_b"), ("/odom_b", "/odom_a")])
@pytest.mark.parametrize(("count", "span_s"), [(3, 65.0), (320, 32.0), (1, 0.0)])
def test_a_topic_that_covers_little_does_not_win_by_its_name(little: str, much: str, count: int, span_s: float) -> None:
    topics = [covering(little, ODOMETRY, count, span_s), covering(much, ODOMETRY, 658, 65.7)]
    found = assign_roles(topics, {})
    assert played(found) == {"wheel_odometry": (much,)}
    assert found.roles["wheel_odometry"].why == f"it covers more than {little}"
    assert left_out(found) == [("wheel_odometry", little, "covers-little")]
    assert found.left_out[little] == f"it covers little of what {much} covers (658 messages over 65.7 s)"
    assert played(assign_roles(topics, {"wheel_odometry": [little]})) == {"wheel_odometry": (little,)}


def test_what_covers_as_much_wins_by_its_name_and_a_slow_sensor_covers_all() -> None:
    slow = [covering("/wheel/odom", ODOMETRY, 66, 65.0), covering("/odom", ODOMETRY, 6580, 65.7)]
    assert played(assign_roles(slow, {})) == {"wheel_odometry": ("/wheel/odom",)}
    unknown = [Topic("/wheel/odom", ODOMETRY, None, None, None, "cdr", ""), slow[1]]
    assert played(assign_roles(unknown, {})) == {"wheel_odometry": ("/wheel/odom",)}
    alike = [covering("/odom_a", ODOMETRY, 400, 40.0), covering("/odom_b", ODOMETRY, 658, 65.7)]
    assert "ambiguous" in assign_roles(alike, {}).problems[0]


def test_what_cannot_be_decoded_is_a_finding_each_and_one_line_of_the_error() -> None:
    json = [
        topic(f"/json{n}", "foxglove.Pose", problem="its messages are encoded as json; cdr and ros1 are read")
        for n in range(12)
    ]
    proto = topic("/proto", IMU, problem="its messages are encoded as protobuf; cdr and ros1 are read")
    empty = topic("/empty", IMU, 0, problem="its messages are encoded as cbor; cdr and ros1 are read")
    found = assign_roles([*json, proto, empty], {})
    (said,) = [line for line in found.problems if line.startswith("topics with data that")]
    assert (
        "/json0, /json1, /json10, /json11, /json2, /json3, /json4, /json5 and 4 more: its messages are encoded as json"
        in said
    )
    assert "/proto: its messages are encoded as protobuf" in said
    assert "cbor" not in said
    with_motion = assign_roles([*json, proto, empty, topic("/odom", ODOMETRY)], {})
    assert with_motion.problems == ()
    for each in (found, with_motion):
        lost = {of.subject.name: of.severity for of in select_findings(each.findings, "topic-not-decoded")}
        assert lost == {**{of.name: "note" for of in json}, "/proto": "warning"}  # of which only an IMU has a role


def test_a_recipe_that_does_not_fit_the_log_is_an_error_with_what_there_is() -> None:
    topics = (("/fix", FIX), ("/odom", ODOMETRY), ("/left/battery", BATTERY))
    found = assign(
        *topics, chosen={"gnss": ["/gps"], "imu": ["/odom"], "power": ["/left/battery", "/right/battery"], "radar": []}
    )
    text = "\n".join(found.problems)
    assert "read.topics.gnss names /gps, which the log does not have; it has /fix" in text
    assert "read.topics.imu: /odom is nav_msgs/msg/Odometry; expected sensor_msgs/msg/Imu" in text
    assert "read.topics.power names /right/battery" in text
    assert "no role 'radar'" in text


def proposals(found: RoleAssignment) -> list[dict]:
    return [remedy.recipe for of in select_findings(found.findings, "topic-left-out") for remedy in of.remedies]


def test_a_log_without_motion_says_so_in_three_lines_and_how_to_use_what_was_left_out() -> None:
    found = assign(("/odometry/filtered", ODOMETRY), ("/imu", IMU), ("/chatter", "std_msgs/msg/String"))
    assert len(found.problems) == 3
    assert found.problems[0].startswith("no motion in the log")
    assert proposals(found) == [{"read.topics": {"wheel_odometry": ["/odometry/filtered"]}}]
    assert "/chatter (std_msgs/msg/String" in found.problems[2]
    assert len(assign(("/chatter", "std_msgs/msg/String")).problems) == 2
    empty = assign_roles([topic("/odom", ODOMETRY, count=0)], {})
    assert (len(empty.problems), proposals(empty)) == (2, []), "an empty topic is no way out"
    assert not proposals(assign(("/tcpipe/fix", FIX))), "nor is what was made of another log"


@pytest.mark.parametrize(
    ("name", "kind", "role"),
    [
        ("/vo", ODOMETRY, "visual_odometry"),
        ("/rtabmap/odom", ODOMETRY, "visual_odometry"),
        ("/stereo_odometer/odometry", ODOMETRY, "visual_odometry"),
        ("/wheel_odometry", ODOMETRY, "wheel_odometry"),
        ("/odom", ODOMETRY, "wheel_odometry"),
        ("/velocity", STAMPED, "wheel_odometry"),
        ("/wheels/twist", "geometry_msgs/msg/TwistWithCovarianceStamped", "wheel_odometry"),
        ("/odom_kf", ODOMETRY, None),
        ("/ground_truth/state", ODOMETRY, None),
        ("/lio_sam/mapping/odometry", ODOMETRY, None),
        ("/gps/fix_velocity", "geometry_msgs/msg/TwistWithCovarianceStamped", "gnss_velocity"),
        ("/cmd_vel", STAMPED, "command"),
        ("/turtle/command/twist", TWIST, "command"),
        ("/measured_twist", TWIST, None),
        ("/gps/filtered", FIX, None),
    ],
)
def test_names(name: str, kind: str, role: str | None) -> None:
    found = assign((name, kind), ("/other/fix", FIX) if kind != FIX else ("/encoder/odom", ODOMETRY))
    roles = {topics: role for role, topics in played(found).items()}
    assert roles.get((name,)) == role
    assert (name in found.left_out) == (role is None)


@pytest.mark.parametrize(
    ("topics", "robot"),
    [
        ([("/status", HUSKY)], "husky"),
        ([("/status", "warthog_msgs/msg/Status")], "warthog"),
        ([("/platform/power", POWER)], "husky"),
        ([("/w200_0042/platform/power", POWER)], "warthog"),
        ([("/warthog_velocity_controller/odom", ODOMETRY)], "warthog"),
        ([("/husky/odom", ODOMETRY), ("/jackal/odom", ODOMETRY)], "generic"),
        ([("/huskystone/odom", ODOMETRY)], "generic"),
        ([("/odom", ODOMETRY)], "generic"),
    ],
)
def test_the_robot_is_found_by_types_then_by_names(topics: list[tuple[str, str]], robot: str) -> None:
    assert assign(*topics, ("/wheel/odom", ODOMETRY)).robot == robot


def test_the_robot_given_rules_and_must_exist() -> None:
    assert assign(("/status", HUSKY), ("/odom", ODOMETRY), robot="warthog").robot == "warthog"
    with pytest.raises(RecipeError, match="known: dingo, generic, husky, husky_a300, jackal, ridgeback, warthog"):
        assign(("/odom", ODOMETRY), robot="spot")


def test_a_motors_phase_currents_play_no_role_and_the_reason_is_said() -> None:
    found = assign(
        ("/a300_0001/platform/odom", ODOMETRY),
        ("/a300_0001/platform/motors/feedback", "clearpath_motor_msgs/msg/LynxMultiFeedback"),
        ("/a300_0001/platform/bms/state", "sensor_msgs/msg/BatteryState"),
    )
    assert found.roles["power"].topics == ("/a300_0001/platform/bms/state",)
    name = "/a300_0001/platform/motors/feedback"
    assert ("power", name, "message-type") in left_out(found)
    assert "the phase current of the motor" in found.left_out[name]
    assert found.problems == ()


POSE, POSE_COV = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
WHEELS = ("/platform/odom", ODOMETRY)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("/icp_odom", ODOMETRY), ("/slam/pose", POSE_COV), ("/lio_sam/mapping/pose", POSE), ("/fast_lio/odom", ODOMETRY)],
)
def test_a_pose_that_is_called_so_stands_in_where_there_is_no_gnss(name: str, kind: str) -> None:
    alone = assign(WHEELS, (name, kind))
    assert played(alone) == {"wheel_odometry": ("/platform/odom",), "pose": (name,)}
    assert alone.roles["pose"].why.endswith("and there is no GNSS")
    assert not select_findings(alone.findings, "no-gnss")
    beside = assign(WHEELS, (name, kind), ("/fix", FIX))
    assert played(beside) == {"wheel_odometry": ("/platform/odom",), "gnss": ("/fix",)}
    assert "another estimator's output" in beside.left_out[name]


@pytest.mark.parametrize(
    "topics",
    [
        [("/odometry/filtered", ODOMETRY)],
        [("/move_base_simple/goal", POSE)],
        [("/amcl_pose", POSE_COV)],
        [("/icp_odom", ODOMETRY), ("/lego_loam/odom", ODOMETRY)],
    ],
)
def test_other_poses_and_two_of_them_play_only_where_they_are_named(topics: list[tuple[str, str]]) -> None:
    assert "pose" not in played(assign(WHEELS, *topics))
    name = topics[0][0]
    named = assign(WHEELS, *topics, ("/fix", FIX), chosen={"pose": [name]})
    assert played(named) == {"wheel_odometry": ("/platform/odom",), "pose": (name,)}
    assert named.left_out["/fix"] == f"the pose {name} is used instead"


def test_what_a_pose_was_made_from_is_not_fused_again() -> None:
    topics = [topic(*WHEELS), topic("/imu", IMU), topic("/odometry/filtered", ODOMETRY)]
    chosen = {"pose": ["/odometry/filtered"]}
    found = assign_roles(topics, chosen, pose_sources=["wheel_odometry"])
    assert played(found) == {"imu": ("/imu",), "pose": ("/odometry/filtered",)}
    both = assign_roles([*topics, topic("/fix", FIX)], {**chosen, "gnss": ["/fix"]})
    assert "names /fix as gnss and /odometry/filtered as pose" in both.problems[0]


TWIST_COVARIANCE, NMEA = "geometry_msgs/msg/TwistWithCovarianceStamped", "nmea_msgs/msg/Sentence"


@pytest.mark.parametrize(
    ("name", "kind", "fix"),
    [
        ("/ublox/fix_velocity", TWIST_COVARIANCE, "/ublox/fix"),
        ("/gps/vel", STAMPED, "/gps/fix"),
        ("/septentrio_gnss/twist_gnss", TWIST_COVARIANCE, "/septentrio_gnss/navsatfix"),
        ("/novatel/gps", "gps_common/msg/GPSFix", "/novatel/fix"),
        ("/nmea_sentence", NMEA, "/gps/fix"),
    ],
)
def test_a_receivers_own_velocity_goes_with_its_fixes(name: str, kind: str, fix: str) -> None:
    found = assign((fix, FIX), (name, kind), ("/odom", ODOMETRY))
    assert played(found) == {"gnss": (fix,), "wheel_odometry": ("/odom",), "gnss_velocity": (name,)}


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("/odometry/gps", ODOMETRY),
        ("/velocity", STAMPED),
        ("/septentrio_gnss/twist_ins", TWIST_COVARIANCE),
        ("/gps/cmd_vel", STAMPED),
        ("/gps/filtered_velocity", TWIST_COVARIANCE),
        ("/wheel/gps_synced", TWIST_COVARIANCE),
    ],
)
def test_other_velocities_are_never_taken_for_one(name: str, kind: str) -> None:
    assert "gnss_velocity" not in played(assign(("/gps/fix", FIX), (name, kind)))


def test_one_topic_of_sentences_tells_places_and_velocities() -> None:
    found = assign(("/gps/nmea", NMEA), ("/odom", ODOMETRY))
    assert played(found) == {"gnss": ("/gps/nmea",), "wheel_odometry": ("/odom",), "gnss_velocity": ("/gps/nmea",)}
    named = assign(("/gps/nmea", NMEA), chosen={"gnss": ["/gps/nmea"], "gnss_velocity": []})
    assert played(named) == {"gnss": ("/gps/nmea",)}


def test_of_two_receivers_that_of_the_fixes_is_taken_and_without_fixes_none() -> None:
    topics = (("/front/fix_velocity", TWIST_COVARIANCE), ("/rear/fix_velocity", TWIST_COVARIANCE), ("/odom", ODOMETRY))
    assert played(assign(("/rear/fix", FIX), *topics))["gnss_velocity"] == ("/rear/fix_velocity",)
    nobody = assign(("/fix", FIX), *topics)
    assert "gnss_velocity" not in played(nobody)
    assert left_out(nobody) == [("gnss_velocity", name, "several-fit") for name, _ in topics[:2]]
    alone = assign(*topics)
    assert "gnss_velocity" not in played(alone)
    assert "no topic is used as gnss" in alone.left_out["/rear/fix_velocity"]


KINDS = {"fix": "sensor_msgs/msg/NavSatFix", "imu": "sensor_msgs/msg/Imu", "odom": "nav_msgs/msg/Odometry"}


def test_a_camera_and_a_controller_are_no_robots():
    candidates = {
        "imu": ["/imu/data", "/zed2/imu/data"],
        "visual_odometry": ["/zed2/zed_node/odom"],
        "wheel_odometry": ["/husky_velocity_controller/odom", "/platform/odom"],
        "command": ["/husky_velocity_controller/cmd_vel", "/platform/cmd_vel"],
        "gnss": ["/fix"],
    }
    assert find_robot_namespaces(candidates) == {}


def assign_two_robots(namespace=None, chosen=None):
    names = [f"/{robot}/{name}" for robot in ("anna", "bert") for name in KINDS]
    topics = [Topic(name, KINDS[name.rsplit("/", 1)[1]], 9, 0, 10, "cdr", "") for name in [*names]]
    return assign_roles(topics, chosen or {}, namespace=namespace)


def test_the_namespace_answers_the_question():
    question = assign_two_robots().problems
    assert question[0].startswith("the log contains 2 robots")
    assert question[-1].startswith('namespace = "/anna"')
    for name in ("/bert", "bert", "/bert/"):
        found = assign_two_robots(name)
        assert found.problems == ()
        assert {topic for role in found.roles.values() for topic in role.topics} == {f"/bert/{kind}" for kind in KINDS}


def test_a_namespace_that_holds_nothing_is_a_mistake():
    assert "no topic below /carl" in assign_two_robots("/carl").problems[0]


@pytest.mark.parametrize(
    ("namespace", "name", "why"),
    [
        ("/a200_0123", "husky", "has its name"),
        ("/j100_0001", "jackal", "has its name"),
        ("/r100-0001", "ridgeback", "has its name"),
        ("/a300_0001", "husky_a300", "has its name"),
        ("/x400_0001", "generic", "the platform X400, which has no profile"),
        ("", "husky", "nothing names another platform"),
        ("/room100_0001", "husky", "nothing names another platform"),
    ],
)
def test_a_clearpath_robot_is_known_by_its_namespace(namespace, name, why):
    status = Topic(f"{namespace}/platform/mcu/status/power", "clearpath_platform_msgs/msg/Power", 1, 0, 0, "cdr", "")
    robot, said = find_robot([status], None, load_shipped_profiles().robots)
    assert robot == name
    assert why in said


S = 1_000_000_000


@pytest.mark.parametrize(
    ("spans_s", "count", "silent_s"),
    [
        ([(0, 10), (10, 20), (50, 60)], 1000, 30),
        ([(50, 60), (0, 20), (10, 15)], 1000, 30),  # in any order, one inside another
        ([(0, 10), (14, 20)], 1000, 0),  # a short pause
        ([(0, 1), (30, 31), (60, 61)], 3, 0),  # one message in 20 s: its period
        ([(0, 60)], 1000, 0),
        ([], 0, 0),
    ],
)
def test_silences_are_summed_where_they_are_no_period(spans_s, count, silent_s):
    assert compute_dropouts_ns([(first * S, last * S) for first, last in spans_s], count) == silent_s * S


def test_a_topic_that_paused_for_most_of_the_drive_covers_little():
    whole = Topic("/odom", "nav_msgs/msg/Odometry", 600, 0, 60 * S, "cdr", "")
    paused = replace(whole, name="/wheel/odom", message_count=200, silent_ns=40 * S)
    assert find_short_topics([whole, paused], [whole, paused]) == {"/wheel/odom"}
    assert format_coverage(paused) == "200 messages over 60.0 s, no messages for 40.0 s of them"
    assert find_short_topics([replace(paused, silent_ns=20 * S)], [whole]) == frozenset()
