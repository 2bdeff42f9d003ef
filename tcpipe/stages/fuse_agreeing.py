"""The sensors that agree: one that the others contradict in most of the way is left out, and the run fused without it."""

from __future__ import annotations

from collections.abc import Sequence

from tcpipe.fusion.checks.audit import alone_in_most, consistent, undecided_in_most
from tcpipe.fusion.checks.sensors import Refusal
from tcpipe.recipe import FuseConfig
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.fuse_mounting import fuse_mounted
from tcpipe.stages.fuse_sanity import left_out
from tcpipe.stages.fuse_stretches import Fused, fuse_stretches
from tcpipe.tables.findings import Findings, SensorChecks
from tcpipe.tables.levels import Streams

_WHY = "in most of the way the others contradict it, and not each other (another clock, drive or unit?)"

Judged = tuple[FusionInputs, Findings[SensorChecks]]


def fuse_agreeing(
    inputs: FusionInputs, sanity: Findings[SensorChecks], streams: Streams, config: FuseConfig
) -> tuple[FusionInputs, Findings[SensorChecks], Fused]:
    """Fuse each stretch; where a sensor is alone against the others in most of the way, again without it."""
    inputs, fused = fuse_mounted(inputs, streams, config)
    lone = alone_in_most(fused.tallies) or _at_fault(inputs, sanity, fused, streams, config)
    if lone:
        inputs, sanity = _without(lone, inputs, sanity, streams)
        inputs, fused = fuse_mounted(inputs, streams, config)
    return inputs, sanity, fused


def _without(roles: Sequence[str], inputs: FusionInputs, sanity: Findings[SensorChecks], streams: Streams) -> Judged:
    return left_out(inputs, sanity, [Refusal(role, _WHY) for role in roles], streams)


def _at_fault(
    inputs: FusionInputs, sanity: Findings[SensorChecks], fused: Fused, streams: Streams, config: FuseConfig
) -> tuple[str, ...]:
    """Return the one sensor without which the others agree, where they contradict each other undecided; nothing where several would do.

    Of two sensors either would do: nobody can tell.
    """
    roles = sorted({role for m in inputs.measurements.values() for role in m.sensors()})
    if len(roles) <= 2 or not undecided_in_most(fused.tallies):
        return ()
    agreeing = []
    for role in roles:
        rest, _ = _without([role], inputs, sanity, streams)
        if any(m.gnss is not None or m.odometries() for m in rest.measurements.values()):
            tried = fuse_stretches(rest, streams, config)
            if tried.tallies and consistent(tried.tallies):
                agreeing.append(role)
    return (agreeing[0],) if len(agreeing) == 1 else ()
