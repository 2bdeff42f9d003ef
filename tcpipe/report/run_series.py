"""What a run's page holds over time: the track and what sensors told, on one axis of seconds; long records keep every bin's extremes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.formats.json_files import Json
from tcpipe.geometry.datum import enu_from_geodetic
from tcpipe.report.column_packing import Column, make_shown_column, pack_columns
from tcpipe.tables.arrays import to_texts
from tcpipe.tables.columns import to_floats, to_integers

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_VALUES = 80_000
"""Of a series; longer ones are thinned."""

_GAP_PERIODS = 10
"""A line is not drawn over so many periods without a value."""

_BETWEEN_EPOCHS_S = 1.0

TRACK_DIGITS = {
    "power": 1, "speed": 3, "wheels": 3, "commanded": 3, "height": 3, "position_std": 3, "height_std": 3, "chord_std": 4,
}  # fmt: skip
"""Decimals that the page shows of a track's columns."""


@dataclass(frozen=True, slots=True)
class Epoch:
    """A clock epoch of the track: its stamps, and where it begins on the page's axis."""

    number: int
    first_ns: int
    last_ns: int
    start_s: float


@dataclass(frozen=True, slots=True)
class Timeline:
    """The page's axis: seconds since the track began; after a step of the clock the next epoch follows a second later."""

    epochs: tuple[Epoch, ...]

    @property
    def end_s(self) -> float:
        """Where the track ends."""
        last = self.epochs[-1]
        return last.start_s + (last.last_ns - last.first_ns) * 1e-9

    def seconds(self, stamp_ns: Ints, epoch: Ints | None = None) -> Floats:
        """Return where stamps lie [s], shape (N,), NaN of an epoch that the track lacks; without epochs the first that holds a stamp."""
        found = np.full(len(stamp_ns), np.nan)
        for each in self.epochs:
            within = np.isnan(found) & (stamp_ns >= each.first_ns) & (stamp_ns <= each.last_ns)
            mine = within if epoch is None else epoch == each.number
            found[mine] = each.start_s + (stamp_ns[mine] - each.first_ns) * 1e-9
        return found


def make_timeline(track: pa.Table) -> Timeline:
    """Return the axis of a track that has rows."""
    stamps, epochs = to_integers(track, "stamp_ns"), to_integers(track, "clock_epoch")
    found: list[Epoch] = []
    start_s = 0.0
    for number in dict.fromkeys(epochs.tolist()):
        mine = stamps[epochs == number]
        found.append(Epoch(number, int(mine.min()), int(mine.max()), start_s))
        start_s += (found[-1].last_ns - found[-1].first_ns) * 1e-9 + _BETWEEN_EPOCHS_S
    return Timeline(tuple(found))


@dataclass(frozen=True, slots=True)
class Series:
    """Columns that share their times, and how many values stand for how many."""

    name: str
    t_s: Floats
    columns: Mapping[str, Column]
    gap_s: float
    of: int
    """Values before they were thinned."""

    @property
    def json(self) -> Json:
        """The series as the page's script reads it."""
        times: dict[str, Column] = {"t": ("f32", self.t_s)}
        return {"packed": pack_columns(times | dict(self.columns)), "gap_s": self.gap_s}


def downsample_columns(
    name: str,
    t_s: Floats,
    values: Mapping[str, tuple[int, Floats]],
    *,
    sampled: Mapping[str, Column] | None = None,
    most: int = MOST_VALUES,
) -> Series:
    """Return columns with their decimals by name; of more than ``most`` values the lowest and highest of every bin stay.

    The two keep their order; their times are the bin's beginning and middle. Columns that are ``sampled`` keep the values there.
    """
    count = len(t_s)
    per_bin = -(-2 * count // most) if count > most else 1
    rows = np.arange(count)
    if per_bin > 1:
        begin = np.arange(0, count, per_bin)
        rows = np.stack([begin, np.minimum(begin + per_bin // 2, count - 1)], axis=1).ravel()
    kept = {key: make_shown_column(digits, _find_extremes(part, per_bin)) for key, (digits, part) in values.items()}
    kept |= {key: (kind, part[rows]) for key, (kind, part) in (sampled or {}).items()}
    period_s = float(np.median(np.diff(t_s))) if count > 1 else 1.0
    return Series(name, t_s[rows], kept, max(_GAP_PERIODS * period_s, per_bin * period_s * 2.0, 0.3), count)


def _find_extremes(values: Floats, per_bin: int) -> Floats:
    """Return the lowest and the highest of every bin in the order they occur; NaN where it holds none."""
    if per_bin == 1:
        return values
    bins = np.append(values, np.full(-len(values) % per_bin, np.nan)).reshape(-1, per_bin)
    known = np.isfinite(bins)
    ends = np.stack(
        [np.where(known, bins, np.inf).argmin(axis=1), np.where(known, bins, -np.inf).argmax(axis=1)], axis=1
    )
    return np.take_along_axis(bins, np.sort(ends, axis=1), axis=1).ravel()


def track_series(track: pa.Table, timeline: Timeline, xy_m: Floats) -> Series:
    """Return the fused track with its places in the plane of the map (N, 2); columns that hold nothing are left out."""
    values = {
        "power": to_floats(track, "power_watt"),
        "speed": to_floats(track, "forward_velocity_mps"),
        "wheels": to_floats(track, "wheel_velocity_mps"),
        "commanded": to_floats(track, "commanded_velocity_mps"),
        "height": to_floats(track, "z_m"),
        "position_std": np.hypot(to_floats(track, "x_std_m"), to_floats(track, "y_std_m")),
        "height_std": to_floats(track, "z_std_m"),
        "chord_std": to_floats(track, "displacement_std_1s_m"),
    }
    told = {name: (TRACK_DIGITS[name], part) for name, part in values.items() if np.isfinite(part).any()}
    return downsample_columns(
        "track",
        _compute_seconds(track, timeline),
        told,
        sampled={"x": ("steps", xy_m[:, 0]), "y": ("steps", xy_m[:, 1])},
    )


def make_rail_series(power: pa.Table, timeline: Timeline) -> Iterator[Series]:
    """Yield voltage and current of each rail as they were told."""
    rails = to_texts(power.column("rail"))
    for rail in dict.fromkeys(rails.tolist()):
        mine = power.filter(pa.array(rails == rail))
        for name, column, digits in (("voltage", "voltage_volt", 2), ("current", "current_amp", 3)):
            values, t_s = to_floats(mine, column), _compute_seconds(mine, timeline)
            known = np.isfinite(values) & np.isfinite(t_s)
            if known.any():
                yield downsample_columns(
                    f"{name} {rail}", t_s[known], {name: (digits, values[known])}, most=MOST_VALUES // 2
                )


def _compute_seconds(table: pa.Table, timeline: Timeline) -> Floats:
    return timeline.seconds(to_integers(table, "stamp_ns"), to_integers(table, "clock_epoch"))


def make_speed_series(role: str, table: pa.Table, timeline: Timeline) -> Series | None:
    """Return what a sensor says of the speed [m/s]: its own, else chords over a second of its places; None without either."""
    t_s = _compute_seconds(table, timeline)
    table, t_s = table.filter(pa.array(np.isfinite(t_s))), t_s[np.isfinite(t_s)]
    speed = _read_speed(table)
    if not np.isfinite(speed).any():
        t_s, speed = _compute_chord_speed(table, t_s)
    known = np.isfinite(speed)
    return (
        downsample_columns(role, t_s[known], {"speed": (3, speed[known])}, most=MOST_VALUES // 2)
        if known.any()
        else None
    )


def _read_speed(table: pa.Table) -> Floats:
    if "east_velocity_mps" in table.column_names:
        return np.hypot(to_floats(table, "east_velocity_mps"), to_floats(table, "north_velocity_mps"))
    if "velocity_x_mps" in table.column_names:
        return to_floats(table, "velocity_x_mps")
    return np.full(table.num_rows, np.nan)


def _compute_chord_speed(table: pa.Table, t_s: Floats) -> tuple[Floats, Floats]:
    """Return times in the middle of a second, and how fast the place moved over it [m/s]."""
    if "x_m" in table.column_names:
        xy_m = np.column_stack([to_floats(table, "x_m"), to_floats(table, "y_m")])
    else:
        lon, lat, alt = (to_floats(table, name) for name in ("lon_deg", "lat_deg", "alt_m"))
        first = (float(lon[0]), float(lat[0]), float(alt[0])) if len(lon) else (0.0, 0.0, 0.0)
        xy_m = enu_from_geodetic(lon, lat, alt, datum_deg_m=first)[:, :2]
    known = np.isfinite(xy_m).all(axis=1)
    xy_m, t_s = xy_m[known], t_s[known]
    rows = np.unique(np.searchsorted(t_s, np.arange(t_s[0], t_s[-1], 1.0))) if len(t_s) else np.arange(0)
    apart_s = np.diff(t_s[rows])
    near = (apart_s > 0.5) & (apart_s < 2.0)
    chord_m = np.hypot(*np.diff(xy_m[rows], axis=0).T)
    return (t_s[rows][:-1] + apart_s / 2)[near], chord_m[near] / apart_s[near]


@dataclass(frozen=True, slots=True)
class Spans:
    """Stretches of the track whose rows are dropped for the same reasons: beginning, end [s] and bits, shape (M,) each."""

    start_s: Floats
    end_s: Floats
    bits: Ints

    @property
    def json(self) -> Json:
        """The spans as the page's script reads them."""
        return pack_columns({"start": ("f32", self.start_s), "end": ("f32", self.end_s), "bits": ("u16", self.bits)})


def find_mask_spans(track: pa.Table, timeline: Timeline, rate_hz: float) -> Spans:
    """Return the stretches, kept ones (bits 0) too; a row lasts a period of the track, and where rows are missing no stretch is."""
    t_s, bits = _compute_seconds(track, timeline), to_integers(track, "dropped_by")
    period_s = 1.0 / rate_hz
    begin = np.flatnonzero(np.r_[True, (np.diff(bits) != 0) | (np.diff(t_s) > 1.5 * period_s)])
    last = np.r_[begin[1:], len(t_s)] - 1
    return Spans(t_s[begin] - period_s / 2, t_s[last] + period_s / 2, bits[begin])
