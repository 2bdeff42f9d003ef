"""Messages of any type in any plain serialisation, against a serialiser that writes them value by value."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import get_types_from_msg

from tcpipe.formats.logs.arrow_columns import TopicTable
from tcpipe.formats.logs.log_part import MessageBlock
from tcpipe.formats.logs.ros_types import MessageType
from tcpipe.logs.wire_types import Array, LayoutError, Record, Scalar, Text, find_dialect, make_record

CODES = ("?", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8")
HEADERS = {b"\x00\x00": (">", 8), b"\x00\x01": ("<", 8), b"\x00\x06": (">", 4), b"\x00\x07": ("<", 4), None: ("<", 1)}
"""CDR big- and little-endian, plain XCDR2 big- and little-endian, ROS 1: byte order and largest alignment."""


class Writer:
    """Serialises one message as the specifications say, one value after the other."""

    def __init__(self, header):
        self.order, self.max_alignment = HEADERS[header]
        self.header, self.body = header, bytearray()

    def message(self, of, value):
        self.write(of, value)
        return (self.header + b"\0\0" if self.header else b"") + bytes(self.body)

    def align(self, size):
        self.body += bytes(-len(self.body) % min(size, self.max_alignment))

    def number(self, code, value):
        packed = np.array(value, np.dtype(self.order + code)).tobytes()
        self.align(len(packed))
        self.body += packed

    def write(self, of, value):
        if isinstance(of, Scalar):
            self.number(of.code, value)
        elif isinstance(of, Text):
            text = value.encode() + (b"\0" if self.header else b"")
            self.number("u4", len(text))
            self.body += text
        elif isinstance(of, Record):
            for name, field in of.fields:
                self.write(field, value[name])
            if not of.fields and self.header:
                self.body += b"\0"
        else:
            if of.length is None:
                self.number("u4", len(value))
            for element in value:
                self.write(of.element, element)


def wire_types():
    scalars = st.builds(Scalar, st.sampled_from(CODES))
    leaves = st.one_of(scalars, st.just(Text()))

    def records(children, *, fewest=0):
        fields = st.lists(children, min_size=fewest, max_size=4)
        return fields.map(lambda of: make_record("a/msg/R", tuple((f"f{n}", field) for n, field in enumerate(of))))

    def arrays(elements):
        return st.builds(Array, elements, st.none() | st.integers(1, 3))

    # Lists of messages without fields are refused where these take no bytes: a count of them could not be checked.
    fields = st.recursive(
        leaves | arrays(leaves), lambda inner: records(inner) | arrays(records(leaves, fewest=1)), max_leaves=8
    )
    return st.lists(fields, min_size=1, max_size=5).map(
        lambda of: make_record("a/msg/A", tuple((f"f{n}", field) for n, field in enumerate(of)))
    )


def random_value(of, rng, lengths):
    """A value; ``lengths`` decides how long texts and lists are."""
    if isinstance(of, Scalar):
        if of.code == "?":
            return bool(rng.integers(2))
        if of.code.startswith("f"):
            return float(np.dtype(of.code).type(rng.normal()))
        limits = np.iinfo(of.code)
        return int(rng.integers(limits.min, limits.max, dtype=of.code, endpoint=True))
    if isinstance(of, Text):
        return "".join(rng.choice(list("abcdé€")) for _ in range(int(lengths.integers(0, 5))))
    if isinstance(of, Record):
        return {name: random_value(field, rng, lengths) for name, field in of.fields}
    count = int(lengths.integers(0, 5)) if of.length is None else of.length
    return [random_value(of.element, rng, lengths) for _ in range(count)]


def flat(of, value, prefix=""):
    for name, field in of.fields:
        if isinstance(field, Record):
            yield from flat(field, value[name], f"{prefix}{name}.")
        else:
            yield prefix + name, value[name]


def decoded(of, payloads, encoding, definitions=None):
    """Return a table of messages, and how many could not be decoded."""
    table = TopicTable(MessageType(of, "log", definitions or {}), encoding)
    lengths = np.fromiter(map(len, payloads), np.int64, len(payloads))
    rows = np.arange(len(payloads))
    table.add(MessageBlock(0, memoryview(b"".join(payloads)), np.cumsum(lengths) - lengths, lengths, rows, rows, rows))
    return table.take(), table.undecodable


@settings(max_examples=60, deadline=None)
@given(
    header=st.sampled_from(list(HEADERS)),
    alike=st.booleans(),
    count=st.sampled_from([1, 12, 70]),
    seed=st.integers(0, 1 << 20),
    data=st.data(),
)
def test_every_type_in_every_serialisation(header, alike, count, seed, data):
    of = data.draw(wire_types())
    rng = np.random.default_rng(seed)
    values = [random_value(of, rng, np.random.default_rng(seed) if alike else rng) for _ in range(count)]
    payloads = [Writer(header).message(of, value) for value in values]
    found, lost = decoded(of, payloads, "cdr" if header else "ros1")
    assert lost == 0
    columns = [name for name, _ in flat(of, values[0])]
    assert found.column_names[2:] == columns
    for name in columns:
        expected = [dict(flat(of, value))[name] for value in values]
        assert json.dumps(found[name].to_pylist()) == json.dumps(expected), name


def _definitions():
    return get_types_from_msg("string[] texts\nfloat64 number\n", "a/msg/A")


@pytest.mark.parametrize("header", [b"\x00\x01", None])
def test_a_list_too_long_to_be_walked_side_by_side_is_read_message_by_message(header):
    of = make_record("a/msg/A", (("texts", Array(Text(), None)), ("number", Scalar("f8"))))
    values = [{"texts": ["a"] * count, "number": float(count)} for count in (21_000, 2, 0)]
    payloads = [Writer(header).message(of, value) for value in values]
    found, lost = decoded(of, payloads, "cdr" if header else "ros1", _definitions())
    assert lost == 0
    assert found["texts"].to_pylist() == [value["texts"] for value in values]
    assert found["number"].to_pylist() == [value["number"] for value in values]


@pytest.mark.parametrize("payload", [b"", b"\x00\x03\x00\x00" + bytes(12)], ids=["empty", "not a plain encoding"])
def test_an_encoding_that_is_none_of_ros_is_refused(payload):
    with pytest.raises(LayoutError):
        find_dialect(payload, "cdr")
