"""The rails of a run's power table, epoch by epoch, and where its whole energy went."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from tcpipe.motion.ledger import by_reason, interval_reason
from tcpipe.motion.pieces import piece_of_rows
from tcpipe.power.energy import Rule, recorded_energy_joule
from tcpipe.power.noise import median_period_s, resolution
from tcpipe.power.rails import Rail, Samples, rail, samples
from tcpipe.tables.arrays import numbers, rows_where
from tcpipe.tables.columns import floats, integers
from tcpipe.tables.facts import RailFacts, SignalFacts
from tcpipe.tables.levels import Streams


def rails_of(streams: Streams, epoch: int) -> list[Rail]:
    """Return the drive rails of one clock epoch, for all who ask for power, in the order of their names; none without power."""
    table = streams.tables.get("power")
    if table is None:
        return []
    # Of the whole run: a rail that is silent in an epoch is not known there.
    names = sorted(pc.unique(table["rail"]).to_pylist())
    table = rows_where(table, "epoch", epoch)
    rails = []
    for name in names:
        mine = rows_where(table, "rail", name)
        signals = (samples(integers(mine, "stamp_ns"), floats(mine, c)) for c in ("voltage_volt", "current_amp"))
        rails.append(rail(name, *signals, averaged=streams.power_averaged))
    return rails


def rail_facts(each: Rail) -> RailFacts:
    """Return counts, rates and resolutions of a rail's samples."""
    return RailFacts(each.name, *(_signal_facts(signal) for signal in (each.voltage, each.current)))


def _signal_facts(signal: Samples) -> SignalFacts:
    period_s = median_period_s(signal)
    return SignalFacts(len(signal.value), 1.0 / period_s if np.isfinite(period_s) else None, resolution(signal))


def energy_entries(rows: pa.Table, rails: list[Rail], *, rate_hz: float, rule: Rule) -> dict[str, float]:
    """Return the energy of one epoch by ledger entry, [J]; their sum is all that was recorded.

    Parameters
    ----------
    rows : the gated track's rows of that epoch.
    rate_hz : [Hz], of the track.

    Returns
    -------
    Every `DropReason` by name; ``steady`` (the stretches that were cut: kept, curved and leftover); ``outside_track`` (recorded
    before the track begins or after it ends).
    """
    stamp_ns = integers(rows, "stamp_ns")
    piece = piece_of_rows(stamp_ns, integers(rows, "epoch"), period_ns=1e9 / rate_hz)
    reason = interval_reason(numbers(rows["dropped_by"]), piece)
    spent = recorded_energy_joule(rails, stamp_ns[:-1], stamp_ns[1:], rule=rule)
    record = _whole_record_joule(rails, rule)
    steady = float(spent[reason == 0].sum())
    return by_reason(reason, spent) | {"steady": steady, "outside_track": record - float(spent.sum())}


def _whole_record_joule(rails: list[Rail], rule: Rule) -> float:
    stamps: list[NDArray[np.int64]] = [each.stamp_ns[[0, -1]] for each in rails if len(each.stamp_ns)]
    if not stamps:
        return 0.0
    ends = np.sort(np.concatenate(stamps))
    return float(recorded_energy_joule(rails, ends[:1], ends[-1:], rule=rule)[0])
