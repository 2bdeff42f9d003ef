"""The sensors that agree: one that is contradicted in most of the way, or without which the others agree, is left out.

The sensor that stands alone is not always the wrong one: an IMU whose bias has jumped leads the track away from the fixes, and the
odometries with it. So before any is left out each is, for a trial.
"""

from __future__ import annotations

from collections.abc import Sequence

from tcpipe.fusion.checks.audit import alone_in_most, confirmations, consistent, undecided_in_most
from tcpipe.fusion.checks.sensors import Refusal, fixes_refused
from tcpipe.fusion.measurements import GNSS
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
    """Fuse each stretch; where sensors contradict each other in most of the way, again without the one that is at fault.

    What a track that they led showed of mountings and scales is forgotten then.
    """
    found, fused = fuse_mounted(inputs, streams, config)
    lone = alone_in_most(fused.tallies)
    if not lone and not undecided_in_most(fused.tallies):
        return found, sanity, fused
    lone = _at_fault(inputs, sanity, streams, config) or lone
    if not lone:
        return found, sanity, fused
    inputs, sanity = _without(lone, inputs, sanity, streams)
    found, fused = fuse_mounted(inputs, streams, config)
    return found, sanity, fused


def _without(roles: Sequence[str], inputs: FusionInputs, sanity: Findings[SensorChecks], streams: Streams) -> Judged:
    odometries = {name for m in inputs.measurements.values() for name in m.odometries()}.difference(roles)
    refusals = [fixes_refused(_WHY, odometries) if role == GNSS else Refusal(role, _WHY) for role in roles]
    return left_out(inputs, sanity, refusals, streams)


def _at_fault(
    inputs: FusionInputs, sanity: Findings[SensorChecks], streams: Streams, config: FuseConfig
) -> tuple[str, ...]:
    """Return the one sensor without which the others agree; of several that whose others confirm each other most, none of two equals.

    Of two sensors either would do: nobody can tell.
    """
    roles = sorted({role for m in inputs.measurements.values() for role in m.sensors()})
    if len(roles) <= 2:
        return ()
    agreeing: dict[str, int] = {}
    for role in roles:
        rest, _ = _without([role], inputs, sanity, streams)
        if any(m.gnss is not None or m.odometries() for m in rest.measurements.values()):
            tried = fuse_stretches(rest, streams, config)
            if tried.tallies and consistent(tried.tallies):
                agreeing[role] = confirmations(tried.tallies)
    best = [role for role, confirmed in agreeing.items() if confirmed == max(agreeing.values())]
    return (best[0],) if len(best) == 1 else ()
