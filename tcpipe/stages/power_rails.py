"""The rails of a run's power table, epoch by epoch, and where its whole energy went."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from tcpipe.motion.distance_breakdown import find_interval_reason, sum_by_reason
from tcpipe.motion.row_sections import number_pieces
from tcpipe.power.energy import Rule, integrate_recorded_energy
from tcpipe.power.noise import compute_median_period_s, estimate_resolution
from tcpipe.power.rails import Rail, Samples, make_rail, make_samples
from tcpipe.tables.arrays import select_rows, to_numbers
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.facts import RailFacts, SignalFacts
from tcpipe.tables.levels import Streams


def make_rails(streams: Streams, epoch: int) -> list[Rail]:
    """Return the drive rails of one clock epoch, for all who ask for power, in the order of their names; none without power."""
    table = streams.tables.get("power")
    if table is None:
        return []
    # Of the whole run: a rail that is silent in an epoch is not known there.
    names = sorted(pc.unique(table["rail"]).to_pylist())
    table = select_rows(table, "clock_epoch", epoch)
    rails = []
    for name in names:
        mine = select_rows(table, "rail", name)
        signals = (
            make_samples(to_integers(mine, "stamp_ns"), to_floats(mine, c)) for c in ("voltage_volt", "current_amp")
        )
        rails.append(make_rail(name, *signals, averaged=streams.power_averaged))
    return rails


def describe_rail(each: Rail) -> RailFacts:
    """Return counts, rates and resolutions of a rail's samples."""
    return RailFacts(each.name, *(_describe_signal(signal) for signal in (each.voltage, each.current)))


def _describe_signal(signal: Samples) -> SignalFacts:
    period_s = compute_median_period_s(signal)
    return SignalFacts(
        len(signal.value), 1.0 / period_s if np.isfinite(period_s) else None, estimate_resolution(signal)
    )


def sum_energy_entries(rows: pa.Table, rails: list[Rail], *, rate_hz: float, rule: Rule) -> dict[str, float]:
    """Return the energy of one epoch by ledger entry, [J]; their sum is all that was recorded.

    Parameters
    ----------
    rows : the masked track's rows of that epoch.
    rate_hz : [Hz], of the track.

    Returns
    -------
    Every `DropReason` by name; ``steady`` (the stretches that were cut: kept, curved and leftover); ``outside_track`` (recorded
    before the track begins or after it ends).
    """
    stamp_ns = to_integers(rows, "stamp_ns")
    piece = number_pieces(stamp_ns, to_integers(rows, "clock_epoch"), period_ns=1e9 / rate_hz)
    reason = find_interval_reason(to_numbers(rows["dropped_by"]), piece)
    spent = integrate_recorded_energy(rails, stamp_ns[:-1], stamp_ns[1:], rule=rule)
    record = _integrate_whole_record(rails, rule)
    steady = float(spent[reason == 0].sum())
    return sum_by_reason(reason, spent) | {"steady": steady, "outside_track": record - float(spent.sum())}


def _integrate_whole_record(rails: list[Rail], rule: Rule) -> float:
    stamps: list[NDArray[np.int64]] = [each.stamp_ns[[0, -1]] for each in rails if len(each.stamp_ns)]
    if not stamps:
        return 0.0
    ends = np.sort(np.concatenate(stamps))
    return float(integrate_recorded_energy(rails, ends[:1], ends[-1:], rule=rule)[0])
