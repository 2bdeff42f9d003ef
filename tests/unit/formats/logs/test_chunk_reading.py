"""Which chunks are read together, and what of them: compared with the same looked up message by message."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tcpipe.formats.logs.chunk_reading import (
    GROUP_BYTES,
    ChunkedPart,
    group_chunks,
    plan_chunk_spans,
    sort_by_place,
)
from tcpipe.formats.logs.log_part import DamageError

LEAST_BYTES = 4


@st.composite
def made_chunks(draw):
    """Chunks of random bytes, with the (offset, channel) of messages that fill them."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    chunks = []
    for _ in range(draw(st.integers(1, 5))):
        lengths = rng.integers(LEAST_BYTES, draw(st.sampled_from((8, 20_000))), draw(st.integers(0, 30)))
        offsets = np.cumsum(lengths) - lengths
        channels = rng.choice(4, len(lengths), p=draw(st.sampled_from(([0.9, 0.05, 0.05, 0], [0.1, 0.1, 0.4, 0.4]))))
        chunks.append((rng.bytes(int(lengths.sum())), offsets, channels))
    return chunks


def planned(chunks):
    number = np.repeat(np.arange(len(chunks)), [len(offsets) for _, offsets, _ in chunks])
    offsets, channels = (np.concatenate([of[kind] for of in chunks]).astype(np.int64) for kind in (1, 2))
    order = np.random.default_rng(0).permutation(len(number))
    sizes = np.array([len(data) for data, _, _ in chunks], np.int64)
    stamps = 1000 * number + offsets
    return sizes, *sort_by_place(
        number[order], channels[order], offsets[order], stamps[order], sizes, least_bytes=LEAST_BYTES
    )


class HeldChunks:
    """A file of chunks that are called by their numbers, of which one is broken."""

    read_excerpt, _copy = ChunkedPart.read_excerpt, ChunkedPart._copy

    def __init__(self, chunks, broken=None):
        self.chunks, self.broken, self.damage = chunks, broken, []

    def load(self, number):
        if number == self.broken:
            raise DamageError("broken")
        return memoryview(self.chunks[number][0])

    def find_plain_data(self, _number):
        return None

    def note_lost(self, number, _error):
        self.damage.append(number)


@given(made_chunks())
def test_an_excerpt_holds_the_bytes_of_every_wanted_message_and_of_no_other(chunks):
    wanted = [1, 2]
    sizes, entries, sound = planned(chunks)
    assert sound.all()
    expected = [
        (number, int(channel), data[start:end])
        for number, (data, offsets, channels) in enumerate(chunks)
        for channel, start, end in zip(channels, offsets, [*offsets[1:], len(data)], strict=False)
        if channel in wanted
    ]
    found, followed = [], []
    for span in plan_chunk_spans(entries, sizes, sound, wanted):
        followed += span.chunks
        assert span.compact or len(span.chunks) == 1
        got = HeldChunks(chunks).read_excerpt(span, span.entries, range(len(chunks)))
        of = got.entries
        lengths = of.end - of.offset
        for chunk, channel, at, length in zip(of.chunk, of.channel, got.offset, lengths, strict=True):
            found.append((int(chunk), int(channel), bytes(got.data[at : at + length])))
        assert (of.log_time_ns == 1000 * of.chunk + of.offset).all()
    assert followed == list(range(len(chunks)))
    assert found == expected


@given(made_chunks(), st.integers(0, 4))
def test_a_chunk_that_is_lost_costs_no_other(chunks, broken):
    sizes, entries, sound = planned(chunks)
    for span in plan_chunk_spans(entries, sizes, sound, [1, 2]):
        file = HeldChunks(chunks, broken)
        got = file.read_excerpt(span, span.entries, range(len(chunks)))
        assert file.damage == [number for number in span.chunks if number == broken]
        assert broken not in got.entries.chunk
        assert len(got.offset) == len(got.entries.chunk) == (span.entries.chunk != broken).sum()


@pytest.mark.parametrize(
    ("offsets", "why"),
    [([0, 8, 100], "outside"), ([-1, 8, 20], "before"), ([0, 8, 8], "twice"), ([0, 8, 97], "no room")],
)
def test_an_index_that_cannot_be_is_not_sound(offsets, why):
    number = np.array([0, 0, 0, 1])
    place = np.array([*offsets, 5])
    entries, sound = sort_by_place(
        number, np.zeros(4, np.int64), place, place, np.array([100, 100]), least_bytes=LEAST_BYTES
    )
    assert sound.tolist() == [False, True], why
    assert entries.chunk.tolist() == [1]


def test_an_unsound_chunk_is_read_alone():
    number, place = np.array([0, 2]), np.array([10, 10])
    sizes = np.full(3, 1000)
    entries, _ = sort_by_place(number, np.array([7, 7]), place, place, sizes, least_bytes=LEAST_BYTES)
    (before, alone, after) = plan_chunk_spans(entries, sizes, np.array([True, False, True]), [8])
    assert [span.chunks for span in (before, alone, after)] == [range(1), range(1, 2), range(2, 3)]
    assert alone.entries is None
    assert len(before.entries.chunk) == len(after.entries.chunk) == 0


@given(st.lists(st.integers(0, 2 * GROUP_BYTES), max_size=20))
def test_groups_follow_one_another_and_are_bounded(sizes):
    found = list(group_chunks(sizes))
    assert [number for group in found for number in group] == list(range(len(sizes)))
    assert all(sum(sizes[number] for number in group[:-1]) < GROUP_BYTES for group in found)
