"""What the sensors' clocks look like: offsets between them and their drift, for the manifest, and the recipe line that corrects each."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np

from tcpipe.fusion.checks.clock_offsets import ClockOffsets, Pair, PowerSignal, RoleOffset, find_clock_offsets
from tcpipe.power.rails import power_at
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.fuse_sanity import longest_epoch
from tcpipe.stages.power_rails import rails_of
from tcpipe.tables.findings import ClockFacts, ClockOffset, ClockPair, Findings
from tcpipe.tables.levels import Streams

_MAX_GAP_NS = 300_000_000
_FINE_S = 0.004


def clock_findings(streams: Streams, inputs: FusionInputs) -> Findings[ClockFacts]:
    """Return the offsets between the sensors' clocks in the longest clock epoch; nothing is corrected.

    The recipe lines that would correct an offset include what the recipe adds already.
    """
    epoch = longest_epoch(inputs)
    found = find_clock_offsets(inputs.measurements[epoch], _power(streams, epoch))
    given_s = streams.findings.facts.time_offset_s
    offsets, warnings = {}, []
    for role, offset in found.offsets.items():
        entry = f"{role} = {given_s.get(role, 0.0) - offset.offset_s:.{3 if offset.std_s < _FINE_S else 2}f}"
        recipe = f'[read.time]\n{role} = "log"' if offset.drifts else f"[read.time_offset_s]\n{entry}"
        offsets[role] = ClockOffset(**_told(offset), recipe=recipe)
        if offset.drifts:
            warnings.append(_drift(found, role, offset))
        elif offset.noted:
            warnings.append(
                f"{role}: its stamps seem {abs(offset.offset_s):.2f} s {'late' if offset.offset_s > 0 else 'early'} against "
                f"{found.reference} (± {2 * offset.std_s:.2f} s, by {_means(found, role)}); nothing is corrected; "
                f"to correct it, write in the recipe under [read.time_offset_s]: {entry}"
            )
    pairs = tuple(ClockPair(**_told(pair), determined=pair.determined) for pair in found.pairs)
    return Findings(tuple(warnings), ClockFacts(epoch, found.reference, pairs, offsets))


def _told(each: RoleOffset | Pair) -> dict[str, Any]:
    """Return the fields by name, None for what is not known."""
    return {name: None if isinstance(v, float) and not math.isfinite(v) else v for name, v in asdict(each).items()}


def _drift(found: ClockOffsets, role: str, offset: RoleOffset) -> str:
    change_s = offset.drift_s_per_h * found.span_s / 3600
    return (
        f"{role}: its stamps drift against {found.reference} by {change_s:+.2f} s over the run "
        f"(± {2 * offset.drift_std_s_per_h * found.span_s / 3600:.2f} s, by {_means(found, role)}): no constant offset corrects that; "
        f'where the recorder\'s clock is the better one, write in the recipe under [read.time]: {role} = "log"'
    )


def _means(found: ClockOffsets, role: str) -> str:
    """Return by what the role was compared."""
    return " and ".join(dict.fromkeys(p.by for p in found.pairs if p.determined and role in {p.late, p.against}))


def _power(streams: Streams, epoch: int) -> PowerSignal | None:
    rails = rails_of(streams, epoch)
    if not rails or any(rail.current.stamp_ns.size < 2 for rail in rails):
        return None
    stamp_ns = np.unique(np.concatenate([rail.current.stamp_ns for rail in rails]))
    _, _, watt = power_at(rails, stamp_ns, max_gap_ns=_MAX_GAP_NS)
    known = np.isfinite(watt)
    return PowerSignal(stamp_ns[known], watt[known], streams.power_averaged) if known.sum() > 1 else None
