"""What fusing noticed: facts for the manifest, and findings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tcpipe.fusion.measurements import GNSS, VISUAL, WHEELS, InitialState
from tcpipe.fusion.stretches import Stretch
from tcpipe.fusion.trajectory import Trajectory
from tcpipe.geometry.rotation import rpy_from_quat
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.fuse_sanity import exclude_role
from tcpipe.tables.catalogue import threshold
from tcpipe.tables.facts import FuseFacts, Reopening, StretchFacts
from tcpipe.tables.findings import Finding, Subject, make_finding

_COURSE = "course over ground"


def stretch_facts(stretch: Stretch, initial: InitialState, found: Trajectory) -> StretchFacts:
    """Return the facts of one stretch: the filter's, and where it lies and began."""
    m = stretch.measurements
    return replace(
        found.facts,
        epoch=stretch.epoch,
        start_ns=stretch.start_ns,
        end_ns=stretch.end_ns,
        rows=int(found.stamp_ns.size),
        sensors=tuple(m.sensors()),
        gyro_noise_radps=None if m.imu is None else m.imu.gyro_std_radps,
        accelerometer_noise_mps2=None if m.imu is None else m.imu.accelerometer_std_mps2,
        initial_yaw_rad=float(rpy_from_quat(initial.quat_xyzw)[2]),
        initial_yaw_std_rad=initial.yaw_std_rad,
        heading_from=initial.heading_from,
    )


def fuse_facts(inputs: FusionInputs, stretches: Sequence[StretchFacts], *, rows: int, skipped_s: float) -> FuseFacts:
    """Return the facts of the run: counts by role over all stretches, what was set aside, and each stretch."""
    roles = sorted({role for stretch in stretches for role in stretch.measurements})
    nis: dict[str, float | None] = {}
    for role in roles:
        means = [(s.nis_mean.get(role), s.measurements[role]) for s in stretches if role in s.measurements]
        known = [(mean, count) for mean, count in means if mean is not None]
        if known:
            nis[role] = float(np.average([mean for mean, _ in known], weights=[count for _, count in known]))
    return FuseFacts(
        rows=rows,
        sensors=tuple(sorted({role for stretch in stretches for role in stretch.sensors})),
        measurements={role: sum(stretch.measurements.get(role, 0) for stretch in stretches) for role in roles},
        rejected={role: sum(stretch.rejected.get(role, 0) for stretch in stretches) for role in roles},
        nis_mean=nis,
        set_aside=inputs.counts,
        skipped_s=skipped_s,
        stretches=tuple(stretches),
    )


def fuse_findings(inputs: FusionInputs, facts: FuseFacts, *, run: Subject, fixes: str = GNSS) -> tuple[Finding, ...]:
    """Return what was observed while fusing; ``fixes`` is the recipe's role of the positions."""
    gnss, first_ns = Subject("role", fixes), min((stretch.start_ns for stretch in facts.stretches), default=0)
    findings = [finding for finding in inputs.findings if finding.subject.name not in inputs.refused]
    if inputs.datum_deg_m is None and GNSS in inputs.counts:  # a log without any fix was found when it was read
        findings.append(make_finding("local-frame", gnss))
    elif inputs.datum_deg_m is not None:
        findings += [_find_initial_yaw(of, first_ns, gnss) for of in facts.stretches if of.heading_from != _COURSE]
    findings += _find_reopenings(facts, first_ns)
    findings += _find_scale(inputs, facts)
    findings += _find_rejections(facts, fixes)
    for key, code in (("variances_replaced", "variances-replaced"), ("invalid", "values-unusable")):
        findings += [
            make_finding(code, Subject("role", role), row_count=count[key])
            for role, count in inputs.counts.items()
            if count[key] and role not in inputs.refused
        ]
    if facts.skipped_s:
        findings.append(make_finding("sections-skipped", run, skipped_s=facts.skipped_s))
    return tuple(findings)


def _find_initial_yaw(stretch: StretchFacts, first_ns: int, gnss: Subject) -> Finding:
    names = {"source": stretch.heading_from}
    return make_finding("initial-yaw-uncertain", gnss, span_s=_span_s(stretch, first_ns), names=names)


def _find_scale(inputs: FusionInputs, facts: FuseFacts) -> list[Finding]:
    """Return the finding that nothing shows well how long a metre of odometry is."""
    std = max((stretch.common_scale_std or 0.0 for stretch in facts.stretches), default=0.0)
    if std <= threshold("odometry-scale-unobservable", "min_scale_std_fraction"):
        return []
    role = WHEELS if WHEELS in facts.sensors or VISUAL not in facts.sensors else VISUAL
    names = {"reason": "coarse-gnss" if GNSS in facts.sensors or inputs.scales else "no-gnss"}
    subject = Subject("role", role)
    return [make_finding("odometry-scale-unobservable", subject, names=names, scale_std_fraction=std)]


def _find_rejections(facts: FuseFacts, fixes: str) -> list[Finding]:
    most = threshold("measurements-rejected", "max_rejected_fraction")
    findings = []
    for role, count in facts.measurements.items():
        rejected, name = facts.rejected[role], fixes if role == GNSS else role
        if rejected > most * count:
            finding = make_finding(
                "measurements-rejected",
                Subject("role", name),
                remedies=exclude_role(name),
                rejected_fraction=rejected / count,
                rejected_count=rejected,
                measurement_count=count,
            )
            findings.append(finding)
    return findings


def _find_reopenings(facts: FuseFacts, first_ns: int) -> list[Finding]:
    """Return by sensor how often it contradicted the others for seconds, and where most."""
    findings = []
    reopenings = [reopening for stretch in facts.stretches for reopening in stretch.reopenings]
    odometries = [role for role in (WHEELS, VISUAL) if role in facts.sensors]
    for role in sorted({reopening.role for reopening in reopenings}):
        of_role = [reopening for reopening in reopenings if reopening.role == role]
        worst = max(of_role, key=lambda reopening: reopening.size)
        subject, span_s = Subject("role", role), _span_s(worst, first_ns)
        code, off = (
            ("gnss-contradicts-odometry", "off_m") if role == GNSS else ("odometry-contradicts-others", "off_mps")
        )
        suspect = {"suspect": odometries[0]} if role == GNSS and len(odometries) == 1 else {}
        numbers: dict[str, Any] = {off: worst.size, "event_count": len(of_role)}
        findings.append(make_finding(code, subject, span_s=span_s, names=suspect, **numbers))
    return findings


def _span_s(each: StretchFacts | Reopening, first_ns: int) -> tuple[float, float]:
    return (each.start_ns - first_ns) / 1e9, (each.end_ns - first_ns) / 1e9
