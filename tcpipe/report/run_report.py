"""The page of a run: map, sensors over time, use of the distance, labels, and how far each sensor agrees."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import PurePosixPath

import numpy as np
import pyarrow as pa

from tcpipe.arrays import Ints
from tcpipe.errors import StoreError, TableError
from tcpipe.formats.finding_lines import describe_finding
from tcpipe.formats.json_files import Json
from tcpipe.formats.parquet import read_table
from tcpipe.formats.place import REPORT
from tcpipe.formats.runs import Run
from tcpipe.formats.stored_runs import StoredRun, find_stream_files
from tcpipe.report.colours import DOUBTED, KEPT, REASON_COLOURS, SEVERITY_COLOURS, UNUSED
from tcpipe.report.label_sections import (
    LABELS,
    QUALITY_WORDS,
    find_distinguishing_bits,
    make_budget_sections,
    make_losses_sections,
    make_physics_sections,
    make_quality_section,
)
from tcpipe.report.maps import RunMap, StoredMaps, draw_run_map
from tcpipe.report.page import Column, Link, PageSection, make_shown_column, pack_columns, render_page, show_verdict
from tcpipe.report.run_plots import (
    REASON_WORDS,
    SPEED_ROLES,
    FindingSpan,
    Series,
    Timeline,
    find_finding_spans,
    find_mask_spans,
    make_rail_series,
    make_speed_series,
    make_timeline,
    make_trace_lines,
    make_track_series,
    time_plots,
)
from tcpipe.tables.bits import Quality, flag_name
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.facts import PhysicsFacts, StageFacts
from tcpipe.tables.findings import SEVERITIES, Finding, rank_severity, read_catalogue

_OVER_TIME = (
    "Shaded: excluded, in the colour of the reason. Draw a box to zoom, double-click for the whole run; all plots follow.\n"
    "Where many values share a pixel, the line shows their minimum and maximum."
)
_STEP_M = 0.05  # positions of the track that are nearer become one on the map


def run_report(run: StoredRun, maps: StoredMaps, *, made_from: str = "") -> str:
    """Return the HTML page of a run; a map of the store that contains the run is its background.

    The page has ``made_from``, a digest of its inputs, in its head, unless some of these are damaged.
    """
    track, segments, manifest, rejections = run.track().table, run.segments(), run.manifest, run.rejections()
    facts = manifest.info.report.facts
    sensors = [_make_topics_section(manifest), *_make_trust_sections(facts, rejections), *_make_clock_sections(facts)]
    ledger, total = manifest.distance_by_reason_m, manifest.driven_m
    drive, data, is_complete = _draw_run(run, track, segments, rejections=rejections, maps=maps)
    source = f"from {', '.join(manifest.log.paths)} ({manifest.log.size_bytes / 1e6:.1f} MB)"
    return render_page(
        title=f"Run {run.run_id}",
        lead=f"Robot {manifest.robot}, recipe {run.recipe_id}, {source}",
        verdict=show_verdict(manifest.verdict, manifest.info.report.findings),
        numbers=[
            (f"{total:.0f} m", "driven"),
            (f"{segments.num_rows}", "segments"),
            (f"{100 * ledger.get('kept', 0.0) / max(total, 1e-9):.0f} %", "of the metres used"),
            (_mean(segments, "power_watt", "W"), "mean power w"),
            (_mean(segments, "velocity_mps", "m/s", digits=2), "mean velocity v"),
        ],
        links=[Link("All runs of the store", f"../../{REPORT}")] if run.place.size(REPORT) is not None else [],
        sections=[
            *drive,
            *make_losses_sections([ledger], "Kept and excluded distances add up to the odometer.", names_runs=False),
            *_make_label_sections(run, segments, facts.label.physics if facts.label else None),
            PageSection("Sensors", parts=sensors),
            _make_provenance_section(manifest),
        ],
        script="run.js" if data is not None else "",
        data=data,
        made_from=made_from if is_complete else "",
    )


def _mean(segments: pa.Table, name: str, unit: str, *, digits: int = 0) -> str:
    values = segments.column(name).drop_null().to_numpy()
    return f"{values.mean():.{digits}f} {unit}" if len(values) else "none"


def _draw_run(
    run: StoredRun, track: pa.Table, segments: pa.Table, *, rejections: pa.Table, maps: StoredMaps
) -> tuple[list[PageSection], Json, bool]:
    """Return map and plots over time, the data of their script (None: no track), and whether no input was damaged."""
    if not track.num_rows:
        text = "No track: the log has no measurements that can be fused."
        return [PageSection("The drive", text)], None, True
    info = run.manifest.info
    timeline = make_timeline(track)
    has_datum = info.datum is not None
    run_map = draw_run_map(run, track, segments, maps, has_datum=has_datum)
    sensor_series, lost = _read_series(run, timeline)
    series = [make_track_series(track, timeline, run_map.track_xy_m), *sensor_series]
    lines, spans = make_trace_lines(series), find_mask_spans(track, timeline, info.rate_hz)
    findings = find_finding_spans(info.report.findings, track, timeline)
    over_time, lines_json = time_plots(
        timeline, lines=lines, spans=spans, rejections=rejections, has_labels=bool(segments.num_rows), findings=findings
    )
    data: dict[str, Json] = {
        "run": run.run_id,
        "first_s": 0.0,
        "last_s": max(timeline.end_s, 1.0),
        "epochs": [[epoch.start_s, str(epoch.first_ns)] for epoch in timeline.epochs],
        "series": {part.name: part.to_json() for part in series},
        "lines": lines_json,
        "spans": pack_columns(spans),
        "segments": _make_segments_data(segments, timeline, run_map, findings=info.report.findings, spans=findings),
        "findings": [
            [start_s, end_s, SEVERITY_COLOURS[finding.severity], *(finding.span_s or ())]
            for finding, start_s, end_s in findings
        ],
        "severities": [[name, SEVERITY_COLOURS[name]] for name in SEVERITIES],
        "starts": [str(stamp) for stamp in to_integers(segments, "start_ns").tolist()],
        "reasons": [
            [int(bit), flag_name(bit).replace("_", " "), words, REASON_COLOURS[bit]]
            for bit, words in REASON_WORDS.items()
        ],
        "quality": [[int(bit), words] for bit, words in QUALITY_WORDS.items()],
        "flags": find_distinguishing_bits(to_integers(segments, "quality")),
        "ground": list(run_map.ground),
        "step_m": _STEP_M,
        "kept": KEPT,
        "doubted": DOUBTED,
        "unused": UNUSED,
        "tall_by_wide": float(np.divide(*np.maximum(np.ptp(run_map.track_xy_m, axis=0), 1.0)[::-1])),
    }
    text = "Click on the track or a plot for details."
    over = [_OVER_TIME, *([] if any(plot == "power" for plot, *_ in lines) else ["There is no power."]), *lost]
    first, *others = over_time
    drive = PageSection(
        "The drive", " ".join([text, *run_map.missing]), controls="run.html", plots=[run_map.plot, first], stacked=True
    )
    over_time_section = PageSection("Over time", " ".join(over), controls="run_time.html", plots=others, stacked=True)
    return [drive, over_time_section], data, run_map.is_complete and not lost


def _read_series(run: StoredRun, timeline: Timeline) -> tuple[list[Series], list[str]]:
    """Return power and speeds of the run's streams, and in words which of them are lost."""
    shown = ("power", *SPEED_ROLES)
    streams = {name: each for name, each in run.facts.streams.items() if PurePosixPath(name).stem in shown}
    try:
        files = find_stream_files(run.place, replace(run.facts, streams=streams))
        tables = {role: read_table(path) for role, path in files.items()}
    except (StoreError, TableError) as error:
        return [], [f"The measurements cannot be drawn: {error.problems[0]}."]
    series = list(make_rail_series(tables.pop("power"), timeline)) if "power" in tables else []
    if "gnss_velocity" in tables:
        tables.pop("gnss", None)
    speeds = [make_speed_series(role, table, timeline) for role, table in tables.items()]
    return [*series, *(part for part in speeds if part is not None)], []


def _make_segments_data(
    segments: pa.Table,
    timeline: Timeline,
    run_map: RunMap,
    *,
    findings: Sequence[Finding],
    spans: Sequence[FindingSpan],
) -> Json:
    """Return the columns of segments on the page."""
    epoch = to_integers(segments, "clock_epoch")
    columns: dict[str, Column] = {
        name: ("f32", timeline.seconds(to_integers(segments, f"{name}_ns"), epoch)) for name in ("start", "end")
    }
    for number, end in enumerate(run_map.ends_xy_m):
        columns |= {f"{axis}{number}": ("steps", end[:, place]) for place, axis in enumerate("xy")}
    for name, (value, std, digits) in LABELS.items():
        columns[name], columns[f"{name}_std"] = (
            make_shown_column(digits, to_floats(segments, value)),
            ("half", to_floats(segments, std)),
        )
    rise_m = to_floats(segments, "end_z_m") - to_floats(segments, "start_z_m")
    columns["slope"] = "f32", np.degrees(np.arctan2(rise_m, to_floats(segments, "chord_m")))
    columns["turn"], columns["turn_std"] = (
        ("f32", np.degrees(to_floats(segments, f"yaw_change_{part}rad"))) for part in ("", "std_")
    )
    columns["position_std"] = "half", to_floats(segments, "position_std_m")
    columns["quality"] = "u16", to_integers(segments, "quality")
    columns["severity"] = "u8", _find_severities(columns, findings, spans)
    return pack_columns(columns)


def _find_severities(columns: Mapping[str, Column], findings: Sequence[Finding], spans: Sequence[FindingSpan]) -> Ints:
    """Return the worst severity of each segment, by spans and flags: its place in `SEVERITIES`, or their number."""
    start_s, end_s = (np.asarray(columns[name][1], float) for name in ("start", "end"))
    quality = np.asarray(columns["quality"][1], np.int64)
    concerned = [(finding.severity, (start_s <= last_s) & (end_s >= first_s)) for finding, first_s, last_s in spans]
    flags = {code: int(Quality[entry.flag.upper()]) for code, entry in read_catalogue().items() if entry.flag}
    concerned += [
        (finding.severity, (quality & flags[finding.code]) != 0) for finding in findings if finding.code in flags
    ]
    worst = np.full(len(quality), len(SEVERITIES))
    for severity, rows in concerned:
        worst[rows] = np.minimum(worst[rows], rank_severity(severity))
    return worst


def _make_label_sections(run: StoredRun, segments: pa.Table, physics: PhysicsFacts | None) -> list[PageSection]:
    """Return the section on labels, with physics, flags and uncertainty below it; none of a run without segments."""
    if not segments.num_rows:
        return []
    fits = {run.facts.robot: physics.fit} if physics is not None and physics.fit is not None else {}
    parts = [
        *make_physics_sections(fits),
        make_quality_section(to_integers(segments, "quality"), "segments"),
        *make_budget_sections(run.facts.energy_budget),
    ]
    return [PageSection("Labels", "One value per segment.", parts=parts)]


def _make_topics_section(manifest: Run) -> PageSection:
    rows = [
        (
            *(role.replace("_", " "), sensor.topic, sensor.type_name, manifest.counts.messages.get(role, 0)),
            *(sensor.time_source, sensor.placed_by, sensor.why),
        )
        for role, sensor in sorted(manifest.sensors.items())
    ]
    header = ("role", "topic", "type", "messages", "stamp", "placed by", "why this topic")
    return PageSection("Topics and roles", header=header, rows=rows)


def _make_trust_sections(facts: StageFacts, rejections: pa.Table) -> list[PageSection]:
    """Return, for each sensor, numbers of fused and rejected measurements, with reasons and the mean NIS."""
    counts, nis = (facts.fuse.measurements, facts.fuse.nis_mean) if facts.fuse else ({}, {})
    lost = Counter(zip(rejections.column("role").to_pylist(), rejections.column("reason").to_pylist(), strict=True))
    checks = facts.sensor_checks.excluded if facts.sensor_checks else {}
    rows = [
        (
            role.replace("_", " "),
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
        "Rejected: by the χ² gate, or unusable (rejections.parquet lists each).\nNIS is the mean squared innovation over its "
        "variance and dimension, of fused measurements: at 1 the stated σ is correct; far above 1 it is too small; "
        "far below, too large."
    )
    header = ("sensor", "measurements", "rejected", "NIS", "excluded because")
    return [PageSection("Rejected measurements by sensor", text, header=header, rows=rows)]


def _make_clock_sections(facts: StageFacts) -> list[PageSection]:
    """Return the time offset of each sensor, if any could be compared."""
    steps = [f"{step.step_s:+.3f} s at log time {step.log_time_ns} ns" for step in facts.clock_steps]
    rows = [
        (
            role.replace("_", " "),
            clocks.reference.replace("_", " "),
            f"{round(1e3 * offset.offset_s) + 0:+d} ms",
            f"{2e3 * offset.std_s:.0f} ms",
        )
        for clocks in facts.clock_offsets
        for role, offset in sorted(clocks.offsets.items())
    ]
    if not rows and not steps:
        return []
    text = "Time offsets from the motion that both sensors measure, by section." if rows else ""
    if steps:
        text += f" The clock steps: {'; '.join(steps)}."
    header = ("sensor", "relative to", "late by", "± (2σ)")
    return [PageSection("Clocks", text.strip(), header=header, rows=rows)]


def _make_provenance_section(manifest: Run) -> PageSection:
    """Return the inputs from which the run can be made again, and what is damaged of them."""
    rows = [
        ("made by", f"tcpipe {manifest.tcpipe_version}, data model {manifest.data_model_version}"),
        ("recipe", manifest.recipe_id),
        ("estimator", manifest.info.estimator),
        ("tags", ", ".join(f"{key}={value}" for key, value in manifest.tags.items()) or "none"),
        ("log", f"sha256 {manifest.log.sha256}"),
        *(("damage of the log", describe_finding(finding)) for finding in manifest.damage),
    ]
    text = "The same log and recipe give the same run."
    return PageSection("Provenance", text, header=("what", "is"), rows=rows, folded=True)
