"""What the audit found of a whole run: facts for the manifest, and a line for each sensor that disagrees with the track."""

from __future__ import annotations

from collections.abc import Sequence

from tcpipe.fusion.checks.audit import undecided_in_most
from tcpipe.fusion.checks.odometry_scale import over_command
from tcpipe.fusion.measurements import WHEELS
from tcpipe.recipe.suggestions import suggested
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.fuse_sanity import command_of, longest_epoch, without_role
from tcpipe.stages.fuse_stretches import Fused
from tcpipe.stages.read_pose import recipe_role
from tcpipe.tables.facts import AuditFacts, Disagreement
from tcpipe.tables.findings import StageReport
from tcpipe.tables.levels import Streams


def audit_findings(fused: Fused, inputs: FusionInputs, streams: Streams) -> StageReport[AuditFacts]:
    """Return every disagreement, the sensors that contradict each other in most of the way, and the warnings of both."""
    undecided = undecided_in_most(fused.tallies)
    found = fused.disagreements
    first_ns = min((stretch.start_ns for stretch in fused.facts), default=0)
    kinds = dict.fromkeys((each.sensor, each.what, each.alone) for each in found)
    lines = [_line([e for e in found if (e.sensor, e.what, e.alone) == kind], first_ns) for kind in kinds]
    if undecided:
        who = " and ".join(f"{what} by {sensor}" for sensor, what in undecided)
        lines.append(
            f"{who}: in most of the way the track is not what this sensor says, and no third tells which is right: no segments; mend "
            "scale, mounting or clock of the sensor that is wrong"
            + "".join(
                without_role(name, f"to leave out {name}")
                for name in dict.fromkeys(recipe_role(of, streams) for of, _ in undecided)
            )
        )
    sensors = {sensor for sensor, _ in undecided}
    faster = _over_command(inputs, streams)
    if faster is not None:
        sensors.add(WHEELS)
        scale = round((streams.report.facts.odometry_scale or {}).get(WHEELS, 1.0) / faster, 2)
        lines.append(
            f"{WHEELS}: it goes {faster:.2f} times as fast as commanded, which no robot does, and no fix or camera tells how long a metre "
            f"is: no segments"
            + suggested(
                "to state its scale, or a smaller one, since ground slows a robot down",
                {"read.odometry_scale": {WHEELS: scale}},
            )
            + without_role("command", "to leave out the command, if it is not what drives")
        )
    return StageReport(tuple(lines), AuditFacts(tuple(found), tuple(sorted(sensors))))


def _over_command(inputs: FusionInputs, streams: Streams) -> float | None:
    """Return how many times as fast as commanded the wheels go, where that is too fast and nothing else tells how long a metre is."""
    if not inputs.measurements:
        return None
    epoch = longest_epoch(inputs)
    m, command = inputs.measurements[epoch], command_of(streams, epoch)
    if m.wheels is None or m.gnss is not None or m.visual is not None or command is None:
        return None
    return over_command(m.wheels, command.stamp_ns, command.forward_velocity_mps)


def _line(found: Sequence[Disagreement], first_ns: int) -> str:
    """Return the line of all disagreements of one kind: how often, the largest, and when that is."""
    worst = max(found, key=lambda each: each.size / each.expected_std)
    total_s = sum(each.end_ns - each.start_ns for each in found) * 1e-9
    begin_s, end_s = ((at_ns - first_ns) * 1e-9 for at_ns in (worst.start_ns, worst.end_ns))
    times = "" if len(found) == 1 else f"{len(found)} times, {total_s:.0f} s in all; most "
    what = (
        f"{worst.sensor}: its {worst.what} is off the track {times}from {begin_s:.0f} to {end_s:.0f} s of the run by {worst.size:.2g} "
        f"{worst.unit}, expected {worst.expected_std:.2g} {worst.unit} (1 sigma)"
    )
    if worst.alone:
        return f"{what}; two other sensors contradict it, so the track is believed"
    return f"{what}; deviations are raised there, and segments carry sensors_disagree"
