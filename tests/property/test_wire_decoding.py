"""Messages of any type in any plain serialisation, against a serialiser that writes them value by value."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tcpipe.formats.logs.arrow_columns import TopicTable
from tcpipe.formats.logs.log_part import MessageBlock
from tcpipe.formats.logs.ros_types import MessageType
from tcpipe.logs.wire_types import Array, Record, Scalar, Text, make_record

CODES = ("?", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8")
HEADERS = {b"\x00\x01": 8, None: 1}
"""CDR and ROS 1: largest alignment."""


class Writer:
    """Serialises one message as the specifications say, one value after the other."""

    def __init__(self, header):
        self.max_alignment = HEADERS[header]
        self.header, self.body = header, bytearray()

    def message(self, of, value):
        self.write(of, value)
        return (self.header + b"\0\0" if self.header else b"") + bytes(self.body)

    def align(self, size):
        self.body += bytes(-len(self.body) % min(size, self.max_alignment))

    def number(self, code, value):
        packed = np.array(value, np.dtype("<" + code)).tobytes()
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


def decoded(of, payloads, encoding):
    """Return a table of messages, and how many could not be decoded and why."""
    table = TopicTable(MessageType(of, "log", {}), encoding)
    lengths = np.fromiter(map(len, payloads), np.int64, len(payloads))
    rows = np.arange(len(payloads))
    table.add(MessageBlock(0, memoryview(b"".join(payloads)), np.cumsum(lengths) - lengths, lengths, rows, rows, rows))
    return table.take(), table.undecodable, table.undecodable_reason


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
    found, lost, _ = decoded(of, payloads, "cdr" if header else "ros1")
    assert lost == 0
    columns = [name for name, _ in flat(of, values[0])]
    assert found.column_names[2:] == columns
    for name in columns:
        expected = [dict(flat(of, value))[name] for value in values]
        assert json.dumps(found[name].to_pylist()) == json.dumps(expected), name


@pytest.mark.parametrize("header", [b"\x00\x01", None])
def test_a_message_with_an_endless_list_of_texts_is_left_out(header):
    of = make_record("a/msg/A", (("texts", Array(Text(), None)), ("number", Scalar("f8"))))
    values = [{"texts": ["a"] * count, "number": float(count)} for count in (21_000, 2, 0)]
    payloads = [Writer(header).message(of, value) for value in values]
    found, lost, reason = decoded(of, payloads, "cdr" if header else "ros1")
    assert lost == 1
    assert "a list of texts or messages is too long" in reason
    assert found["texts"].to_pylist() == [value["texts"] for value in values[1:]]
    assert found["number"].to_pylist() == [value["number"] for value in values[1:]]


@pytest.mark.parametrize("payload", [b"", b"\x00\x00\x00\x00" + bytes(12), b"\x00\x07\x00\x00" + bytes(12)])
def test_an_encoding_that_no_middleware_of_ros_writes_is_refused(payload):
    of = make_record("a/msg/A", (("number", Scalar("f8")),))
    found, lost, reason = decoded(of, [payload, Writer(b"\x00\x01").message(of, {"number": 2.0})], "cdr")
    assert (found["number"].to_pylist(), lost) == ([2.0], 1)
    assert reason.startswith("CDR header")
