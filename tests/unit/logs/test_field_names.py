"""What a message type of somebody's own could play is told by its definition, and by nothing that is of another role."""

from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.logs.field_mapping import list_number_fields, match_field_names, propose_roles
from tcpipe.logs.topics import Topic
from tcpipe.recipe import ReadConfig
from tcpipe.stages.read_roles import decide_roles
from tcpipe.tables.findings import select_findings

RTK = """std_msgs/Header header
float64 latitude
float64 longitude   # deg
float64 altitude
float64 utm_easting
uint8 zone
string letter
"""
IMU_INSIDE = f"""Header header
sensor_msgs/Imu imu
string raw
{"=" * 80}
MSG: sensor_msgs/Imu
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
{"=" * 80}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""


def topic(
    name: str, definition: str, kind: str = "driver/msg/Own", problem: str | None = None, count: int = 9
) -> Topic:
    return Topic(name, kind, count, 0, 10**9, "ros1", definition, problem)


def test_a_receiver_s_own_message_is_proposed_with_the_lines_of_the_recipe() -> None:
    (found,) = propose_roles([topic("/rtk", RTK)], settled=())
    assert (found.code, found.subject.name, found.names["role"]) == ("role-proposed", "/rtk", "gnss")
    fields = {name: name for name in ("latitude", "longitude", "altitude")}
    assert [of.recipe for of in found.remedies] == [
        {"read.topics": {"gnss": ["/rtk"]}, "read.fields": {"gnss": fields}}
    ]


def test_fields_are_looked_for_in_the_messages_inside_a_message() -> None:
    (found,) = propose_roles([topic("/vectornav", IMU_INSIDE)], settled=())
    fields = found.remedies[0].recipe["read.fields"]["imu"]
    assert fields["angular_velocity_z"] == "imu.angular_velocity.z"
    assert fields["linear_acceleration_x"] == "imu.linear_acceleration.x"


def test_nothing_is_proposed_for_what_is_played_or_cannot_be_read_or_lacks_a_field() -> None:
    assert not list(propose_roles([topic("/rtk", RTK)], settled={"gnss"}))
    fix = topic("/fix", "", "sensor_msgs/msg/NavSatFix")
    assert not list(propose_roles([topic("/rtk", RTK), fix], settled=()))
    others = [
        topic("/empty", RTK, count=0),
        topic("/lost", RTK, problem="encoded as json"),
        topic("/text", RTK.replace("float64 latitude", "string latitude")),
        topic("/half", "float64 latitude"),
        topic("/broken", "float64 latitude\nfloat64 longitude\n???\n"),
        topic("/endless", f"Own inner\n{'=' * 80}\nMSG: driver/Own\nOwn inner\n"),
        topic("/tcpipe/track", RTK),
    ]
    assert not list(propose_roles(others, settled=()))


def test_a_definition_that_is_made_to_hurt_is_not_searched() -> None:
    rule = "=" * 80
    deep = "".join(f"L1 f{n}\n" for n in range(60))
    for level in range(1, 5):
        inner = "int8" if level == 4 else f"L{level + 1}"
        deep += f"{rule}\nMSG: driver/L{level}\n" + "".join(f"{inner} f{n}\n" for n in range(60))
    assert len(deep) < 1 << 16
    assert len(list_number_fields(topic("/deep", deep))) == 1000, "of hundreds of millions"
    assert len(list_number_fields(topic("/wide", "int8 a\n" * 9_000))) == 1000
    assert list_number_fields(topic("/long", RTK + "int8 a\n" * 10_000)) == []


def test_a_log_without_motion_asks_with_the_proposal_and_one_with_motion_warns_with_it() -> None:
    odom = topic("/odom", "", "nav_msgs/msg/Odometry")
    alone = decide_roles(ReadConfig(), [topic("/rtk", RTK)], None, known=load_shipped_profiles())
    assert alone.problems
    beside = decide_roles(ReadConfig(), [topic("/rtk", RTK), odom], None, known=load_shipped_profiles())
    assert not beside.problems
    (proposed,) = select_findings(alone.findings, "role-proposed")
    assert beside.findings[-1] == proposed
    ignored = decide_roles(
        ReadConfig(ignore_topics=("/rtk",)), [topic("/rtk", RTK), odom], None, known=load_shipped_profiles()
    )
    assert not any(of.subject.name == "/rtk" for of in ignored.findings)


def test_columns_are_told_with_their_units_left_off() -> None:
    assert match_field_names("gnss", ["time", "lat_deg", "lon (deg)", "h_m"]) == {
        "latitude": "lat_deg",
        "longitude": "lon (deg)",
        "altitude": "h_m",
    }
