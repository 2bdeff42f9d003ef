"""The sensors that agree: one that is contradicted in most of the way, or without which the others agree, is left out.

The sensor that stands alone is not always the wrong one: an IMU whose bias has jumped leads the track away from the fixes, and the
odometries with it. So before any is left out each is, for a trial. So it is where the track goes astray: it moves otherwise than every
sensor says that tells the robot's way, since what predicts it, an IMU, is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence

from tcpipe.errors import FusionError
from tcpipe.fusion.checks.audit import alone_in_most, confirmations, consistent, goes_astray, undecided_in_most
from tcpipe.fusion.checks.refusals import Refusal, refuse_fixes
from tcpipe.fusion.measurements import GNSS, IMU
from tcpipe.recipe import FuseConfig
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.fuse_mounting import fuse_mounted
from tcpipe.stages.fuse_sanity import left_out
from tcpipe.stages.fuse_stretches import Fused, fuse_stretches
from tcpipe.tables.facts import SensorChecks
from tcpipe.tables.findings import StageReport, Subject, make_finding
from tcpipe.tables.levels import Streams

Judged = tuple[FusionInputs, StageReport[SensorChecks]]


def fuse_agreeing(
    inputs: FusionInputs, sanity: StageReport[SensorChecks], streams: Streams, config: FuseConfig, *, run: Subject
) -> tuple[FusionInputs, StageReport[SensorChecks], Fused]:
    """Fuse each stretch; where sensors contradict each other in most of the way, again without the one that is at fault.

    So it is where the track goes astray. What a track that they led showed of mountings and scales is forgotten then.

    Raises
    ------
    FusionError : the track goes astray whichever sensor is left out.
    """
    found, fused = fuse_mounted(inputs, streams, config)
    lone, astray = alone_in_most(fused.tallies), _is_astray(fused)
    if lone or astray or undecided_in_most(fused.tallies):
        lone = _at_fault(inputs, sanity, streams, config, astray=astray) or lone
        if lone:
            inputs, sanity = _without(lone, inputs, sanity, streams, astray=astray)
            found, fused = fuse_mounted(inputs, streams, config)
    if _is_astray(fused):
        astray_fraction = fused.astray / fused.windows
        finding = make_finding("track-contradicts-sensors", run, astray_fraction=astray_fraction)
        raise FusionError("the track contradicts every sensor", findings=(finding, *sanity.findings))
    return found, sanity, fused


def _is_astray(fused: Fused) -> bool:
    return goes_astray(fused.windows, fused.astray)


def _without(
    roles: Sequence[str], inputs: FusionInputs, sanity: StageReport[SensorChecks], streams: Streams, *, astray: bool
) -> Judged:
    code = "misleads-track" if astray else "contradicted-by-others"
    odometries = {name for m in inputs.measurements.values() for name in m.odometries()}.difference(roles)
    refusals = [refuse_fixes(code, odometries) if role == GNSS else Refusal(role, code) for role in roles]
    return left_out(inputs, sanity, refusals, streams)


def _at_fault(
    inputs: FusionInputs, sanity: StageReport[SensorChecks], streams: Streams, config: FuseConfig, *, astray: bool
) -> tuple[str, ...]:
    """Return the one sensor without which the others agree; of several that whose others confirm each other most, none of two equals.

    Of two sensors either would do: nobody can tell. Of a track that goes ``astray`` it is the IMU, of which the process is made, if the
    track does not without it; else the only sensor without which it does not.
    """
    roles = sorted({role for m in inputs.measurements.values() for role in m.sensors()})
    if len(roles) <= 2 and not astray:
        return ()
    agreeing: dict[str, int] = {}
    following: list[str] = []
    for role in roles:
        rest, _ = _without([role], inputs, sanity, streams, astray=astray)
        if any(m.gnss is not None or m.odometries() for m in rest.measurements.values()):
            tried = fuse_stretches(rest, streams, config)
            if tried.tallies and consistent(tried.tallies):
                agreeing[role] = confirmations(tried.tallies)
            if tried.found and not _is_astray(tried):
                following.append(role)
    best = [role for role, confirmed in agreeing.items() if confirmed == max(agreeing.values())]
    if astray and (len(best) != 1 or best[0] not in following):
        best = [IMU] if IMU in following else following
    return (best[0],) if len(best) == 1 else ()
