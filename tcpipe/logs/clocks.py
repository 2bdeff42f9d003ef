"""Clocks: which stamp of a message is used, where the clock steps, and the order of measurement.

Every message has a log time (when the recorder received it); most have a header stamp (when it was measured). The
header's rules where it is set and follows the log time, within 10 s, up to a constant offset; otherwise log time; topic
by topic. A *lasting* step (> 0.5 s) of header minus log time opens a new clock epoch, common to all topics. Lasting
means 10 s, or to the log's end: delays, bursts and single wrong stamps are no steps. So does a host's clock that is set
back: log times and headers pass a time twice, which is left out.

A simulation runs slower than the wall clock, or faster, and may pause; ROS publishes its time on /clock, and stamps of
before September 2001 are no wall clock's. Where most topics count such a time, and it runs forward, it rules, and no
epoch is opened: topics without a usable header get the simulation's time by their log time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import AnyArray, Ints, Mask, accumulate
from tcpipe.tables.facts import ClockStep
from tcpipe.tables.findings import Findings, Subject, make_finding, read_threshold

SECOND_NS = 1_000_000_000
FOLLOWS_NS = 10 * SECOND_NS
"""A header stamp within this of the log time, up to a constant offset, follows it."""
STEP_NS = SECOND_NS // 2
"""A lasting change of header minus log time larger than this is a step of a clock."""
LATE_NS = SECOND_NS
"""A message stamped this much before another that came earlier cannot be sorted in: it is dropped."""
APART_NS = SECOND_NS
"""Offsets closer than this are delays; topics further apart run on different clocks."""

_LASTING_NS = 10 * SECOND_NS
_MAX_OTHER_LEVEL_FRACTION = 0.2
"""Largest share of the messages of 10 s before or after a step that may be at the other level, since they are late."""
_TOGETHER_NS = 5 * SECOND_NS
_BIN_NS = SECOND_NS // 20
_FEWEST = 3
RECIPE = "recipe"
"""The reason of a choice that the recipe made."""
_MOST_UNSET = 0.5
_MOST_STRAY = 0.01
_MOST_REPEATED = 0.2
_NEIGHBOURS = 11
SIMULATED_NS = 10**18
"""Times before this (September 2001) are not the wall clock's: simulated time begins near 0."""
CLOCK = "rosgraph_msgs/msg/Clock"
"""The type of the topic that publishes simulated time."""

_FEWEST_IN_BIN = 4
_FEWEST_REGULAR = 2
_ABOUT_TWICE = 0.5
_MOST_BINS = 2_000_000  # of half a second: eleven days
_MOSTLY = 0.5
_MAX_BACKWARD_FRACTION = 0.01
"""Largest share of headers of a simulation that may be more than 1 s before an earlier one."""
LOG_CLOCK = Subject("log", "clock")


@dataclass(frozen=True, slots=True)
class TopicTimes:
    """A topic's times in log-time order: log time and header stamp [ns], shape (N,), the header's 0 where unset.

    ``content``, columns of shape (N,), distinguishes duplicates from repeated stamps; ``prefer`` and ``offset_ns`` are
    the recipe's.
    """

    log_time_ns: Ints
    header_ns: Ints | None
    content: Sequence[AnyArray]
    prefer: Literal["auto", "header", "log"] = "auto"
    offset_ns: int = 0


@dataclass(frozen=True, slots=True)
class TopicTimeline:
    """A topic's rows in the order they were measured.

    ``row`` points into the topic's rows; (``epoch``, ``stamp_ns``) increases strictly. ``why`` is a reason in kebab
    case. ``offset_s`` is the median of header minus log time (None without headers), ``moved_s`` what was added to
    bring the topic to the clock of the others, by epoch.
    """

    row: Ints
    stamp_ns: Ints
    clock_epoch: NDArray[np.int16]
    source: Literal["header", "log"]
    why: str
    offset_s: float | None
    dropped: dict[str, int] = field(default_factory=dict)
    notes: dict[str, int] = field(default_factory=dict)
    moved_s: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class SimulatedClock:
    """Log times and simulation times of messages [ns], shape (N,), both rising, and the topics with simulation time."""

    log_time_ns: Ints
    clock_ns: Ints
    topics: frozenset[str]

    def at(self, log_time_ns: Ints) -> Ints:
        """Return the simulation's time [ns] at each log time; outside its range at the rate of the wall clock."""
        log, clock = self.log_time_ns, self.clock_ns
        found = clock[0] + np.rint(np.interp(log_time_ns - log[0], log - log[0], clock - clock[0])).astype(np.int64)
        outside = np.minimum(log_time_ns - log[0], 0) + np.maximum(log_time_ns - log[-1], 0)
        return np.asarray(found + outside)

    @property
    def rate(self) -> float:
        """Seconds of the simulation in a second of the log."""
        return float(self.clock_ns[-1] - self.clock_ns[0]) / float(self.log_time_ns[-1] - self.log_time_ns[0])

    def find_simulated_time(self) -> Findings:
        """Return the finding that durations are those of the simulation; none if the log's own clock is, too."""
        least = read_threshold("simulated-time", "min_rate_difference_fraction")
        if abs(self.rate - 1.0) < least and self.log_time_ns[0] < SIMULATED_NS:
            return ()
        names = {"topics": ", ".join(sorted(self.topics))}
        return (make_finding("simulated-time", LOG_CLOCK, names=names, rate_fraction=self.rate),)


@dataclass(frozen=True, slots=True)
class AlignedClocks:
    """Timelines of topics, the clock steps that divide them into epochs, and the simulation's clock if it is used."""

    timelines: dict[str, TopicTimeline]
    steps: list[ClockStep]
    simulated: SimulatedClock | None = None


def settle_clocks(topics: Mapping[str, TopicTimes], *, clock_published: bool = False) -> AlignedClocks:
    """Return the timeline of each topic that is used, and the clock steps; ``clock_published``: /clock has messages."""
    stamped = {
        name: (topic.log_time_ns, topic.header_ns)
        for name, topic in topics.items()
        if topic.header_ns is not None and topic.prefer != "log"
    }
    simulated = find_simulated_clock(stamped, published=clock_published)
    if simulated is not None:
        return AlignedClocks(
            {name: _make_simulated_timeline(name, times, simulated) for name, times in topics.items()}, [], simulated
        )
    set_back = _find_times_passed_twice(topics)
    if set_back:
        return _settle_after_setting_back(topics, set_back)
    return _settle_steps(topics, [])


def _find_times_passed_twice(topics: Mapping[str, TopicTimes]) -> list[tuple[int, int, float]]:
    """Return log times [ns] and sizes [s] of backward steps of a host's clock, where most topics double their messages.

    A log is in order of log time: messages from before and after the step are mixed there.
    """
    used = [times for times in topics.values() if len(times.log_time_ns)]
    if not used:
        return []
    zero = min(int(times.log_time_ns[0]) for times in used)
    size = (max(int(times.log_time_ns[-1]) for times in used) - zero) // STEP_NS + 1
    if size > _MOST_BINS:  # log times are no clock's
        return []
    stamps = [_bring_to_log_clock(times) for times in used]
    counts = np.array(
        [np.bincount(((stamp_ns - zero) // STEP_NS).clip(0, size), minlength=size + 1) for stamp_ns in stamps]
    )
    medians = np.array([np.median(count[count > 0]) for count in counts])
    regular = counts[medians >= _FEWEST_IN_BIN] / medians[medians >= _FEWEST_IN_BIN, None]
    if len(regular) < _FEWEST_REGULAR:
        return []
    twice = np.concatenate(
        ([0], (np.mean(np.abs(regular - 2.0) < _ABOUT_TWICE, axis=0) > _MOSTLY).astype(np.int8), [0])
    )
    begins, ends = np.flatnonzero(np.diff(twice) > 0), np.flatnonzero(np.diff(twice) < 0)
    excess_s = accumulate(np.mean(regular - 1.0, axis=0)) * STEP_NS / SECOND_NS
    found = []
    for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
        step_s = float(excess_s[min(end + 1, size)] - excess_s[max(begin - 1, 0)])
        # A driver that catches up sends delayed messages: over a longer time their number is normal.
        around_s = float(excess_s[min(2 * end - begin + 2, size)] - excess_s[max(2 * begin - end - 2, 0)])
        if end - begin > 1 and around_s > _MOSTLY * step_s:
            found.append((zero + (begin - 1) * STEP_NS, zero + (end + 1) * STEP_NS, step_s))
    return found


def _bring_to_log_clock(times: TopicTimes) -> Ints:
    """Return the header stamps less their median distance from the log times [ns]; log times where some are unset."""
    if times.header_ns is None or not _is_set(times).all():
        return times.log_time_ns
    return times.header_ns - int(np.median(times.header_ns - times.log_time_ns))


def _settle_after_setting_back(
    topics: Mapping[str, TopicTimes], spans: Sequence[tuple[int, int, float]]
) -> AlignedClocks:
    """Return timelines after a clock was set back, without messages in ``spans``: their order is unknown."""
    kept = {
        name: np.flatnonzero(~np.any([(a <= topic.log_time_ns) & (topic.log_time_ns < b) for a, b, _ in spans], axis=0))
        for name, topic in topics.items()
    }
    rest = {name: select_times(topic, kept[name]) for name, topic in topics.items()}
    steps = [ClockStep(end_ns, -size_s, ()) for _, end_ns, size_s in spans]
    settled = _settle_steps(rest, steps)
    timelines = {
        name: replace(
            timeline,
            row=kept[name][timeline.row],
            dropped=timeline.dropped | {"clock_set_back": len(topics[name].log_time_ns) - len(kept[name])},
        )
        for name, timeline in settled.timelines.items()
    }
    return replace(settled, timelines=timelines)


def select_times(times: TopicTimes, rows: Ints) -> TopicTimes:
    """Return the times of some rows."""
    header_ns = None if times.header_ns is None else times.header_ns[rows]
    content = tuple(column[rows] for column in times.content)
    return replace(times, log_time_ns=times.log_time_ns[rows], header_ns=header_ns, content=content)


def _settle_steps(topics: Mapping[str, TopicTimes], of_host: Sequence[ClockStep]) -> AlignedClocks:
    """Return each topic's timeline, and the steps of the host's clock and of single clocks."""
    steps_of = {name: _find_steps(times) for name, times in topics.items()}
    reasons = {name: _find_header_problem(times, steps_of[name]) for name, times in topics.items()}
    # An unused header is also not used to judge the clock of the others.
    trusted = {name: steps for name, steps in steps_of.items() if reasons[name] is None}
    steps = _find_common_steps({name: topics[name].log_time_ns for name in topics}, trusted)
    steps += [
        step for step in of_host if all(abs(step.log_time_ns - each.log_time_ns) > _TOGETHER_NS for each in steps)
    ]
    steps.sort(key=lambda step: step.log_time_ns)
    drafts = {
        name: _make_draft(times, reasons[name], _assign_epochs(name, times, steps, trusted.get(name, [])))
        for name, times in topics.items()
    }
    reference = [_find_reference_offset(drafts, epoch) for epoch in range(len(steps) + 1)]
    moves = {name: _find_clock_shifts(topics[name], draft, reference) for name, draft in drafts.items()}
    return AlignedClocks(
        {name: _make_timeline(topics[name], draft, moves[name]) for name, draft in drafts.items()}, steps
    )


def _make_simulated_timeline(name: str, times: TopicTimes, clock: SimulatedClock) -> TopicTimeline:
    """Return the timeline of a topic in a simulation: by its header, or the simulation's time of reception."""
    known, epoch = _is_set(times), np.zeros(len(times.log_time_ns), np.int64)
    median, every = _compute_median_offset(times, known), np.ones(len(epoch), bool)
    if times.prefer == "header" and times.header_ns is not None:
        draft = _Draft("header", RECIPE, times.header_ns, known, epoch, {}, median, 0)
        return _make_timeline(times, draft, [0])
    clock_ns = clock.at(times.log_time_ns)
    why = _find_simulated_problem(name, times, clock)
    if why is None and times.header_ns is not None:
        stamps = np.where(known, times.header_ns, clock_ns)
        draft = _Draft("header", "simulated-time", stamps, every, epoch, {}, median, int(np.count_nonzero(~known)))
        return _make_timeline(times, draft, [0])
    draft = _Draft("log", str(why), clock_ns, every, epoch, {}, median, 0)
    return replace(
        _make_timeline(times, draft, [0]), moved_s=(float(np.median(clock_ns - times.log_time_ns)) / SECOND_NS,)
    )


def _find_simulated_problem(name: str, times: TopicTimes, clock: SimulatedClock) -> str | None:
    """Return the reason why a topic's header is not used in a simulation, or None if it is used."""
    if times.prefer == "log":
        return RECIPE
    if name not in clock.topics:
        return "header-not-simulated"
    return "header-repeats" if _compute_repeated_share(times) > _MOST_REPEATED else None


def _is_set(times: TopicTimes) -> Mask:
    return np.zeros(len(times.log_time_ns), bool) if times.header_ns is None else times.header_ns > 0


def _find_steps(times: TopicTimes) -> list[tuple[int, int]]:
    """Return the lasting steps of header minus log time: (row that begins the new level, step [ns])."""
    rows = np.flatnonzero(_is_set(times))
    if times.header_ns is None or len(rows) < 2 * _FEWEST:
        return []
    log = times.log_time_ns[rows]
    behind = times.header_ns[rows] - log
    # One row per 50 ms of log time, the last: messages that a stalled recorder writes in a burst then count once.
    bins = log // _BIN_NS
    last = np.flatnonzero(np.append(bins[1:] != bins[:-1], True))
    level, at = behind[last], log[last]
    found: list[tuple[int, int]] = []
    begin = 0
    for j in (np.flatnonzero(np.abs(np.diff(level)) > STEP_NS // 2) + 1).tolist():
        if j < begin + _FEWEST or len(level) - j < _FEWEST:
            continue
        start = max(begin, min(int(np.searchsorted(at, at[j] - _LASTING_NS)), j - _FEWEST))
        before, after = level[start:j], level[j : max(int(np.searchsorted(at, at[j] + _LASTING_NS)), j + _FEWEST)]
        low, high = np.median(before), np.median(after)
        step, middle = int(high - low), (low + high) / 2
        # The step must be exactly at the row, and both levels must last; a delay returns to the old level.
        takes_it = abs(int(level[j] - level[j - 1]) - step) < abs(step) // 2
        lasts = all(
            np.mean((side > middle) != (own > middle)) <= _MAX_OTHER_LEVEL_FRACTION
            for side, own in ((before, low), (after, high))
        )
        if (
            abs(step) > STEP_NS
            and takes_it
            and lasts
            and j - start == _find_rise(np.append(before, after), middle, step)
        ):
            between = slice(last[j - 1], last[j] + 1)
            first = int(last[j - 1]) + 1 + int(np.argmax(np.abs(np.diff(behind[between]))))
            found.append((int(rows[first]), step))
            begin = j
    return found


def _find_rise(level: Ints, middle: float, step: int) -> int:
    """Return the first row after a step: with it the fewest rows are at the level of the other side of the step.

    Of equally good rows it is the first of a rise and the last of a fall, since a late message is at a lower level.
    """
    balance = np.cumsum(np.where((level > middle) == (step > 0), -1, 1))
    best = np.flatnonzero(balance == balance.max())
    return 1 + int(best[0] if step > 0 else best[-1])


def _find_common_steps(log_times: Mapping[str, Ints], steps_of: Mapping[str, list[tuple[int, int]]]) -> list[ClockStep]:
    """Return steps common to all topics: those of several topics within 5 s of log time are one."""
    every = sorted((int(log_times[name][row]), name, step) for name, steps in steps_of.items() for row, step in steps)
    groups: list[list[tuple[int, str, int]]] = []
    for item in every:
        if groups and item[0] - groups[-1][0][0] <= _TOGETHER_NS and item[1] not in {name for _, name, _ in groups[-1]}:
            groups[-1].append(item)
        else:
            groups.append([item])
    return [
        ClockStep(
            group[0][0], max((step for _, _, step in group), key=abs) / SECOND_NS, tuple(name for _, name, _ in group)
        )
        for group in groups
    ]


@dataclass(frozen=True, slots=True)
class _Draft:
    """A topic with a chosen source of time, not yet converted to the common clock."""

    source: Literal["header", "log"]
    why: str
    stamp_ns: Ints
    usable: Mask
    clock_epoch: Ints
    offset_ns: dict[int, int]
    median_offset_ns: int | None
    replaced: int


def _make_draft(times: TopicTimes, reason: str | None, epoch: Ints) -> _Draft:
    known = _is_set(times)
    median = _compute_median_offset(times, known)
    usable = np.ones(len(known), bool)
    if reason is not None or times.header_ns is None:
        return _Draft("log", str(reason), times.log_time_ns, usable, epoch, {}, median, 0)
    offset = _compute_offsets(times, known, epoch)
    if times.prefer == "header":
        return _Draft("header", RECIPE, times.header_ns, known, epoch, offset, median, 0)
    expected = _predict_stamps(times, offset, epoch)
    stray = known & (np.abs(times.header_ns - expected) > FOLLOWS_NS)
    replaced = ~known | stray | _find_leaps(times, known & ~stray)
    stamps = np.where(replaced, expected, times.header_ns)
    count = int(np.count_nonzero(replaced))
    return _Draft("header", "header-follows-log-time", stamps, usable, epoch, offset, median, count)


def _predict_stamps(times: TopicTimes, offset_ns: Mapping[int, int], epoch: Ints) -> Ints:
    """Return where the log time and the epoch's offset put each stamp [ns]."""
    return times.log_time_ns + np.array([offset_ns[int(e)] for e in epoch], np.int64)


def _assign_epochs(name: str, times: TopicTimes, steps: Sequence[ClockStep], own: Sequence[tuple[int, int]]) -> Ints:
    """Return each row's epoch: by the step of its own topic, or, without one, by the step's log time."""
    own_rows = {int(times.log_time_ns[row]): row for row, _ in own}
    epoch = np.zeros(len(times.log_time_ns), np.int64)
    for step in steps:
        mine = [row for at, row in own_rows.items() if 0 <= at - step.log_time_ns <= _TOGETHER_NS]
        first = mine[0] if mine and name in step.topics else int(np.searchsorted(times.log_time_ns, step.log_time_ns))
        epoch[first:] += 1
    return epoch


def _compute_median_offset(times: TopicTimes, known: Mask) -> int | None:
    if times.header_ns is None or not known.any():
        return None
    return int(np.median(times.header_ns[known] - times.log_time_ns[known]))


def _compute_offsets(times: TopicTimes, known: Mask, epoch: Ints) -> dict[int, int]:
    """Return the median of header minus log time [ns] by epoch; an epoch without set stamps takes the whole log's."""
    header = times.log_time_ns if times.header_ns is None else times.header_ns
    behind = header - times.log_time_ns
    whole = int(np.median(behind[known]))
    return {
        int(e): int(np.median(behind[known & (epoch == e)])) if np.any(known & (epoch == e)) else whole
        for e in np.unique(epoch)
    }


def _find_header_problem(times: TopicTimes, own_steps: Sequence[tuple[int, int]]) -> str | None:
    """Return the reason why a topic's log time is used, or None if its header is."""
    known = _is_set(times)
    if times.prefer == "log":
        return RECIPE
    if times.header_ns is None or not known.any():
        return "no-header" if times.header_ns is None else "header-unset"
    if times.prefer == "header":
        return None
    if 1 - np.mean(known) > _MOST_UNSET:
        return "header-unset"
    if _compute_stray_share(times, known, own_steps) > _MOST_STRAY:
        return "header-differs-from-log-time"
    return "header-repeats" if _compute_repeated_share(times) > _MOST_REPEATED else None


def _compute_stray_share(times: TopicTimes, known: Mask, own_steps: Sequence[tuple[int, int]]) -> float:
    epoch = np.zeros(len(known), np.int64)
    for row, _ in own_steps:
        epoch[row:] += 1
    header = times.log_time_ns if times.header_ns is None else times.header_ns
    stray = np.abs(header - _predict_stamps(times, _compute_offsets(times, known, epoch), epoch)) > FOLLOWS_NS
    return float(np.mean(known & stray))


def _compute_repeated_share(times: TopicTimes) -> float:
    if times.header_ns is None or len(times.header_ns) < 2 * _FEWEST:
        return 0.0
    is_repeated = np.diff(times.header_ns) == 0
    rows = np.flatnonzero(is_repeated)
    other = [column[rows + 1].astype(float) - column[rows] != 0 for column in times.content]
    is_repeated[rows] = np.any(other, axis=0)
    return float(np.mean(is_repeated))


def _find_leaps(times: TopicTimes, known: Mask) -> Mask:
    """Whether single stamps are more than 1 s after their neighbours: no message is received before its measurement."""
    leaps = np.zeros(len(known), bool)
    rows = np.flatnonzero(known)
    if times.header_ns is None or len(rows) < _NEIGHBOURS:
        return leaps
    behind = times.header_ns[rows] - times.log_time_ns[rows]
    if np.ptp(behind) <= LATE_NS:
        return leaps
    padded = np.pad(behind, _NEIGHBOURS // 2, mode="edge")
    neighbours = np.median(np.lib.stride_tricks.sliding_window_view(padded, _NEIGHBOURS), axis=-1)
    leaps[rows] = behind - neighbours > LATE_NS
    return leaps


def _find_reference_offset(drafts: Mapping[str, _Draft], epoch: int) -> int:
    """Return the offset [ns] that most topics with header time share in an epoch; 0 without one.

    Among equally large groups the one nearest to the log's clock is taken.
    """
    offsets = sorted(draft.offset_ns[epoch] for draft in drafts.values() if epoch in draft.offset_ns)
    if not offsets:
        return 0
    groups = [[other for other in offsets if abs(other - offset) <= APART_NS] for offset in offsets]
    best = min(groups, key=lambda group: (-len(group), abs(group[len(group) // 2])))
    return best[len(best) // 2]


def _find_clock_shifts(times: TopicTimes, draft: _Draft, reference: Sequence[int]) -> list[int]:
    """Return the correction of a topic to the clock of the others [ns], by epoch."""
    shifts_ns = [target - draft.offset_ns.get(epoch, 0) for epoch, target in enumerate(reference)]
    return [move if abs(move) > APART_NS and times.prefer != "header" else 0 for move in shifts_ns]


def _make_timeline(times: TopicTimes, draft: _Draft, moves: Sequence[int]) -> TopicTimeline:
    stamps = draft.stamp_ns + np.array(moves, np.int64)[draft.clock_epoch] + times.offset_ns
    late = _compute_lateness(stamps, draft.clock_epoch, draft.usable)
    keep = draft.usable & (late < LATE_NS)
    rows = np.flatnonzero(keep)
    order = rows[np.lexsort((rows, stamps[rows], draft.clock_epoch[rows]))]
    again, same = np.zeros(len(order), bool), np.zeros(len(order), bool)
    again[1:] = (np.diff(stamps[order]) == 0) & (np.diff(draft.clock_epoch[order]) == 0)
    repeats = np.flatnonzero(again)
    pairs = ((column[order[repeats]], column[order[repeats - 1]]) for column in times.content)
    same[repeats] = np.all([(a == b) | (np.isnan(a) & np.isnan(b)) for a, b in pairs], axis=0)
    dropped = {
        "unset_stamps": int(np.count_nonzero(~draft.usable)),
        "late": int(np.count_nonzero(draft.usable & (late >= LATE_NS))),
        "duplicates": int(np.count_nonzero(same)),
        "repeated_stamps": int(np.count_nonzero(again & ~same)),
    }
    notes = {"sorted": int(np.count_nonzero(keep & (late > 0))), "stamps_replaced": draft.replaced}
    chosen = order[~again]
    return TopicTimeline(
        chosen,
        stamps[chosen],
        draft.clock_epoch[chosen].astype(np.int16),
        draft.source,
        draft.why,
        None if draft.median_offset_ns is None else draft.median_offset_ns / SECOND_NS,
        {name: count for name, count in dropped.items() if count},
        {name: count for name, count in notes.items() if count},
        tuple(move / SECOND_NS for move in moves),
    )


def _compute_lateness(stamp_ns: Ints, epoch: Ints, usable: Mask) -> Ints:
    """Return how far each row is before the latest earlier stamp of its epoch [ns]; 0 if it is not before it."""
    late = np.zeros(len(stamp_ns), np.int64)
    for e in np.unique(epoch):
        rows = np.flatnonzero((epoch == e) & usable)
        if len(rows):
            late[rows] = np.maximum.accumulate(stamp_ns[rows]) - stamp_ns[rows]
    return late


def find_simulated_clock(stamps: Mapping[str, tuple[Ints, Ints]], *, published: bool) -> SimulatedClock | None:
    """Return the clock of the simulation that a log is of, None if it is of none.

    ``stamps`` are by topic log times and header stamps [ns], shape (N,), 0 where unset; without a ``published`` /clock
    they must be no wall clock's.
    """
    used = {name: (log[header > 0], header[header > 0]) for name, (log, header) in stamps.items() if _is_timed(header)}
    counting = [name for name, (_, header) in used.items() if _is_counting_clock(header, published=published)]
    if not counting or 2 * len(counting) <= len(used):
        return None
    log, clock = max((used[name] for name in counting), key=lambda pair: len(pair[0]))
    ahead = np.concatenate(([True], clock[1:] > np.maximum.accumulate(clock)[:-1]))
    log, first = np.unique(log[ahead], return_index=True)
    return SimulatedClock(log, clock[ahead][first], frozenset(counting)) if len(log) > 1 else None


def _is_timed(header_ns: Ints) -> bool:
    known = int(np.count_nonzero(header_ns > 0))
    return known >= _FEWEST and known > _MOST_UNSET * len(header_ns)


def _is_counting_clock(header_ns: Ints, *, published: bool) -> bool:
    """Whether headers count simulated time that runs forward."""
    back = np.maximum.accumulate(header_ns) - header_ns > SECOND_NS
    return bool(np.mean(back) <= _MAX_BACKWARD_FRACTION and (published or np.median(header_ns) < SIMULATED_NS))
