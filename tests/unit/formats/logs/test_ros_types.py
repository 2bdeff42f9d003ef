"""Definitions found, completed, and refused."""

import pytest
from rosbags.typesys import Stores, get_typestore

from tcpipe.formats.logs.ros_types import DefinitionError, TypeLibrary
from tcpipe.logs.wire_types import Array, Record, Scalar, Text

SEPARATOR = "=" * 80 + "\n"
THING = "acme_msgs/msg/Thing"


def resolve(text, name=THING, *, ros1=False, schema_encoding="ros2msg"):
    found = TypeLibrary().find_type(name, definition=text, schema_encoding=schema_encoding, ros1=ros1)
    if isinstance(found, DefinitionError):
        raise found
    return found


@pytest.mark.parametrize(("edition", "version"), [(Stores.ROS1_NOETIC, 1), (Stores.ROS2_HUMBLE, 2)])
def test_the_text_of_a_bundled_definition_is_what_rosbags_writes(edition, version):
    store = get_typestore(edition)
    for name in ("nav_msgs/msg/Odometry", "diagnostic_msgs/msg/DiagnosticArray", "std_msgs/msg/Empty"):
        expected, _ = store.generate_msgdef(name, ros_version=version)
        constants = [f"{kind} {constant}={value}" for constant, kind, value in store.fielddefs[name][0]]
        lines = [line for line in expected.splitlines() if line not in constants and "=" not in line.strip("=")]
        assert resolve("", name=name, ros1=version == 1).text(ros1=version == 1).splitlines() == lines


def test_parts_that_the_log_leaves_out_come_from_the_bundled_definitions():
    header = resolve("std_msgs/Header header\nfloat32 value\n").wire.fields[0][1]
    assert isinstance(header, Record)
    assert [name for name, _ in header.fields] == ["stamp", "frame_id"]
    ros1_header = resolve("Header header\nfloat32 value\n", ros1=True, schema_encoding="ros1msg").wire.fields[0][1]
    assert [name for name, _ in ros1_header.fields] == ["seq", "stamp", "frame_id"]


def test_one_name_may_mean_two_things():
    library = TypeLibrary()
    kinds = [
        library.find_type("a/msg/A", definition=text, schema_encoding="ros2msg", ros1=False).wire.fields
        for text in ("float32 x\n", "float64 y\n")
    ]
    assert kinds == [(("x", Scalar("f4")),), (("y", Scalar("f8")),)]


def test_idl():
    text = (
        "module acme_msgs { module msg {\n  struct Thing {\n    double x;\n    sequence<float> values;\n"
        "    string name;\n    uint8 grid[4];\n  };\n}; };\n"
    )
    found = resolve(f"{SEPARATOR}IDL: acme_msgs/msg/Thing\n{text}", schema_encoding="ros2idl")
    assert found.wire.fields == (
        ("x", Scalar("f8")),
        ("values", Array(Scalar("f4"), None)),
        ("name", Text()),
        ("grid", Array(Scalar("u1"), 4)),
    )


@pytest.mark.parametrize(
    ("text", "name", "said"),
    [
        ("  \n", THING, "is unknown: the log contains no definition of it"),
        (
            "other_msgs/Missing part\n",
            THING,
            "other_msgs/msg/Missing, a part of acme_msgs/msg/Thing, is defined neither",
        ),
        ("Thing[] children\n", THING, "contains itself: acme_msgs/msg/Thing > acme_msgs/msg/Thing"),
        ("float64 x\n---\nfloat64 y\n", THING, "that of a service, not of a message"),
        ("int64 a\n---\nint64 sum\n", "acme_msgs/srv/Add_Event", "that of a service"),
        ("wstring wide\n", THING, "fields of type wstring are not supported"),
        ("float64 x\nint8 y\nfloat32 x\n", THING, "acme_msgs/msg/Thing defines x more than once"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(text, name, said):
    with pytest.raises(DefinitionError) as refused:
        resolve(text, name=name)
    assert said in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


def test_a_definition_that_unfolds_without_bound_is_refused():
    parts = [f"MSG: a/L{level}\n" + "".join(f"a/L{level + 1} f{i}\n" for i in range(10)) for level in range(8)]
    parts.append("MSG: a/L8\nfloat64 x\n")
    text = "a/L0 root\n" + "".join(SEPARATOR + part for part in parts)
    with pytest.raises(DefinitionError, match="expands to 100000000 columns"):
        resolve(text, name="a/msg/Top")


def test_definitions_bundled_for_robots_are_found():
    from tcpipe.formats.logs.ros_types import load_shipped_definitions

    assert "husky_msgs/msg/HuskyStatus" in load_shipped_definitions()
    for name in load_shipped_definitions():
        for ros1 in (False, True):
            assert resolve("", name=name, ros1=ros1).wire.fields
