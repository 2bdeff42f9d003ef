"""The page of one ingested run: where it drove, what its sensors told over time, what was used, and what each metre cost."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.errors import StoreError, TableError
from tcpipe.formats.finding_lines import advise_on_loss
from tcpipe.formats.json_files import Json
from tcpipe.formats.parquet import read_table
from tcpipe.formats.run_documents import Manifest, RunJson
from tcpipe.formats.stored_runs import RunDirectory
from tcpipe.motion.distance_breakdown import find_largest_losses
from tcpipe.report.colours import DOUBTED, FAINT, KEPT, UNUSED
from tcpipe.report.column_packing import Column, make_shown_column, pack_columns
from tcpipe.report.label_sections import (
    QUALITY_WORDS,
    make_budget_sections,
    make_physics_sections,
    make_quality_sections,
)
from tcpipe.report.page import Link, Number, Section, render_page
from tcpipe.report.plots import Plot, draw_histogram, draw_waterfall, label_histograms, make_plot
from tcpipe.report.run_map import Pictures, RunMap, run_map
from tcpipe.report.run_plots import SPEED_ROLES, Line, make_lines, make_reasons_data, time_plots
from tcpipe.report.run_sensors import make_sensor_sections
from tcpipe.report.run_series import (
    Series,
    Timeline,
    find_mask_spans,
    make_rail_series,
    make_speed_series,
    make_timeline,
    track_series,
)
from tcpipe.report.verdict import show_verdict
from tcpipe.store import Store
from tcpipe.tables.bits import Quality, flag_name
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.facts import PhysicsFacts

_PAGE = "report.html"
_STEP_M = 0.05
"""Places of the track that are nearer are one on the map."""

_LABELS = {
    "power": ("power_watt", "power_std_watt", 1),
    "velocity": ("velocity_mps", "velocity_std_mps", 3),
    "duration": ("duration_s", "duration_std_s", 3),
    "energy": ("energy_joule", "energy_std_joule", 1),
}


@dataclass(frozen=True, slots=True)
class _Drawn:
    """The interactive part of the page."""

    sections: tuple[Section, ...] = ()
    data: Json = None


def run_report(store: Store, run: RunDirectory, of_maps: MutableMapping[str, Pictures] | None = None) -> str:
    """Return the HTML page of a run of the store; a map of the store that lies under the run is its background.

    ``of_maps`` keeps pictures of maps by name, for who writes the pages of many runs.
    """
    track, segments, manifest, refused = run.track().table, run.segments(), run.manifest, run.rejections()
    label = manifest.info.report.facts.label
    known = store.run_json(run.run_id)
    ledger, total = manifest.ledger_m, sum(manifest.ledger_m.values())
    bits = to_integers(segments, "quality")
    quality = {flag_name(bit): int(((bits & int(bit)) != 0).sum()) for bit in Quality}
    drawn = _draw_run(store, run, track, segments, refused=refused, of_maps={} if of_maps is None else of_maps)
    return render_page(
        title=f"Run {run.run_id}",
        lead=f"Robot {manifest.robot}, recipe {run.recipe_id}, {_format_source(known)}",
        verdict=show_verdict(manifest.verdict, manifest.info.report.findings),
        numbers=[
            Number(f"{total:.0f} m", "driven"),
            Number(f"{segments.num_rows}", "segments"),
            Number(f"{100 * ledger.get('kept', 0.0) / max(total, 1e-9):.0f} %", "of the metres used"),
            Number(_mean(segments, "power_watt", "W"), "mean power w"),
            Number(_mean(segments, "velocity_mps", "m/s", digits=2), "mean velocity v"),
        ],
        links=[Link("All runs of the store", f"../../../{_PAGE}")] if store.place.size(_PAGE) is not None else [],
        sections=[
            *drawn.sections,
            _make_losses_section(ledger),
            *_label_sections(segments, label.physics if label else None, manifest.robot),
            *(make_quality_sections(quality, "segments") if segments.num_rows else []),
            *make_budget_sections(run.facts.energy_budget),
            *make_sensor_sections(known, manifest, refused),
            *_make_damage_sections(manifest.damage),
            _make_provenance_section(run, manifest, known),
        ],
        script="run.js" if drawn.data is not None else "",
        data=drawn.data,
    )


def _make_losses_section(ledger_m: Mapping[str, float]) -> Section:
    """Return where the distance went, and how to lose less of it."""
    rows = [
        (loss.reason.replace("_", " "), f"{loss.metres:.1f}", f"{100 * loss.share:.1f} %", advise_on_loss(loss.reason))
        for loss in find_largest_losses([ledger_m])
    ]
    text = "Kept and dropped distances add up to the odometer."
    header = ("lost to", "metres", "of all", "to lose less")
    return Section("Where every metre went", text, header=header, rows=rows, plots=[draw_waterfall(ledger_m)])


def _make_damage_sections(lines: Sequence[str]) -> list[Section]:
    rows = [(line,) for line in lines]
    text = "Where messages are lost or may be."
    return [Section("Damage of the log", text, header=("what",), rows=rows, folded=True)] if rows else []


def _format_source(known: RunJson | None) -> str:
    if known is None:
        return "source unknown"
    return f"from {', '.join(known.source.paths)} ({known.source.size_bytes / 1e6:.1f} MB)"


def _mean(segments: pa.Table, name: str, unit: str, *, digits: int = 0) -> str:
    values = segments.column(name).drop_null().to_numpy()
    return f"{values.mean():.{digits}f} {unit}" if len(values) else "none"


def _draw_run(
    store: Store,
    run: RunDirectory,
    track: pa.Table,
    segments: pa.Table,
    *,
    refused: pa.Table,
    of_maps: MutableMapping[str, Pictures],
) -> _Drawn:
    """Return map and plots over time with what their script needs; what cannot be drawn is said."""
    if not track.num_rows:
        return _Drawn((Section("The drive", "No track: the log holds nothing that could be fused."),))
    info = run.manifest.info
    timeline = make_timeline(track)
    ground = run_map(store, run, track, segments, located=info.datum is not None, of_maps=of_maps)
    told, lost = _read_series(store, run, timeline)
    series = [track_series(track, timeline, ground.track_xy_m), *told]
    lines, spans = make_lines(series), find_mask_spans(track, timeline, info.rate_hz)
    over_time = time_plots(
        timeline, lines=lines, spans=spans, facts=info.report.facts, refused=refused, labels=bool(segments.num_rows)
    )
    data: dict[str, Json] = {
        "run": run.run_id,
        "first_s": 0.0,
        "last_s": max(timeline.end_s, 1.0),
        "epochs": [[each.start_s, str(each.first_ns)] for each in timeline.epochs],
        "series": {each.name: each.json for each in series},
        "lines": over_time.lines,
        "spans": spans.json,
        "segments": _make_segments_data(segments, timeline, ground),
        "starts": [str(stamp) for stamp in to_integers(segments, "start_ns").tolist()],
        "reasons": make_reasons_data(),
        "quality": [[int(bit), words] for bit, words in QUALITY_WORDS.items()],
        "flags": _find_distinguishing_bits(to_integers(segments, "quality")),
        "ground": list(ground.ground),
        "step_m": _STEP_M,
        "kept": KEPT,
        "doubted": DOUBTED,
        "unused": UNUSED,
        "tall_by_wide": float(np.divide(*np.maximum(np.ptp(ground.track_xy_m, axis=0), 1.0)[::-1])),
    }
    text = "Colour shows what the distance is used for, or why it is not; click on the track or in a plot below for details."
    over = " ".join([_time_text(series, lines), *lost])
    sections = (
        Section("The drive", " ".join([text, *ground.missing]), controls="run.html", plots=[ground.plot]),
        Section("Over time", over, controls="run_time.html", plots=over_time.plots, stacked=True),
    )
    return _Drawn(sections, data)


def _find_distinguishing_bits(bits: NDArray[np.int64]) -> int:
    """Return the quality bits that some segments carry and others do not: a bit of all of them says nothing on a map."""
    return int(np.bitwise_or.reduce(bits, initial=0) & ~np.bitwise_and.reduce(bits)) if len(bits) else 0


def _read_series(store: Store, run: RunDirectory, timeline: Timeline) -> tuple[list[Series], list[str]]:
    """Return what sensors told, from the streams, and in words what of it is lost."""
    try:
        known = store.run_json(run.run_id)
        there = known.streams if known is not None and known.streams_key == run.streams_key else {}
        wanted = {name: of for name, of in there.items() if PurePosixPath(name).stem in ("power", *SPEED_ROLES)}
        files = store.stream_files(run.run_id, replace(known, streams=wanted)) if known is not None else {}
        tables = {role: read_table(path) for role, path in files.items()}
    except (StoreError, TableError) as error:
        return [], [f"What sensors told cannot be drawn: {error.problems[0]}."]
    if not tables and run.manifest.counts.messages.get("gnss"):
        return [], ["What sensors told is gone or was read anew: of it the track's columns are drawn."]
    series = list(make_rail_series(tables.pop("power"), timeline)) if "power" in tables else []
    if "gnss_velocity" in tables:
        tables.pop("gnss", None)
    speeds = [make_speed_series(role, table, timeline) for role, table in tables.items()]
    return [*series, *(each for each in speeds if each is not None)], []


def _time_text(series: Sequence[Series], lines: Sequence[Line]) -> str:
    """Return what the plots show, and which series are thinned."""
    text = (
        "Shaded: not used, in the colour of the reason. Draw a box to zoom, double-click for the whole run; every plot follows. "
        "Where many values share a pixel, the line goes through the lowest and the highest of them."
    )
    if not any(line.plot == "power" for line in lines):
        text += " There is no power."
    for each in series:
        if len(each.t_s) < each.of:
            text += (
                f" {each.name.replace('_', ' ')}: {each.of} values; the page carries the lowest and the highest of every "
                f"{-(-2 * each.of // len(each.t_s))}."
            )
    return text


def _make_segments_data(segments: pa.Table, timeline: Timeline, ground: RunMap) -> Json:
    """Return what the page holds of each segment."""
    epoch = to_integers(segments, "epoch")
    columns: dict[str, Column] = {
        name: ("f32", timeline.seconds(to_integers(segments, f"{name}_ns"), epoch)) for name in ("start", "end")
    }
    for number, end in enumerate(ground.ends_xy_m):
        columns |= {f"{axis}{number}": ("steps", end[:, place]) for place, axis in enumerate("xy")}
    for name, (value, std, digits) in _LABELS.items():
        columns[name], columns[f"{name}_std"] = (
            make_shown_column(digits, to_floats(segments, value)),
            ("half", to_floats(segments, std)),
        )
    rise_m = to_floats(segments, "end_z_m") - to_floats(segments, "start_z_m")
    columns["slope"] = "f32", np.degrees(np.arctan2(rise_m, to_floats(segments, "chord_m")))
    columns["turn"], columns["turn_std"] = (
        ("f32", np.degrees(to_floats(segments, f"turn_{part}rad"))) for part in ("", "std_")
    )
    columns["residual"] = "f32", to_floats(segments, "power_watt") - to_floats(segments, "physics_power_watt")
    return pack_columns(columns | {"quality": ("u16", to_integers(segments, "quality"))})


def _label_sections(segments: pa.Table, physics: PhysicsFacts | None, robot: str) -> Iterator[Section]:
    if not segments.num_rows:
        return
    yield Section("Labels", "One value a segment.", plots=label_histograms(segments, "segments", prefix="of "))
    if physics is None or not physics.fitted:
        return
    yield from make_physics_sections({} if physics.fit is None else {robot: physics.fit})
    text = (
        f"Power minus what standing, drivetrain, rolling, grade and turning, fitted on this run, predict ({physics.segments} segments): "
        f"terrain and errors. {physics.outliers} segments are further than four standard deviations of "
        f"{physics.residual_watt:.0f} W."
    )
    yield Section("What physics leaves unexplained", text, plots=list(_draw_physics(segments)))


def _draw_physics(segments: pa.Table) -> Iterator[Plot]:
    measured, fitted = to_floats(segments, "power_watt"), to_floats(segments, "physics_power_watt")
    yield draw_histogram("residual", measured - fitted, label="w - physics [W]", of_what="segments")
    known = np.isfinite(measured) & np.isfinite(fitted)
    plot = make_plot(
        "physics",
        alt="Power of each segment as it was measured against what physics predicts; on the line they are equal.",
        axes=("w by physics [W]", "w [W]"),
        height_px=220,
        tools="save",
        waits=True,
    )
    ends: NDArray[np.float64] = np.array([fitted[known].min(), fitted[known].max()]) if known.any() else np.zeros(2)
    plot.figure.scatter(
        fitted[known].astype(np.float32), measured[known].astype(np.float32), size=4, color=KEPT, alpha=0.7
    )
    plot.figure.line(ends, ends, color=FAINT, line_dash="dashed", line_width=1.5)
    yield plot


def _make_provenance_section(run: RunDirectory, manifest: Manifest, known: RunJson | None) -> Section:
    """Return what the run is made from: enough to make it again."""
    tags: Mapping[str, str] = manifest.tags
    rows = [
        ("made by", f"tcpipe {manifest.tcpipe_version}, data model {manifest.data_model_version}"),
        ("recipe", run.recipe_id),
        ("estimator", manifest.info.estimator),
        ("tags", ", ".join(f"{key}={value}" for key, value in tags.items()) or "none"),
        *((("log", f"sha256 {known.source.sha256}"),) if known is not None else ()),
    ]
    return Section(
        "Provenance", "The same log and recipe make the same run.", header=("what", "is"), rows=rows, folded=True
    )
