"""The page of one ingested run: where it drove, what was used, and what each metre cost."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyproj import Transformer

from tcpipe.errors import TcpipeError, plain_line
from tcpipe.formats.maps.map_files import MapFile, open_map
from tcpipe.formats.run_documents import RunJson
from tcpipe.formats.stored_runs import RunDirectory
from tcpipe.report.colours import DROPPED, KEPT
from tcpipe.report.error_budget import budget_sections
from tcpipe.report.figures import histograms, ledger_bars, over_distance, path_on_map
from tcpipe.report.overview import map_overview
from tcpipe.report.page import Number, Section, render_page
from tcpipe.report.physics import physics_sections
from tcpipe.report.quality import quality_sections
from tcpipe.report.run_sensors import sensor_sections
from tcpipe.store import Store
from tcpipe.tables.bits import DropReason, Quality, name_of
from tcpipe.tables.findings import PhysicsFacts

_MOSTLY = 0.5

_COLOURS = {
    "kept": KEPT,
    "gap": "#7a5195",
    "standing": "#9aa3ab",
    "stuck": "#000000",
    "turning in place": "#e0a100",
    "reversing": "#2a6fb0",
    "accelerating": DROPPED,
    "below limit": "#d48fb0",
}


def run_report(store: Store, run: RunDirectory) -> str:
    """Return the HTML page of a run of the store; a map of the store that lies under the run is its background."""
    track, segments, manifest = run.track().table, run.segments(), run.manifest
    label = manifest.info.findings.facts.label
    known = store.run_json(run.run_id)
    ledger, total = manifest.ledger_m, sum(manifest.ledger_m.values())
    return render_page(
        title=f"Run {run.run_id}",
        lead=f"Robot {manifest.robot}, recipe {run.recipe_id}, {_source_line(known)}",
        numbers=[
            Number(f"{total:.0f} m", "driven"),
            Number(f"{segments.num_rows}", "segments"),
            Number(f"{100 * ledger.get('kept', 0.0) / max(total, 1e-9):.0f} %", "of the metres used"),
            Number(_mean(segments, "power_watt", "W"), "mean power w"),
            Number(_mean(segments, "velocity_mps", "m/s", digits=2), "mean velocity v"),
        ],
        warnings=[*manifest.damage, *manifest.warnings],
        sections=[
            *_track_sections(store, run, track),
            *_segment_sections(segments, ledger, label.physics if label else None, manifest.robot),
            *budget_sections(run.facts.energy_budget),
            *sensor_sections(known, manifest, run.rejections()),
        ],
    )


def _source_line(known: RunJson | None) -> str:
    if known is None:
        return "source unknown"
    return f"from {', '.join(known.source.paths)} ({known.source.size_bytes / 1e6:.1f} MB)"


def _column(table: pa.Table, name: str) -> NDArray[np.float64]:
    values: NDArray[np.float64] = table.column(name).to_numpy(zero_copy_only=False)
    return values


def _bits(table: pa.Table, name: str) -> NDArray[np.uint32]:
    values: NDArray[np.uint32] = table.column(name).to_numpy()
    return values


def _mean(segments: pa.Table, name: str, unit: str, *, digits: int = 0) -> str:
    values = segments.column(name).drop_null().to_numpy()
    return f"{values.mean():.{digits}f} {unit}" if len(values) else "none"


def _first_reason(dropped_by: NDArray[np.uint32]) -> NDArray[np.object_]:
    """Return each row's reason by precedence, ``kept`` where there is none."""
    reasons = np.full(len(dropped_by), "kept", dtype=object)
    for bit in reversed(list(DropReason)):
        reasons[(dropped_by & int(bit)) != 0] = name_of(bit).replace("_", " ")
    return reasons


def _track_sections(store: Store, run: RunDirectory, track: pa.Table) -> list[Section]:
    if not track.num_rows:
        return []
    x, y = _column(track, "x_m"), _column(track, "y_m")
    dropped = _bits(track, "dropped_by")
    distance = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    series = {"speed [m/s]": (_column(track, "forward_velocity_mps"), "#2a6fb0")}
    if track.column("power_watt").null_count < track.num_rows:
        series["power [W]"] = (_column(track, "power_watt"), DROPPED)
    series["height [m]"] = (_column(track, "z_m"), "#8a5a2b")
    return [
        _path_section(store, run, track),
        Section("Speed, power and height over distance", "", over_distance(distance, series, dropped == 0)),
    ]


def _path_section(store: Store, run: RunDirectory, track: pa.Table) -> Section:
    reasons = _first_reason(_bits(track, "dropped_by"))
    text = "The fused track; colour says why a row is not used."
    found, lost = _map_under(store, run, track)
    text += "".join(f" Map {name} cannot be shown: {why}." for name, why in lost)
    if found is None:
        x, y = _column(track, "x_m"), _column(track, "y_m")
        return Section("Path", text, path_on_map(x, y, reasons, _COLOURS))
    source, picture, x, y = found
    x_min_m, y_min_m, x_max_m, y_max_m = source.grid.bounds_m
    svg = path_on_map(
        x,
        y,
        reasons,
        _COLOURS,
        backdrop=picture,
        extent_m=(x_min_m, x_max_m, y_min_m, y_max_m),
        labels=("easting [m]", "northing [m]"),
    )
    return Section("Path on the map", text, svg)


_Under = tuple[MapFile, NDArray[np.uint8], NDArray[np.float64], NDArray[np.float64]]


def _map_under(store: Store, run: RunDirectory, track: pa.Table) -> tuple[_Under | None, list[tuple[str, str]]]:
    """Return the first map that holds most of the track, its picture and the track in its CRS, and the maps that cannot be read."""
    gnss_crs = run.manifest.recipe.read.gnss_crs
    lon, lat = _column(track, "lon_deg"), _column(track, "lat_deg")
    lost: list[tuple[str, str]] = []
    for name in store.maps() if run.track().info.datum is not None else ():
        try:
            source = open_map(*store.map_files(name))
            x, y = Transformer.from_crs(gnss_crs, source.grid.crs, always_xy=True).transform(lon, lat)
            if source.grid.contains(np.column_stack([x, y])).mean() > _MOSTLY:
                return (source, map_overview(source), np.asarray(x), np.asarray(y)), lost
        except (TcpipeError, OSError) as error:
            lost.append((name, plain_line(str(error))))
    return None, lost


def _physics_sections(segments: pa.Table, physics: PhysicsFacts | None, robot: str) -> list[Section]:
    """Return what a metre costs by physics, and what that leaves unexplained; nothing where it could not be fitted."""
    if physics is None or not physics.fitted:
        return []
    left = _column(segments, "power_watt").astype(float) - _column(segments, "physics_power_watt").astype(float)
    text = (
        f"Power minus what standing, drivetrain, rolling, grade and turning, fitted on this run, predict ({physics.segments} segments): "
        f"terrain and errors. {physics.outliers} segments are further than four standard deviations of "
        f"{physics.residual_watt:.0f} W."
    )
    fits = {} if physics.fit is None else {robot: physics.fit}
    return [
        *physics_sections(fits),
        Section("What physics leaves unexplained", text, histograms({"w - physics [W]": left})),
    ]


def _segment_sections(
    segments: pa.Table, ledger: Mapping[str, float], physics: PhysicsFacts | None, robot: str
) -> list[Section]:
    sections = [
        Section("Where every metre went", "Kept and dropped add up to the odometer.", ledger_bars(ledger)),
    ]
    if segments.num_rows:
        labels = {"w [W]": "power_watt", "v [m/s]": "velocity_mps", "T [s]": "duration_s", "E [J]": "energy_joule"}
        data = {label: _column(segments, name).astype(float) for label, name in labels.items()}
        sections.append(Section("Labels", "One value a segment.", histograms(data)))
        sections += _physics_sections(segments, physics, robot)
        quality = _bits(segments, "quality")
        sections += quality_sections(
            {name_of(bit): int(((quality & int(bit)) != 0).sum()) for bit in Quality}, "segments"
        )
    return sections
