"""Definition texts read line by line, against what rosbags' grammar makes of the same texts."""

import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tcpipe.logs.wire_types import BASE_TYPES, FieldType, MsgTextError, parse_msg


def described(of):
    one = (Nodetype.BASE, (of.name, of.text_limit)) if of.name in BASE_TYPES else (Nodetype.NAME, of.name)
    if of.length is None:
        return one
    return (Nodetype.ARRAY if of.fixed else Nodetype.SEQUENCE, (one, of.length))


@pytest.mark.parametrize(("edition", "version"), [(Stores.ROS1_NOETIC, 1), (Stores.ROS2_HUMBLE, 2)])
def test_every_standard_definition_is_what_rosbags_reads(edition, version):
    store = get_typestore(edition)
    for name in store.fielddefs:
        text, _ = store.generate_msgdef(name, ros_version=version)
        found = {
            of: [(field, described(kind)) for field, kind in fields] for of, fields in parse_msg(text, name).items()
        }
        assert found == {of: list(fields) for of, (_, fields) in get_types_from_msg(text, name).items()}


def test_constants_defaults_bounds_and_comments():
    text = (
        "# a thing\r\nuint8 KIND=3\r\nstring NAME = 'a # b'  # why\n  string<=10 name \"x\" # its name\nfloat64[3] xyz [1.0, 2.0, 3.0]\n"
        "string<=5[<=3] some\nwstring[] wide\nHeader header\ntime at\nOther part\npkg/Name far\nint32 small=1\n@verbatim\n"
    )
    assert parse_msg(text, "a/msg/A") == {
        "a/msg/A": (
            ("name", FieldType("string", 10)),
            ("xyz", FieldType("float64", 0, 3, fixed=True)),
            ("some", FieldType("string", 5, 3)),
            ("wide", FieldType("wstring", 0, 0)),
            ("header", FieldType("std_msgs/msg/Header")),
            ("at", FieldType("builtin_interfaces/msg/Time")),
            ("part", FieldType("a/msg/Other")),
            ("far", FieldType("pkg/msg/Name")),
        )
    }


def test_the_first_definition_of_a_name_holds():
    separator = "=" * 80 + "\n"
    text = f"Part part\n{separator}MSG: a/Part\nfloat32 x\n{separator}MSG: a/Part\nfloat64 y\n"
    assert parse_msg(text, "a/msg/A")["a/msg/Part"] == (("x", FieldType("float32")),)


@pytest.mark.parametrize("line", ["float64", "float64 { x", "---", "int32[<=] x", "int32<=4 x", "int32 4x"])
def test_lines_that_are_no_fields_are_refused(line):
    with pytest.raises(MsgTextError):
        parse_msg(f"float64 a\n{line}\n", "a/msg/A")
