"""Walks over long lists, and over bytes that do not fit; what is read of any type: tests/property/test_wire_decoding.py."""

import struct

import numpy as np
import pytest

from tcpipe.logs.wire_types import Array, Grid, LayoutError, Scalar, find_dialect, make_record, walk

U8, U32, F32, F64 = Scalar("u1"), Scalar("u4"), Scalar("f4"), Scalar("f8")
LITTLE = b"\x00\x01\x00\x00"


def walked(of, payloads, encoding="cdr"):
    ends = np.cumsum([len(payload) for payload in payloads])
    starts = ends - [len(payload) for payload in payloads]
    data = np.frombuffer(b"".join(payloads), np.uint8)
    return walk(of, data, starts, ends, find_dialect(payloads[0], encoding)), data


def offsets(values):
    return values.places.list_offsets().tolist() if isinstance(values.places, Grid) else values.places.tolist()


@pytest.mark.parametrize("counts", [(30_000, 30_000), (30_000, 2)], ids=["alike", "not alike"])
def test_many_elements_with_padding_behind_them_are_one_step(counts):
    """Points of a lidar: four bytes aligned, three bytes at the end."""
    point = make_record("a/msg/P", (("t", U32), ("x", F32), ("tag", U8), ("line", Array(U8, 2))))
    of = make_record("a/msg/A", (("points", Array(point, None)), ("end", U8)))
    written = np.zeros(
        max(counts), np.dtype([("t", "<u4"), ("x", "<f4"), ("tag", "u1"), ("line", "u1", 2), ("", "u1")])
    )
    written["t"], written["tag"] = np.arange(len(written)), np.arange(len(written)) % 251
    payloads = [LITTLE + struct.pack("<I", count) + written[:count].tobytes()[:-1] + b"\x09" for count in counts]
    found, data = walked(of, payloads)
    points, end = found.root.fields
    stamps, tags = points.elements.fields[0], points.elements.fields[2]
    expected = np.concatenate([np.arange(count) for count in counts])
    assert found.fits.all()
    assert points.counts.tolist() == list(counts)
    assert (np.array([data[at : at + 4].view("<u4")[0] for at in offsets(stamps)]) == expected).all()
    assert (data[offsets(tags)] == expected % 251).all()
    assert data[offsets(end)].tolist() == [9, 9]


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize(
    "payload",
    [
        LITTLE + struct.pack("<I", 2**32 - 1),
        LITTLE + struct.pack("<I", 2) + bytes(8),
        LITTLE + struct.pack("<I", 1) + bytes(4 + 8 + 4),
    ],
    ids=["endless sequence", "cut", "bytes left over"],
)
def test_what_does_not_fit_is_refused(payload, count):
    of = make_record("a/msg/A", (("values", Array(F64, None)),))
    assert not walked(of, [payload] * count)[0].fits.any()


@pytest.mark.parametrize("payload", [b"", b"\x00\x03\x00\x00" + bytes(12)], ids=["empty", "not a plain encoding"])
def test_an_encoding_that_is_none_of_ros_is_refused(payload):
    with pytest.raises(LayoutError):
        find_dialect(payload, "cdr")
