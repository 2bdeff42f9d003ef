"""Facts and findings of fusion: rejections, contradictions, and corrected lever arms, extrinsics and scales."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar, cast

import numpy as np

from tcpipe.arrays import Floats
from tcpipe.fusion.measurements import GNSS, IMU, VISUAL, WHEELS
from tcpipe.geometry.rotation import (
    matrix_from_quat,
    multiply,
    quat_from_matrix,
    quat_from_rotation_vector,
    quat_from_rpy,
    rotation_vector_from_quat,
)
from tcpipe.recipe.suggestions import suggest
from tcpipe.robust import MIN_SIGMAS
from tcpipe.stages.fuse_inputs import Section, exclude_role, state_extrinsics
from tcpipe.tables.facts import ChangeFacts, FuseFacts, GateReset, ParameterFacts, SectionFacts
from tcpipe.tables.findings import Finding, Subject, make_finding, read_threshold
from tcpipe.tables.levels import Sensor, Streams


def make_fuse_facts(
    inputs: Sequence[Section], sections: Sequence[SectionFacts], *, rows: int, skipped_s: float
) -> FuseFacts:
    """Return the facts of the run: counts by role over all sections, excluded measurements, and each section."""
    roles = sorted({role for section in sections for role in section.measurements})
    nis: dict[str, float | None] = {}
    for role in roles:
        of_role = [(each.nis_mean.get(role), each.measurements.get(role, 0)) for each in sections]
        known = [(mean, count) for mean, count in of_role if mean is not None]
        if known:
            means, counts = zip(*known, strict=True)
            nis[role] = float(np.average(means, weights=counts))
    return FuseFacts(
        rows=rows,
        sensors=tuple(sorted({role for section in sections for role in section.sensors})),
        measurements={role: sum(section.measurements.get(role, 0) for section in sections) for role in roles},
        rejected={role: sum(section.rejected.get(role, 0) for section in sections) for role in roles},
        nis_mean=nis,
        set_aside=add_counts(inputs),
        skipped_s=skipped_s,
        sections=tuple(sections),
    )


def add_counts(inputs: Sequence[Section]) -> dict[str, dict[str, int]]:
    """Return, by role, the counts of messages that are excluded or changed."""
    total: dict[str, dict[str, int]] = {}
    for role, each in (item for section in inputs for item in section.prepared.items()):
        counts = {
            "invalid": each.invalid_ns.size,
            "repeated": each.repeated,
            "variances_replaced": each.variances_replaced,
        }
        total[role] = {name: count + total.get(role, {}).get(name, 0) for name, count in counts.items()}
    return total


def find_fuse_findings(inputs: Sequence[Section], facts: FuseFacts, *, run: Subject) -> tuple[Finding, ...]:
    """Return the findings of fusion."""
    first_ns = min((section.start_ns for section in facts.sections), default=0)
    unused = set.intersection(*(set(section.excluded) for section in inputs))
    all_findings = (finding for section in inputs for finding in section.findings)
    findings = [*dict.fromkeys(finding for finding in all_findings if finding.subject.name not in unused)]
    # Reading already reports a log without fixes.
    if GNSS in facts.set_aside and all(section.datum_deg_m is None for section in inputs):
        findings.append(make_finding("local-frame", Subject("role", GNSS)))
    findings += _find_gate_resets(facts, first_ns)
    findings += _find_changes(facts, first_ns, run)
    findings += _find_weak_sensors(facts)
    for key, code in (("variances_replaced", "variances-replaced"), ("invalid", "values-unusable")):
        findings += [
            make_finding(code, Subject("role", role), row_count=count[key])
            for role, count in facts.set_aside.items()
            if count[key] and role not in unused
        ]
    if facts.skipped_s:
        findings.append(make_finding("sections-skipped", run, skipped_s=facts.skipped_s))
    return tuple(findings)


def _find_gate_resets(facts: FuseFacts, first_ns: int) -> Iterator[Finding]:
    """Yield the finding that fixes contradicted the odometry for seconds: number of times, and the largest one."""
    gate_resets = [gate_reset for section in facts.sections for gate_reset in section.gate_resets]
    odometries = [role for role in (WHEELS, VISUAL) if role in facts.sensors]
    if gate_resets:
        worst = max(gate_resets, key=lambda gate_reset: gate_reset.size)
        suspect, span_s = {"suspect": odometries[0]} if len(odometries) == 1 else {}, _find_span_s(worst, first_ns)
        numbers: dict[str, Any] = {"off_m": worst.size, "event_count": len(gate_resets)}
        yield make_finding("gnss-contradicts-odometry", Subject("role", GNSS), span_s=span_s, names=suspect, **numbers)


def _find_changes(facts: FuseFacts, first_ns: int, run: Subject) -> Iterator[Finding]:
    """Yield a finding for each change that explains a contradiction, and for each section with many changes."""
    changes = (each for section in facts.sections for each in section.changes if each.kind in CHANGES)
    for change in sorted(changes, key=lambda each: each.start_ns):
        names, span_s = {"change": CHANGES[change.kind].format(change.size)}, _find_span_s(change, first_ns)
        yield make_finding("sensor-changed", Subject("role", change.role), span_s=span_s, names=names)
    for section in facts.sections:
        count = section.count_changes()
        if count > read_threshold("changes-unlikely", "max_change_count"):
            yield make_finding("changes-unlikely", run, span_s=_find_span_s(section, first_ns), change_count=count)


def _find_weak_sensors(facts: FuseFacts) -> Iterator[Finding]:
    """Yield findings on odometries with an uncertain scale, and on sensors with many rejected measurements."""
    std = max((section.common_scale_std or 0.0 for section in facts.sections), default=0.0)
    if std > read_threshold("odometry-scale-unobservable", "min_scale_std_fraction"):
        role = WHEELS if WHEELS in facts.sensors or VISUAL not in facts.sensors else VISUAL
        names = {"reason": "coarse-gnss" if GNSS in facts.sensors else "no-gnss"}
        yield make_finding("odometry-scale-unobservable", Subject("role", role), names=names, scale_std_fraction=std)
    for role, count in facts.measurements.items():
        rejected = facts.rejected[role]
        if rejected > read_threshold("measurements-rejected", "max_rejected_fraction") * count:
            # Without any of these sensors there is no track.
            is_alone = {GNSS, WHEELS, VISUAL}.intersection(facts.sensors) <= {role}
            yield make_finding(
                "measurements-rejected",
                Subject("role", role),
                remedies=() if is_alone else exclude_role(role),
                rejected_fraction=rejected / count,
                rejected_count=rejected,
                measurement_count=count,
            )


CHANGES = {
    "offset": "positions are off by {:.2f} m",
    "step": "positions step by {:.2f} m, and nothing shows which side is right",
    "noise": "positions err by {:.2f} m (1σ), more than they claim",
    "slow": "positions err slowly by {:.2f} m (1σ), more than they claim",
    "antenna": "it was moved by {:.2f} m on the robot",
    "clock": "its clock stepped by {:.2f} s",
    "gyroscope": "the bias of its gyroscope jumped by {:.3f} rad/s",
    "accelerometer": "the bias of its accelerometer varies by {:.1f} m/s² (1σ)",
    "scale": "its scale changed by {:.0%}",
    "frame": "the frame of its attitude turned by {:.2f} rad",
    "pose": "its clock stepped, or the robot was moved by {:.1f} m without being measured",
}
"""Sentences for changes, with their size."""


def _find_span_s(each: SectionFacts | GateReset | ChangeFacts, first_ns: int) -> tuple[float, float]:
    """Return start and end since the first stamp [s]; the first tick may be before that stamp."""
    return max(each.start_ns - first_ns, 0) / 1e9, (each.end_ns - first_ns) / 1e9


def find_parameter_findings(inputs: Sequence[Section], facts: FuseFacts, streams: Streams) -> Iterator[Finding]:
    """Yield findings on extrinsics and scales that differ from the stated ones, with recipe keys.

    The longest section determines them.
    """
    longest = facts.longest
    parameters = longest.parameters
    arm, tilt = parameters.get("antenna"), parameters.get("mounting of the IMU")
    if arm is not None and GNSS in streams.sensors:
        sensor, turned = streams.sensors[GNSS], parameters.get("mounting of the pose")
        turn = _find_rotation(turned, inputs, longest, sensor)
        if sensor.placed_by == "assumed" or _is_contradicted(arm, 0.1):
            yield _make_arm_finding(arm, sensor, turn)
        difference_xyzw = quat_from_matrix(turn @ matrix_from_quat(sensor.quat_xyzw).T)
        angle_rad = float(np.linalg.norm(rotation_vector_from_quat(difference_xyzw)))
        angle_std_rad = 0.0 if turned is None else float(np.linalg.norm(turned.std))
        if sensor.placed_by != "assumed" and angle_rad > max(MIN_SIGMAS * angle_std_rad, 0.05):
            remedies, names = state_extrinsics(GNSS, sensor.xyz_m, turn), {"placed_by": sensor.placed_by}
            yield make_finding("pose-rotated", Subject("role", GNSS), names=names, remedies=remedies, off_rad=angle_rad)
    if tilt is not None and _is_contradicted(tilt, np.radians(1.0)):
        yield _make_tilt_finding(tilt, streams.sensors[IMU])
    for name, role in (("wheel scale", WHEELS), ("camera scale", VISUAL)):
        found = parameters.get(name)
        if found is not None and _is_contradicted(found, 0.1):
            scale, std = 1.0 + found.value[0], found.std[0]
            stated = (streams.report.facts.odometry_scale or {}).get(role, 1.0)
            remedies = suggest("state", {"read.odometry_scale": {role: round(stated / scale, 4)}})
            yield make_finding("odometry-scale", Subject("role", role), remedies=remedies, scale=scale, scale_std=std)
    # The scale of wheels always varies, since they slip.
    camera = parameters.get("camera scale")
    varies = {} if camera is None else {VISUAL: max(camera.variation, default=0.0)}
    varies |= {each.role: each.size for section in facts.sections for each in section.changes if each.kind == "varies"}
    for role, variation in varies.items():
        if variation > read_threshold("odometry-scale-varies", "min_variation_fraction"):
            yield make_finding("odometry-scale-varies", Subject("role", role), variation_fraction=variation)


def _is_contradicted(found: ParameterFacts, least: float) -> bool:
    """Return whether a parameter differs significantly from the stated value, and by at least ``least``."""
    return any(abs(v) > max(MIN_SIGMAS * s, least) for v, s in zip(found.value, found.std, strict=True))


def _find_rotation(
    turned: ParameterFacts | None, inputs: Sequence[Section], part: SectionFacts, sensor: Sensor
) -> Floats:
    """Return the rotation of the positions' sensor to base_link, (3, 3); for a pose as estimated from its run."""
    of_epoch = (each.measurements.gnss for each in inputs if each.clock_epoch == part.clock_epoch)
    fixes = next((each for each in of_epoch if each is not None and each.stamp_ns[-1] >= part.start_ns), None)
    if turned is None or fixes is None:
        return matrix_from_quat(sensor.quat_xyzw)
    return matrix_from_quat(multiply(quat_from_rotation_vector(turned.value), fixes.mounting_xyzw))


def _make_arm_finding(arm: ParameterFacts, sensor: Sensor, turn: Floats) -> Finding:
    place = np.asarray(sensor.xyz_m) + arm.value
    axes = ("forward", "left", "up")
    numbers: dict[str, Any] = {f"{axis}_m": value for axis, value in zip(axes, place.tolist(), strict=True)}
    numbers |= {f"{axis}_std_m": value for axis, value in zip(axes, arm.std, strict=True)}
    return make_finding(
        "lever-arm-unknown" if sensor.placed_by == "assumed" else "lever-arm-contradicted",
        Subject("role", GNSS),
        names={"placed_by": sensor.placed_by},
        remedies=state_extrinsics(GNSS, np.round(place, 2).tolist(), turn),
        **numbers,
    )


def _make_tilt_finding(tilt: ParameterFacts, sensor: Sensor) -> Finding:
    """Return the finding of a rotated IMU: the inverse rotation gives its measurements in robot axes."""
    turn = matrix_from_quat(quat_from_rpy(*(-value for value in tilt.value))) @ matrix_from_quat(sensor.quat_xyzw)
    return make_finding(
        "imu-tilted",
        Subject("role", IMU),
        names={"placed_by": sensor.placed_by},
        remedies=state_extrinsics(IMU, sensor.xyz_m, turn),
        roll_rad=-tilt.value[0],
        pitch_rad=-tilt.value[1],
    )


_Named = TypeVar("_Named")


def rename_role(value: _Named, old: str, new: str) -> _Named:
    """Return findings or facts with one role replaced by another."""
    named = cast("object", value)
    if isinstance(value, str):
        named = new if value == old else value
    elif isinstance(value, Mapping):
        named = {rename_role(key, old, new): rename_role(item, old, new) for key, item in value.items()}
    elif isinstance(value, tuple | list):
        named = type(value)(rename_role(item, old, new) for item in value)
    elif is_dataclass(value) and not isinstance(value, type):
        items = {entry.name: getattr(value, entry.name) for entry in fields(value)}
        named = replace(value, **rename_role(items, old, new))
    return cast("_Named", named)
