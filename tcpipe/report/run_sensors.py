"""What the page of a run says of its sensors: which topic played which role, how far each was believed, and whether clocks agree."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import pyarrow as pa

from tcpipe.report.page import Section


def sensor_sections(
    source: Mapping[str, Any] | None, manifest: Mapping[str, Any], rejections: pa.Table
) -> list[Section]:
    """Return the sections on topics, on trust and on clocks.

    Parameters
    ----------
    source : the run's ``run.json``; None where it is lost.
    """
    facts = manifest["info"]["findings"]["facts"]
    topics = [] if source is None else [_topics(source, manifest["counts"])]
    return [*topics, *_trust(facts, rejections), *_clocks(facts)]


def _name(role: str) -> str:
    return role.replace("_", " ")


def _topics(source: Mapping[str, Any], counts: Mapping[str, int]) -> Section:
    rows = [
        (
            _name(role),
            sensor["topic"],
            sensor["type_name"],
            counts.get(f"{role}_messages", 0),
            sensor["time_source"],
            sensor["placed_by"],
            sensor["why"],
        )
        for role, sensor in sorted(source["sensors"].items())
    ]
    header = ("role", "topic", "type", "messages", "stamp", "placed by", "why this topic")
    return Section("Sensors", "Which topic played which role.", header=header, rows=rows)


def _trust(facts: Mapping[str, Any], rejections: pa.Table) -> list[Section]:
    """Return how many measurements each sensor gave, how many were refused and why, and how well the rest fitted."""
    fused = facts.get("fuse", {})
    lost = Counter(zip(rejections.column("role").to_pylist(), rejections.column("reason").to_pylist(), strict=True))
    checks: Mapping[str, str] = facts.get("sensor_checks", {}).get("refused", {})
    nis = fused.get("nis_mean", {})
    rows = [
        (
            _name(role),
            fused.get("measurements", {}).get(role, 0),
            ", ".join(f"{count} {why}" for (name, why), count in sorted(lost.items()) if name == role),
            "" if nis.get(role) is None else f"{nis[role]:.2f}",
            checks.get(role, ""),
        )
        for role in sorted({*fused.get("measurements", {}), *checks, *(role for role, _ in lost)})
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


def _clocks(facts: Mapping[str, Any]) -> list[Section]:
    """Return how late each sensor's stamps are; where nothing could be compared, nothing."""
    found = facts.get("clock_offsets", {})
    steps = [f"{step['step_s']:+.3f} s at log time {step['log_time_ns']} ns" for step in facts.get("clock_steps", [])]
    offsets: Mapping[str, Mapping[str, Any]] = found.get("offsets", {})
    if not offsets and not steps:
        return []
    rows = [
        (
            _name(role),
            f"{1e3 * each['offset_s']:+.0f} ms",
            f"{2e3 * each['std_s']:.0f} ms",
            _drift(each),
            each["recipe"].replace("\n", " ") if each["noted"] or each.get("drifts") else "",
        )
        for role, each in sorted(offsets.items())
    ]
    text = (
        f"How late stamps are against {_name(found['reference'])}, by what the sensors say of the same motion."
        if rows
        else ""
    )
    text += " Nothing is corrected." if rows else ""
    if steps:
        text += f" The clock steps: {'; '.join(steps)}."
    header = ("sensor", "late by", "± (2σ)", "drift", "recipe line that would correct it")
    return [Section("Clocks", text.strip(), header=header, rows=rows)]


def _drift(offset: Mapping[str, Any]) -> str:
    if offset.get("drift_s_per_h") is None:
        return ""
    return f"{1e3 * offset['drift_s_per_h']:+.0f} ± {2e3 * offset['drift_std_s_per_h']:.0f} ms/h"
