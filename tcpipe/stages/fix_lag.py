"""A lag of the fixes that only the path tells, where turn rates and speeds do not tell their clock."""

from __future__ import annotations

from dataclasses import replace

from tcpipe.fusion.checks.mounting import lag_of
from tcpipe.fusion.measurements import GNSS
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.fuse_mounting import moved_m
from tcpipe.stages.fuse_stretches import Fused
from tcpipe.tables.facts import ClockFacts, ClockOffset
from tcpipe.tables.findings import StageReport, Subject, make_finding
from tcpipe.tables.levels import Streams


def with_lag_on_path(
    clocks: StageReport[ClockFacts], fused: Fused, inputs: FusionInputs, streams: Streams
) -> StageReport[ClockFacts]:
    """Return the findings on clocks with the lag of the fixes behind the path, where that is sure and was not told."""
    if GNSS not in streams.sensors:
        return clocks
    return with_lag_of_fixes(clocks, lag_of(fused.arms, moved_m(inputs, streams)))


def with_lag_of_fixes(clocks: StageReport[ClockFacts], lag: tuple[float, float] | None) -> StageReport[ClockFacts]:
    """Return the findings with a lag of the fixes and its deviation [s].

    Whether they are late or the odometry early, the path does not tell.
    """
    known = clocks.facts.offsets.get(GNSS)
    if lag is None or clocks.facts.position_offset_s or (known is not None and (known.noted or known.drifts)):
        return clocks
    lag_s, std_s = lag
    finding = make_finding(
        "clocks-differ",
        Subject("role", GNSS),
        action="inflated",
        names={"reference": "odometry", "by": "path"},
        offset_s=lag_s,
        offset_2std_s=2 * std_s,
        apart_s=abs(lag_s),
    )
    offset = ClockOffset(lag_s, std_s, True, None, None, False, blamed=False)
    facts = replace(clocks.facts, offsets={**clocks.facts.offsets, GNSS: offset}, position_offset_s=abs(lag_s))
    return StageReport((*clocks.findings, finding), facts)
