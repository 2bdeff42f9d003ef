"""What the page of a run says of its sensors: which topic played which role, how far each was believed, and whether clocks agree."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import pyarrow as pa

from tcpipe.formats.finding_lines import describe_remedy
from tcpipe.formats.run_documents import Counts, Manifest, RunJson
from tcpipe.report.page import Section
from tcpipe.tables.facts import ClockOffset, StageFacts
from tcpipe.tables.findings import Finding, select_findings


def make_sensor_sections(known: RunJson | None, manifest: Manifest, rejections: pa.Table) -> list[Section]:
    """Return the sections on topics, on trust, on disagreement and on clocks; ``known`` is None where the run's ``run.json`` is lost."""
    facts = manifest.info.report.facts
    topics = [] if known is None else [_make_topics_section(known, manifest.counts)]
    return [
        *topics,
        *_make_trust_sections(facts, rejections),
        *_make_disagreement_sections(facts),
        *_make_clock_sections(facts, manifest.info.report.findings),
    ]


def _name(role: str) -> str:
    return role.replace("_", " ")


def _make_topics_section(known: RunJson, counts: Counts) -> Section:
    rows = [
        (
            _name(role),
            sensor.topic,
            sensor.type_name,
            counts.messages.get(role, 0),
            sensor.time_source,
            sensor.placed_by,
            sensor.why,
        )
        for role, sensor in sorted(known.sensors.items())
    ]
    header = ("role", "topic", "type", "messages", "stamp", "placed by", "why this topic")
    return Section("Sensors", "Which topic played which role.", header=header, rows=rows)


def _make_trust_sections(facts: StageFacts, rejections: pa.Table) -> list[Section]:
    """Return how many measurements each sensor gave, how many were refused and why, and how well the rest fitted."""
    counts, nis = (facts.fuse.measurements, facts.fuse.nis_mean) if facts.fuse else ({}, {})
    lost = Counter(zip(rejections.column("role").to_pylist(), rejections.column("reason").to_pylist(), strict=True))
    checks = facts.sensor_checks.excluded if facts.sensor_checks else {}
    rows = [
        (
            _name(role),
            counts.get(role, 0),
            ", ".join(f"{count} {why}" for (name, why), count in sorted(lost.items()) if name == role),
            "" if (mean := nis.get(role)) is None else f"{mean:.2f}",
            checks.get(role, ""),
        )
        for role in sorted({*counts, *checks, *(role for role, _ in lost)})
    ]
    if not rows:
        return []
    text = (
        "Refused: by the χ² gate, or unusable (rejections.parquet lists each). NIS is the mean squared innovation over its "
        "variance and dimension, of what was taken: 1 fits its claimed error; far above, the sensor is worse than it says; "
        "far below, better."
    )
    header = ("sensor", "measurements", "refused", "NIS", "not fused, since")
    return [Section("How far each sensor was believed", text, header=header, rows=rows)]


def _make_disagreement_sections(facts: StageFacts) -> list[Section]:
    """Return when sensors and track disagree, by what and how much; where they never do, nothing."""
    found = facts.audit.disagreements if facts.audit else ()
    if not found:
        return []
    start_ns = min((stretch.start_ns for stretch in facts.fuse.stretches), default=0) if facts.fuse else 0
    rows = [
        (
            _name(each.sensor),
            each.what,
            f"{(each.start_ns - start_ns) * 1e-9:.0f} to {(each.end_ns - start_ns) * 1e-9:.0f} s",
            f"{each.size:.2g} {each.unit}",
            f"{each.expected_std:.2g} {each.unit}",
            "it is alone, the track is believed" if each.alone else "deviations are raised, segments flagged",
        )
        for each in found
    ]
    text = "The track held against each sensor that fed it, in windows of five seconds: where they differ beyond what both claim."
    header = ("sensor", "what", "in the run", "off by", "expected (1σ)", "so")
    return [Section("Where sensors disagree with the track", text, header=header, rows=rows)]


def _make_clock_sections(facts: StageFacts, findings: Sequence[Finding]) -> list[Section]:
    """Return how late each sensor's stamps are; where nothing could be compared, nothing."""
    found = facts.clock_offsets
    steps = [f"{step.step_s:+.3f} s at log time {step.log_time_ns} ns" for step in facts.clock_steps]
    offsets = found.offsets if found else {}
    if not offsets and not steps:
        return []
    rows = [
        (
            _name(role),
            f"{1e3 * (each.offset_s or 0.0):+.0f} ms",
            f"{2e3 * (each.std_s or 0.0):.0f} ms",
            _format_drift(each),
            _format_correction(role, findings),
        )
        for role, each in sorted(offsets.items())
    ]
    text = ""
    if found and rows:
        text = f"How late stamps are against {_name(found.reference)}, by what the sensors say of the same motion. Nothing is corrected."
    if steps:
        text += f" The clock steps: {'; '.join(steps)}."
    header = ("sensor", "late by", "± (2σ)", "drift", "correction")
    return [Section("Clocks", text.strip(), header=header, rows=rows)]


def _format_correction(role: str, findings: Sequence[Finding]) -> str:
    """Return what corrects a sensor's clock, as the findings on it propose."""
    clocks = select_findings(findings, "time-offset", "clock-drift", "clocks-differ")
    found = [finding for finding in clocks if finding.subject.name == role]
    remedies = [describe_remedy(finding, remedy) for finding in found for remedy in finding.remedies]
    return "; ".join(remedies) or ", ".join(finding.code.replace("-", " ") for finding in found)


def _format_drift(offset: ClockOffset) -> str:
    if offset.drift_s_per_h is None or offset.drift_std_s_per_h is None:
        return ""
    return f"{1e3 * offset.drift_s_per_h:+.0f} ± {2e3 * offset.drift_std_s_per_h:.0f} ms/h"
