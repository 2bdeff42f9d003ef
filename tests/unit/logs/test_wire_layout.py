"""Layouts of example messages, against offsets worked out by hand from the CDR and ROS 1 rules."""

import struct

import numpy as np
import pytest

from tcpipe.logs.wire_layout import (
    ElementsAt,
    LayoutError,
    RaggedError,
    RepeatAt,
    ScalarAt,
    ScalarsAt,
    TextAt,
    has_layout,
    view_field,
    walk_layout,
)
from tcpipe.logs.wire_types import Array, Scalar, Text, iterate_flat_fields, record

U8, F32, F64 = Scalar("u1"), Scalar("f4"), Scalar("f8")
LITTLE = b"\x00\x01\x00\x00"


def nodes(layout):
    return dict(layout.root.fields)


def test_cdr_aligns_each_field_to_its_size_from_behind_the_header():
    of = record("a/msg/A", (("flag", U8), ("value", F64), ("name", Text()), ("after", F32)))
    payload = (
        LITTLE
        + b"\x07"
        + bytes(7)
        + struct.pack("<d", 2.5)
        + struct.pack("<I", 3)
        + b"hi\0"
        + b"\0"
        + struct.pack("<f", 1.0)
    )
    found = nodes(walk_layout(of, payload, encoding="cdr"))
    assert found["flag"] == ScalarAt(4, np.dtype("u1"))
    assert found["value"] == ScalarAt(12, np.dtype("<f8"))
    assert found["name"] == TextAt(24, 2)
    assert found["after"] == ScalarAt(28, np.dtype("<f4"))


def test_ros1_packs_without_gaps_and_texts_have_no_terminator():
    of = record("a/msg/A", (("flag", U8), ("value", F64), ("name", Text()), ("after", F32)))
    payload = b"\x07" + struct.pack("<d", 2.5) + struct.pack("<I", 2) + b"hi" + struct.pack("<f", 1.0)
    found = nodes(walk_layout(of, payload, encoding="ros1"))
    assert [found["flag"].offset, found["value"].offset, found["after"].offset] == [0, 1, 15]
    assert found["name"] == TextAt(13, 2)


def test_plain_xcdr2_aligns_doubles_to_four():
    of = record("a/msg/A", (("flag", U8), ("value", F64)))
    payload = b"\x00\x07\x00\x00" + b"\x01\0\0\0" + struct.pack("<d", 2.5)
    assert nodes(walk_layout(of, payload, encoding="cdr"))["value"].offset == 8


def test_equal_elements_become_one_stride():
    point = record("a/msg/P", (("x", F32), ("y", F32), ("z", F32)))
    of = record("a/msg/A", (("points", Array(point, None)),))
    values = np.arange(15, dtype="<f4")
    payload = LITTLE + struct.pack("<I", 5) + values.tobytes()
    found = nodes(walk_layout(of, payload, encoding="cdr"))["points"]
    assert isinstance(found, RepeatAt)
    assert (found.count, found.stride) == (5, 12)
    raw = np.frombuffer(payload, f"V{len(payload)}")
    y = dict(found.element.fields)["y"]
    assert view_field(raw, y.offset, y.dtype, ((5, 12),)).tolist() == [[1.0, 4.0, 7.0, 10.0, 13.0]]


def test_elements_whose_padding_differs_are_laid_out_one_by_one():
    mixed = record("a/msg/M", (("flag", U8), ("value", F64)))
    of = record("a/msg/A", (("list", Array(mixed, None)),))
    body = b""
    for index in range(5):  # the first element starts at 4, all others at multiples of 8
        body += b"\x01"
        body += bytes(-(4 + len(body)) % 8)
        body += struct.pack("<d", index)
    payload = LITTLE + struct.pack("<I", 5) + body
    found = nodes(walk_layout(of, payload, encoding="cdr"))["list"]
    assert isinstance(found, ElementsAt)
    values = [struct.unpack_from("<d", payload, dict(element.fields)["value"].offset)[0] for element in found.elements]
    assert values == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_same_shape_is_equality_of_all_lengths():
    of = record("a/msg/A", (("first", Text()), ("second", Text())))
    payloads = np.array([b"\x01\0\0\0a\x02\0\0\0bc", b"\x01\0\0\0d\x02\0\0\0ef", b"\x02\0\0\0gh\x01\0\0\0i"], "V11")
    layout = walk_layout(of, payloads[0].tobytes(), encoding="ros1")
    assert has_layout(layout, payloads).tolist() == [True, True, False]


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\x00\x03\x00\x00" + bytes(12),
        LITTLE + struct.pack("<I", 2**32 - 1),
        LITTLE + struct.pack("<I", 2) + bytes(8),
        LITTLE + struct.pack("<I", 1) + bytes(4 + 8 + 4),
    ],
    ids=["empty", "not a plain encoding", "endless sequence", "cut", "bytes left over"],
)
def test_what_does_not_fit_is_refused(payload):
    of = record("a/msg/A", (("values", Array(F64, None)),))
    with pytest.raises(LayoutError):
        walk_layout(of, payload, encoding="cdr")


def test_an_endless_sequence_of_nothing_is_refused_at_once():
    of = record("a/msg/A", (("nothings", Array(record("a/msg/E", ()), None)),))
    with pytest.raises(LayoutError, match="4294967295 elements cannot fit"):
        walk_layout(of, struct.pack("<I", 2**32 - 1), encoding="ros1")


def test_a_message_of_thousands_of_texts_is_left_to_the_row_by_row_reader():
    of = record("a/msg/A", (("texts", Array(Text(), None)),))
    with pytest.raises(RaggedError):
        walk_layout(of, struct.pack("<I", 5000) + bytes(4 * 5000), encoding="ros1")


def test_an_empty_sequence_needs_no_alignment():
    of = record("a/msg/A", (("values", Array(F64, None)), ("flag", U8)))
    found = nodes(walk_layout(of, LITTLE + struct.pack("<I", 0) + b"\x09", encoding="cdr"))
    assert isinstance(found["values"], ScalarsAt)
    assert found["flag"].offset == 8


def test_columns_are_named_by_their_path():
    inner = record("a/msg/I", (("x", F64), ("list", Array(F64, None))))
    of = record("a/msg/A", (("pose", inner), ("many", Array(inner, 2))))
    assert [name for name, _ in iterate_flat_fields(of)] == ["pose.x", "pose.list", "many"]
