"""With any stamps: rows are ordered, distinct, and accounted for."""

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tcpipe.logs.clocks import TopicTimes, settle_clocks

S = 1_000_000_000
BASE = 1_600_000_000 * S


@st.composite
def topic_times(draw) -> TopicTimes:
    rows = draw(st.integers(1, 60))
    gaps = draw(hnp.arrays(np.int64, rows, elements=st.integers(0, 3 * S)))
    log = BASE + np.cumsum(gaps)
    errors = draw(
        hnp.arrays(
            np.int64,
            rows,
            elements=st.one_of(st.integers(-2 * S, 2 * S), st.sampled_from([0, 0, 0, -BASE, 3600 * S, 10**17])),
        )
    )
    header = np.maximum(log + errors, 0) if draw(st.booleans()) else None
    content = draw(hnp.arrays(np.float64, rows, elements=st.sampled_from([0.0, 1.0, np.nan])))
    prefer = draw(st.sampled_from(["auto", "header", "log"]))
    return TopicTimes(log, header, (content,), prefer, draw(st.integers(-S, S)))


@settings(max_examples=200, deadline=None)
@given(topics=st.dictionaries(st.sampled_from("abc"), topic_times(), min_size=1), published=st.booleans())
def test_rows_are_ordered_unique_and_accounted_for(*, topics: dict[str, TopicTimes], published: bool) -> None:
    settled = settle_clocks(topics, clock_published=published)
    found, steps = settled.timelines, settled.steps
    assert set(found) == set(topics)
    assert all(later.log_time_ns >= step.log_time_ns for step, later in itertools.pairwise(steps))
    for name, timeline in found.items():
        rows = len(topics[name].log_time_ns)
        assert len(np.unique(timeline.row)) == len(timeline.row)
        assert len(timeline.row) + sum(timeline.dropped.values()) == rows
        assert len(timeline.stamp_ns) == len(timeline.clock_epoch) == len(timeline.row)
        assert np.all(np.diff(timeline.clock_epoch) >= 0)
        same_epoch = np.diff(timeline.clock_epoch) == 0
        assert np.all(np.diff(timeline.stamp_ns)[same_epoch] > 0)
        assert np.all((timeline.clock_epoch >= 0) & (timeline.clock_epoch <= len(steps)))


@settings(max_examples=60, deadline=None)
@given(
    st.permutations(range(40)).map(np.array),
    st.integers(1, 20),
)
def test_stamps_shuffled_within_a_second_come_back_in_order(order: np.ndarray, step_ms: int) -> None:
    stamps = BASE + np.arange(40) * step_ms * 1_000_000  # less than a second in all
    arrived = stamps[order]
    log = BASE + S + np.arange(40) * 1_000_000
    found = settle_clocks({"t": TopicTimes(log, arrived, (np.arange(40.0),))}).timelines
    np.testing.assert_array_equal(found["t"].stamp_ns, stamps)
    np.testing.assert_array_equal(order[found["t"].row], np.arange(40))


@settings(max_examples=60, deadline=None)
@given(
    st.integers(-10_000, 10_000).filter(lambda ms: abs(ms) > 600),
    st.integers(8, 52),
    st.sampled_from([1.0, 5.0, 50.0]),
    st.integers(0, 100),
)
def test_a_step_is_found_where_it_is_whatever_the_jitter(step_ms: int, at_s: int, rate_hz: float, seed: int) -> None:
    log = BASE + np.round(np.arange(0, 60, 1 / rate_hz) * S).astype(np.int64)
    jitter = np.random.default_rng(seed).integers(-40_000_000, 0, len(log))
    after = log >= BASE + at_s * S
    header = log + jitter + np.where(after, step_ms * 1_000_000, 0)
    settled = settle_clocks({"t": TopicTimes(log, header, (np.arange(len(log), dtype=float),))})
    found, steps = settled.timelines, settled.steps
    assert len(steps) == 1
    assert abs(steps[0].step_s - step_ms / 1000) < 0.1
    np.testing.assert_array_equal(found["t"].clock_epoch, after.astype(int))
