"""Explain contradictions between sensors by changes: steps of fixes or clocks, moved antennas, scales, biases.

A change makes one block of the state uncertain at its first tick and at its last tick. `error_state.smooth_section`
computes the log evidence of such an impulse at every tick, and so finds the ticks. A step of fixes makes the fixes on
both sides uncertain, since it is unknown which side is right. Errors may also be larger than usual in the whole
section. Sets of changes are compared by the likelihood of all measurements less a cost for each kind of change. In this
likelihood, a measurement beyond the gate has the value of the gate.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tcpipe.arrays import Floats, Ints, Mask
from tcpipe.fusion import state
from tcpipe.fusion.filter_kernel import GateVerdict, Tests
from tcpipe.fusion.measurements import DOPPLER, GNSS, IMU, VISUAL, WHEELS
from tcpipe.fusion.parameters import FIX_AXES, Event
from tcpipe.fusion.signals import SPIKE_RATIO, compute_running_median
from tcpipe.fusion.state import Error, Kind
from tcpipe.fusion.ticks import Ticks, compute_process_noise
from tcpipe.tables.findings import read_threshold

ROLES: Mapping[int, str] = {
    Kind.WHEELS: WHEELS,
    Kind.VISUAL: VISUAL,
    Kind.STATIONARY_RATE: IMU,
    Kind.DOPPLER: DOPPLER,
    Kind.FIX: GNSS,
    Kind.ATTITUDE: GNSS,
}
"""Sensors by the kind of their measurements."""
POSSIBLE = (
    *range(Error.ARM, Error.FIX_OFFSET + 3),
    Error.WHEEL_SCALE,
    Error.VISUAL_SCALE,
    Error.WHEEL_LAG,
    Error.VISUAL_LAG,
)
"""Errors that only changes affect; other errors always vary."""


@dataclass(frozen=True, slots=True)
class EventKind:
    """Errors that an event changes, each with the standard deviation of the change, in its unit.

    ``cost``: negative log of the prior probability [nat]. ``least``: smallest norm of the change of its first three
    errors; smaller changes are noise.
    """

    block: tuple[tuple[int, float], ...]
    cost: float
    least: float


def _make_kind(place: int, count: int, std: float, cost: float, least: float) -> EventKind:
    return EventKind(tuple((place + i, std) for i in range(count)), cost, least)


EVENTS: Mapping[tuple[str, int], EventKind] = {
    ("offset", Kind.FIX): _make_kind(Error.FIX_OFFSET, 3, 1.0, 12.0, 0.05),
    ("antenna", Kind.FIX): _make_kind(Error.ARM, 3, 0.3, 40.0, 0.05),
    ("clock", Kind.FIX): _make_kind(Error.FIX_LAG, 1, 0.3, 14.0, 0.05),
    ("clock", Kind.WHEELS): _make_kind(Error.WHEEL_LAG, 1, 0.3, 14.0, 0.05),
    ("clock", Kind.VISUAL): _make_kind(Error.VISUAL_LAG, 1, 0.3, 14.0, 0.05),
    ("gyroscope", Kind.STATIONARY_RATE): _make_kind(Error.GYRO_BIAS, 3, 0.03, 16.0, 0.003),
    ("scale", Kind.WHEELS): _make_kind(Error.WHEEL_SCALE, 1, 0.3, 10.0, 0.15),
    ("scale", Kind.VISUAL): _make_kind(Error.VISUAL_SCALE, 1, 0.3, 10.0, 0.15),
    ("frame", Kind.ATTITUDE): _make_kind(Error.POSE_FRAME, 3, 0.3, 14.0, 0.05),
    ("pose", Kind.FIX): EventKind(
        tuple(
            (place + i, std) for place, std in ((Error.RHO, 2.0), (Error.THETA, 0.1), (Error.U, 0.5)) for i in range(3)
        ),
        20.0,
        1.0,
    ),
}
"""Events by name and kind of measurement of their sensor."""
LARGER_ERRORS: Mapping[tuple[str, int], tuple[float, ...]] = {
    ("noise", Kind.FIX): (0.03, 0.06, 0.12, 0.24),  # m, from RTK's usual error to a wrong ambiguity
    ("slow", Kind.FIX): (0.03, 0.06, 0.12, 0.24),
    ("varies", Kind.WHEELS): (0.05, 0.1, 0.2),  # of the scale, with slope, ground or load
    ("varies", Kind.VISUAL): (0.05, 0.1, 0.2),
    ("accelerometer", Kind.STATIONARY_RATE): (0.1, 0.3, 1.0),  # m/s²: its bias follows speed or temperature
}
"""Errors that may be larger than usual in a section, by name and sensor; tested sizes [unit of the error], 1σ."""
_VARIES_S = 5.0  # correlation time of a scale or a bias that varies [s]
_REJECTED_S: Mapping[int, float] = {Kind.FIX: 1.0, Kind.WHEELS: 4.0, Kind.VISUAL: 4.0, Kind.ATTITUDE: 4.0}
"""Longest time for which a correct sensor may be rejected without a break [s]: wheels slip for seconds."""


@dataclass(frozen=True, slots=True)
class Change:
    """One change: its kind, its sensor, and its first and last tick (None: the end of the section).

    ``size``: magnitude, in the unit of the changed error. ``impulse``: change of the errors of its block;
    ``impulse_std``: its standard deviation.
    """

    kind: str
    role: int
    first: int
    last: int | None = None
    size: float = 0.0
    impulse: tuple[float, ...] = ()
    impulse_std: tuple[float, ...] = ()

    @property
    def cost(self) -> float:
        """Negative log of the prior probability [nat]."""
        if (self.kind, self.role) in EVENTS:
            return EVENTS[self.kind, self.role].cost + (0.0 if self.last is None else 2.0)
        return EVENTS["offset", Kind.FIX].cost if self.kind == "step" else 0.0

    def list_events(self) -> Iterator[Event]:
        """Yield the events by which this change acts on the state."""
        if self.kind == "step":  # its prior: see `Hypothesis.alter_priors`
            yield from (Event(self.first, Error.FIX_OFFSET + axis, is_new=True) for axis in range(3))
        elif (self.kind, self.role) in EVENTS:
            block = EVENTS[self.kind, self.role].block
            for (place, prior_std), found, found_std in zip(block, self.impulse, self.impulse_std, strict=True):
                is_pose = place < Error.GYRO_BIAS  # the change rotates the axes of its errors: no mean
                # The filter estimates the other errors again from the same measurements: use 3σ.
                std, mean = (prior_std, 0.0) if is_pose else (min(prior_std, 3.0 * found_std), found)
                yield Event(self.first, place, std, mean)
                if self.last is not None:
                    yield (
                        Event(self.last, place, is_new=True)
                        if self.kind == "offset"
                        else Event(self.last, place, std, -mean)
                    )


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Set of changes with its score [nat]."""

    changes: tuple[Change, ...]
    score: float = 0.0

    @property
    def events(self) -> tuple[Event, ...]:
        """All events of the changes, in order of time."""
        return tuple(sorted((e for c in self.changes for e in c.list_events()), key=lambda event: event.tick))

    def alter_ticks(self, ticks: Ticks) -> Ticks:
        """Return the ticks, altered by all changes."""
        for change in (each for each in self.changes if each.kind == "noise"):
            # Multipath errors change when the antenna moves by a metre.
            kept = np.full_like(ticks.inputs.fix_kept, np.exp(-ticks.inputs.period_s / 1.5))
            variance = np.maximum(ticks.fix_variance_m2, np.square(change.size * FIX_AXES))
            inputs = ticks.inputs._replace(fix_kept=kept, fix_noise=compute_process_noise(kept, variance))
            ticks = replace(ticks, inputs=inputs, fix_variance_m2=variance)
        return ticks

    def alter_priors(self, std: Floats, walk: Floats, time_s: Floats) -> None:
        """Change the standard deviation, walk and correlation time of all errors, (45,), in place for all changes."""
        offset = slice(Error.FIX_OFFSET, Error.FIX_OFFSET + 3)
        for change in self.changes:
            if change.kind in {"step", "slow"}:  # either side may be right: each errs by half of the step, 1σ
                share = 0.5 if change.kind == "step" else 1.0
                std[offset] = np.maximum(std[offset], share * change.size * FIX_AXES)
                time_s[offset] = 60.0  # s; multipath changes with the satellites
            elif change.kind == "varies":
                slip = Error.WHEEL_SLIP if change.role == Kind.WHEELS else Error.VISUAL_SLIP
                std[slip], time_s[slip] = change.size, _VARIES_S
            elif change.kind == "accelerometer":
                bias = slice(Error.ACCELEROMETER_BIAS, Error.ACCELEROMETER_BIAS + 3)
                std[bias], walk[bias], time_s[bias] = change.size, 0.0, _VARIES_S


def is_contradicted(tests: Tests, period_s: float) -> bool:
    """Return whether a sensor is rejected more often, or longer without a break, than a correct sensor."""
    most = read_threshold("measurements-rejected", "max_rejected_fraction")
    for kind in _REJECTED_S:
        rows = np.flatnonzero(tests.verdict[:, kind] != GateVerdict.NONE)
        rejected = tests.verdict[rows, kind] != GateVerdict.ACCEPTED
        if rejected.sum() > most * rows.size or _find_long_runs(rows, rejected, period_s, kind):
            return True
    return False


def drop_outliers(ticks: Ticks, tests: Tests) -> Floats:
    """Return the measurements of ticks without outliers, shape (K, 9, 3).

    An outlier is a spike among its neighbours, or a rejected measurement outside long runs of rejections; a change may
    explain such a run.
    """
    value = ticks.inputs.value.copy()
    for kind in (Kind.WHEELS, Kind.VISUAL, Kind.FIX):
        rows, axes = np.flatnonzero(np.isfinite(value[:, kind, 0])), slice(state.SIZES[kind])
        if rows.size:
            series = tests.fix_innovation[rows] if kind == Kind.FIX else value[rows, kind, axes]
            deviation, least = (
                np.abs(series - compute_running_median(series, 7)),
                np.sqrt(ticks.inputs.variance[rows, kind, axes]),
            )
            is_spike = (deviation > SPIKE_RATIO * np.maximum(np.median(deviation, axis=0), least)).any(axis=1)
            rejected = tests.verdict[rows, kind] != GateVerdict.ACCEPTED
            for first, last in _find_long_runs(rows, rejected, ticks.inputs.period_s, kind):
                rejected[first:last] = False
            value[rows[is_spike | rejected], kind] = np.nan
    return value


def _find_long_runs(rows: Ints, mask: Mask, period_s: float, kind: int) -> list[tuple[int, int]]:
    """Return first and last row of each run of true values that lasts longer than a correct sensor is rejected."""
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    lasts_s = (rows[edges[:, 1] - 1] - rows[edges[:, 0]] + 1) * period_s
    long = (np.diff(edges, axis=1)[:, 0] >= 5) & (lasts_s >= _REJECTED_S[kind])
    return [(first, last) for first, last in edges[long].tolist()]


def join_events(events: Sequence[Change]) -> tuple[Change, ...]:
    """Return the changes that events make up, in the order found.

    An event that reverses an earlier one ends that change. A permanent offset is a step.
    """
    single: list[Change] = []
    for event in sorted(events, key=lambda each: (each.kind, each.role, each.first)):
        before = single[-1] if single and (single[-1].kind, single[-1].role) == (event.kind, event.role) else None
        if before is not None and event.first - before.first < 20:  # ticks
            single[-1] = replace(before, impulse=tuple(np.add(before.impulse, event.impulse).tolist()))
        else:
            single.append(event)
    joined: list[Change] = []
    for event in single:
        before = joined[-1] if joined and (joined[-1].kind, joined[-1].role) == (event.kind, event.role) else None
        if before is not None and before.last is None:
            rest = np.linalg.norm(np.add(before.impulse, event.impulse))
            if rest < 0.4 * np.linalg.norm(before.impulse):  # largest remainder after the end of a change [1]
                joined[-1] = replace(before, last=event.first)
                continue
        joined.append(event)
    joined.sort(key=lambda each: each.first)
    return tuple(replace(each, kind="step") if (each.kind, each.last) == ("offset", None) else each for each in joined)


def compute_evidence(tests: Tests, gates: Floats) -> float:
    """Return the log likelihood of all measurements; a measurement beyond the gate has the value of the gate."""
    kinds = [Kind.WHEELS, Kind.VISUAL, Kind.DOPPLER, Kind.FIX, Kind.ATTITUDE]
    return float(-0.5 * np.nansum(np.minimum(tests.nis[:, kinds], gates[kinds]) + tests.log_det[:, kinds]))
