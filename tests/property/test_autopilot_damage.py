"""Autopilot logs cut, flipped and filled with garbage anywhere: what is read was written, and what is missing is said."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from autopilot_files import Drive, write_dataflash, write_ulog
from hypothesis import given, settings
from hypothesis import strategies as st

from tcpipe.formats.logs.autopilot_log import read_autopilot_records

WRITERS = {"ulog": write_ulog, "dataflash": write_dataflash}


def read(path, kind):
    """Return the count of every message of a log, and whether a loss is reported."""
    records = read_autopilot_records(path, kind)
    rows = Counter()
    for name, of in records.messages.items():
        columns = of.read_columns(records.data).values()
        rows.update(f"{name} {values}" for values in zip(*(values.tolist() for values in columns), strict=True))
    return rows, any(damage.is_loss for damage in records.damage)


def find_ends(kind, data):
    """Return where messages end, by the lengths that the writer wrote."""
    at, ends, lengths = (16 if kind == "ulog" else 0), [], {0x80: 89}
    while at < len(data):
        if kind == "ulog":
            at += 3 + int.from_bytes(data[at : at + 2], "little")
        else:
            if data[at + 2] == 0x80:
                lengths[data[at + 3]] = data[at + 4]
            at += lengths[data[at + 2]]
        ends.append(at)
    return ends


@pytest.fixture(scope="module", params=WRITERS)
def written(request, tmp_path_factory):
    """Return a kind of log, the bytes of one, its messages, where they end, and a place for changed ones."""
    path = WRITERS[request.param](tmp_path_factory.mktemp("damage") / "log", Drive(12.0))
    data, (rows, told) = path.read_bytes(), read(path, request.param)
    assert (told, rows.total() > 500) == (False, True)
    return request.param, data, rows, find_ends(request.param, data), path


def read_changed(written, data):
    kind, *_, path = written
    path.write_bytes(data)
    return read(path, kind)


places = st.floats(0, 1, exclude_max=True)
few = settings(max_examples=30, deadline=None)


@few
@given(share=places)
def test_a_log_cut_anywhere_is_read_as_far_as_it_goes(written, share):
    _, data, rows, ends, _ = written
    cut = ends[0] + int(share * (len(data) - ends[0]))
    found, told = read_changed(written, data[:cut])
    assert not found - rows
    assert told == (cut not in ends)
    assert found.total() >= rows.total() * sum(end <= cut for end in ends) / len(ends) - 80  # formats are first


@few
@given(share=places, bit=st.integers(0, 7))
def test_a_flipped_bit_is_told_or_changes_values_alone(written, share, bit):
    _, data, rows, ends, _ = written
    at = ends[0] + int(share * (len(data) - ends[0]))
    found, told = read_changed(written, data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :])
    assert told or found.total() == rows.total()  # no checksum covers values


@few
@given(share=places, size=st.integers(1, 300), seed=st.integers(0, 99))
def test_garbage_costs_what_lies_beside_it(written, share, size, seed):
    _, data, rows, ends, _ = written
    at = ends[len(ends) // 3] + int(share * (len(data) - ends[len(ends) // 3]))  # formats cost all their messages
    found, told = read_changed(written, data[:at] + np.random.default_rng(seed).bytes(size) + data[at:])
    assert told
    assert (rows - found).total() <= 4
    assert (found - rows).total() <= 1


def test_a_message_that_is_swept_away_with_its_neighbours_costs_them_alone(written):
    _, data, rows, ends, _ = written
    for start, end in list(pairwise(ends))[len(ends) // 2 :: 400]:
        found, told = read_changed(written, data[: start + 2] + bytes(end - start) + data[end + 2 :])
        assert told
        assert (rows - found).total() <= 4
