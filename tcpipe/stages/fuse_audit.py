"""What the audit found of a whole run: facts for the manifest, and a finding for each kind of disagreement of a sensor with the track."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tcpipe.fusion.checks.audit import undecided_in_most
from tcpipe.fusion.checks.odometry_scale import over_command
from tcpipe.fusion.measurements import WHEELS
from tcpipe.recipe.suggestions import suggest
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.fuse_sanity import command_of, exclude_role, longest_epoch
from tcpipe.stages.fuse_stretches import Fused
from tcpipe.stages.read_pose import recipe_role
from tcpipe.tables.facts import AuditFacts, Disagreement
from tcpipe.tables.findings import Finding, StageReport, Subject, make_finding
from tcpipe.tables.levels import Streams

_CODES = {"position": "position", "displacement": "distance", "turn": "turn"}
"""Beginnings of the codes by what is compared."""


def audit_findings(fused: Fused, inputs: FusionInputs, streams: Streams) -> StageReport[AuditFacts]:
    """Return every disagreement, the sensors that contradict each other over most of the distance, and the findings of both."""
    undecided = undecided_in_most(fused.tallies)
    found = fused.disagreements
    first_ns = min((stretch.start_ns for stretch in fused.facts), default=0)
    kinds = dict.fromkeys((each.sensor, each.what, each.alone) for each in found)
    findings = [
        _find_disagreement([e for e in found if (e.sensor, e.what, e.alone) == kind], first_ns) for kind in kinds
    ]
    for sensor, what in undecided:
        name = recipe_role(sensor, streams)
        names, subject = {"quantity": what}, Subject("role", name)
        findings.append(make_finding("disagreement-undecided", subject, names=names, remedies=exclude_role(name)))
    sensors = {sensor for sensor, _ in undecided}
    faster = _over_command(inputs, streams)
    if faster is not None:
        sensors.add(WHEELS)
        scale = round((streams.report.facts.odometry_scale or {}).get(WHEELS, 1.0) / faster, 2)
        remedies = suggest("state_scale", {"read.odometry_scale": {WHEELS: scale}})
        remedies += exclude_role("command", "exclude_command")
        wheels = Subject("role", WHEELS)
        findings.append(make_finding("faster-than-commanded", wheels, remedies=remedies, speed_ratio=faster))
    return StageReport(tuple(findings), AuditFacts(tuple(found), tuple(sorted(sensors))))


def _over_command(inputs: FusionInputs, streams: Streams) -> float | None:
    """Return how many times as fast as commanded the wheels go, where that is too fast and nothing else tells how long a metre is."""
    if not inputs.measurements:
        return None
    epoch = longest_epoch(inputs)
    m, command = inputs.measurements[epoch], command_of(streams, epoch)
    if m.wheels is None or m.gnss is not None or m.visual is not None or command is None:
        return None
    return over_command(m.wheels, command.stamp_ns, command.forward_velocity_mps)


def _find_disagreement(found: Sequence[Disagreement], first_ns: int) -> Finding:
    """Return the finding of all disagreements of one kind: how often, the largest, and when that is."""
    worst = max(found, key=lambda each: each.size / each.expected_std)
    numbers: dict[str, Any] = {f"off_{worst.unit}": worst.size, f"expected_std_{worst.unit}": worst.expected_std}
    return make_finding(
        f"{_CODES[worst.what]}-disagrees",
        Subject("role", worst.sensor),
        severity="note" if worst.alone else None,
        action="kept" if worst.alone else None,
        span_s=((worst.start_ns - first_ns) / 1e9, (worst.end_ns - first_ns) / 1e9),
        **numbers,
        event_count=len(found),
        total_s=sum(each.end_ns - each.start_ns for each in found) / 1e9,
    )
