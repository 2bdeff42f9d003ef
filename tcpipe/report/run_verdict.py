"""What a run's page says first, in plain words: what is good, thin and doubtful, and what to do."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from tcpipe.formats.run_documents import Manifest
from tcpipe.motion.remedies import REMEDIES
from tcpipe.report.page import Verdict
from tcpipe.report.quality import QUALITY_WORDS
from tcpipe.tables.bits import Quality, name_of
from tcpipe.tables.facts import NoPower, RunFacts

_FEW_SEGMENTS = 30
_MANY = 0.1
_NOISY = 0.05
_LARGE_LOSS = 0.05
_LITTLE_USED = 0.5
_MOST_LOSSES = 3
_SENSORS = {
    "power": "No power: no segment has w or E.",
    "gnss": "No GNSS: the track has no place on Earth, and no patch can be cut from a map.",
    "wheel_odometry": "No wheel odometry: slip is not known.",
    "visual_odometry": "No visual odometry (no camera's): one sensor fewer to hold the others against.",
    "command": "No commands: whether it drove as fast as the ground lets it is not known.",
}


def verdict(manifest: Manifest, quality: Mapping[str, int], missing: Sequence[str]) -> list[Verdict]:
    """Return the sentences; ``quality`` counts segments by bit, ``missing`` is what the page itself lacks."""
    facts = manifest.info.report.facts
    driven_m = sum(manifest.ledger_m.values())
    segments = manifest.counts.segments
    refused = facts.no_power
    return [
        *([Verdict("do", _power_remedy(refused))] if refused else []),
        *_used(segments, manifest.ledger_m.get("kept", 0.0), driven_m),
        *_good(facts),
        *_thin(manifest, segments, missing),
        *_doubtful(manifest, facts, quality, segments),
        *_to_do(manifest, facts, driven_m),
    ]


def _power_remedy(refused: NoPower) -> str:
    lines = f"\n{refused.recipe}" if refused.recipe else ""
    return f"{refused.why[0].upper()}{refused.why[1:]}{lines}"


def _used(segments: int, kept_m: float, driven_m: float) -> Iterator[Verdict]:
    if segments:
        share = kept_m / max(driven_m, 1e-9)
        said = f"{segments} segments: {kept_m:.0f} of {driven_m:.0f} m driven are used ({100 * share:.0f} %)."
        yield Verdict("good" if share >= _LITTLE_USED else "thin", said)


def _good(facts: RunFacts) -> Iterator[Verdict]:
    budget = facts.label.energy_budget if facts.label else None
    if budget is not None and budget.total < _NOISY:
        yield Verdict("good", f"Labels are sharp: the noise floor of E is {100 * budget.total:.1f} %.")
    if (
        facts.audit is not None
        and facts.fuse is not None
        and len(facts.fuse.sensors) > 1
        and not facts.audit.disagreements
    ):
        yield Verdict("good", "No sensor disagrees with the track beyond what both claim.")


def _thin(manifest: Manifest, segments: int, missing: Sequence[str]) -> Iterator[Verdict]:
    if 0 < segments < _FEW_SEGMENTS:
        yield Verdict("thin", f"{segments} segments only.")
    instead = {"gnss"} if manifest.counts.pose_messages else set()
    for role, text in _SENSORS.items():
        said = role == "power" and manifest.info.report.facts.no_power is not None
        if not getattr(manifest.counts, f"{role}_messages") and role not in instead and not said:
            yield Verdict("thin", text)
    for text in missing:
        yield Verdict("thin", text)
    label = manifest.info.report.facts.label
    if segments and label is not None and label.energy_joule is not None and not label.physics.fitted:
        yield Verdict("thin", "Physics could not be fitted: too few segments, or too much alike.")


def _doubtful(manifest: Manifest, facts: RunFacts, quality: Mapping[str, int], segments: int) -> Iterator[Verdict]:
    if not segments:
        yield Verdict("doubtful", "No segment: every metre was lost on the way; the waterfall below says to what.")
    if manifest.damage:
        yield Verdict(
            "doubtful", f"The log is damaged ({len(manifest.damage)} findings, listed below): a part may be missing."
        )
    words = {name_of(bit): text for bit, text in QUALITY_WORDS.items()}
    for name, count in sorted(quality.items(), key=lambda item: -item[1]):
        if count > _MANY * segments and name != name_of(Quality.NO_COMMAND):
            yield Verdict("doubtful", f"{100 * count / segments:.0f} % of the segments: {words[name]}.")
    budget = facts.label.energy_budget if facts.label else None
    if budget is not None and budget.total >= _NOISY:
        yield Verdict("doubtful", f"Labels are noisy: the noise floor of E is {100 * budget.total:.1f} %.")
    yield from _doubtful_sensors(facts)
    if facts.clock_steps:
        yield Verdict("doubtful", f"The clock steps {len(facts.clock_steps)} times.")


def _doubtful_sensors(facts: RunFacts) -> Iterator[Verdict]:
    found = Counter(each.sensor for each in facts.audit.disagreements) if facts.audit else {}
    for sensor, times in found.items():
        often = "once" if times == 1 else f"{times} times"
        yield Verdict("doubtful", f"{_name(sensor)} disagrees with the track {often}.")
    for role, why in (facts.sensor_checks.refused if facts.sensor_checks else {}).items():
        yield Verdict("doubtful", f"{_name(role)} is not fused: {why}.")
    for role, count in (facts.fuse.rejected if facts.fuse else {}).items():
        of = facts.fuse.measurements.get(role, 0) if facts.fuse else 0
        if count > _MANY * max(of, 1):
            yield Verdict("doubtful", f"{count} of {of} measurements of {_name(role)} were refused.")
    for role, offset in (facts.clock_offsets.offsets if facts.clock_offsets else {}).items():
        if offset.noted or offset.drifts:
            yield Verdict(
                "doubtful",
                f"The clock of {_name(role)} is off by {1e3 * (offset.offset_s or 0.0):+.0f} ms (see clocks).",
            )


def _to_do(manifest: Manifest, facts: RunFacts, driven_m: float) -> Iterator[Verdict]:
    losses = sorted(((name, m) for name, m in manifest.ledger_m.items() if name in REMEDIES), key=lambda item: -item[1])
    worth = [(name, m) for name, m in losses if m > _LARGE_LOSS * driven_m and not REMEDIES[name].startswith("nothing")]
    for name, metres in worth[:_MOST_LOSSES]:
        yield Verdict("do", f"{metres:.0f} m {name.replace('_', ' ')}: {REMEDIES[name]}.")
    if any(
        of.blamed and (of.noted or of.drifts)
        for of in (facts.clock_offsets.offsets if facts.clock_offsets else {}).values()
    ):
        yield Verdict("do", "The table of clocks has the recipe line that corrects it.")
    if not manifest.counts.power_messages and facts.no_power is None:
        yield Verdict("do", "Record voltage and current; 'tcpipe preflight LOG' prints what to record.")


def _name(role: str) -> str:
    return role.replace("_", " ")
