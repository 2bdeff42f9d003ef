"""A run over time: one axis of seconds and one cursor for all plots, which the page's script fills with series."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from tcpipe.arrays import Floats, Ints
from tcpipe.formats.finding_lines import describe_finding
from tcpipe.formats.json_files import Json
from tcpipe.geometry.datum import enu_from_geodetic
from tcpipe.power.rails import is_power_only
from tcpipe.report.colours import KEPT, LINE_COLOURS, SEVERITY_COLOURS
from tcpipe.report.page import Column, make_shown_column, pack_columns
from tcpipe.report.plots import Plot, add_cursor, make_plot, show_text
from tcpipe.tables.bits import DropReason, flag_name
from tcpipe.tables.columns import stack_floats, to_floats, to_integers, to_texts
from tcpipe.tables.findings import Finding

MOST_VALUES = 80_000
"""Most values of a series on the page; longer series are thinned."""

_GAP_PERIODS = 10  # periods without a value that interrupt a line

_BETWEEN_EPOCHS_S = 1.0

_TRACK_COLUMNS = {
    "power": "power_watt",
    "speed": "forward_velocity_mps",
    "wheels": "wheel_velocity_mps",
    "commanded": "commanded_velocity_mps",
    "height": "z_m",
    "height_std": "z_std_m",
    "chord_std": "displacement_std_1s_m",
}
_TRACK_DIGITS = {"power": 1, "chord_std": 4}  # decimals that the page shows, where these are not 3


@dataclass(frozen=True, slots=True)
class Epoch:
    """A clock epoch of the track: its stamps, and where it begins on the page's axis."""

    number: int
    first_ns: int
    last_ns: int
    start_s: float


@dataclass(frozen=True, slots=True)
class Timeline:
    """The page's axis: seconds since the track's begin; after a clock step the next epoch follows a second later."""

    epochs: tuple[Epoch, ...]

    @property
    def end_s(self) -> float:
        """Where the track ends."""
        last = self.epochs[-1]
        return last.start_s + (last.last_ns - last.first_ns) * 1e-9

    def seconds(self, stamp_ns: Ints, epoch: Ints | None = None) -> Floats:
        """Return times of stamps [s], (N,), NaN outside the track; without ``epoch`` by the first that contains it."""
        t_s = np.full(len(stamp_ns), np.nan)
        for part in self.epochs:
            within = np.isnan(t_s) & (stamp_ns >= part.first_ns) & (stamp_ns <= part.last_ns)
            rows = within if epoch is None else epoch == part.number
            t_s[rows] = part.start_s + (stamp_ns[rows] - part.first_ns) * 1e-9
        return t_s


def make_timeline(track: pa.Table) -> Timeline:
    """Return the axis of a track that has rows."""
    stamps, epochs = to_integers(track, "stamp_ns"), to_integers(track, "clock_epoch")
    timeline_epochs: list[Epoch] = []
    start_s = 0.0
    for number in dict.fromkeys(epochs.tolist()):
        stamps_in_epoch = stamps[epochs == number]
        timeline_epochs.append(Epoch(number, int(stamps_in_epoch.min()), int(stamps_in_epoch.max()), start_s))
        start_s += (timeline_epochs[-1].last_ns - timeline_epochs[-1].first_ns) * 1e-9 + _BETWEEN_EPOCHS_S
    return Timeline(tuple(timeline_epochs))


@dataclass(frozen=True, slots=True)
class Series:
    """Columns that share their times, thinned where they are long."""

    name: str
    t_s: Floats
    columns: Mapping[str, Column]
    gap_s: float

    def to_json(self) -> Json:
        """Return the series as the page's script reads it."""
        times: dict[str, Column] = {"t": ("f32", self.t_s)}
        return {"packed": pack_columns(times | dict(self.columns)), "gap_s": self.gap_s}


def downsample_columns(
    name: str,
    t_s: Floats,
    values: Mapping[str, tuple[int, Floats]],
    *,
    sampled: Mapping[str, Column] | None = None,
    most: int = MOST_VALUES,
) -> Series:
    """Return columns with decimals by name; of more than ``most`` values the extremes of every bin stay.

    The two keep their order; their times are the bin's beginning and middle. Columns that are ``sampled`` keep the
    values there.
    """
    count = len(t_s)
    per_bin = -(-2 * count // most) if count > most else 1
    rows = np.arange(count)
    if per_bin > 1:
        begin = np.arange(0, count, per_bin)
        rows = np.stack([begin, np.minimum(begin + per_bin // 2, count - 1)], axis=1).ravel()
    kept = {key: make_shown_column(digits, _find_extremes(part, per_bin)) for key, (digits, part) in values.items()}
    kept |= {key: (kind, part[rows]) for key, (kind, part) in (sampled or {}).items()}
    period_s = float(np.median(np.diff(t_s))) if count > 1 else 1.0
    return Series(name, t_s[rows], kept, max(_GAP_PERIODS * period_s, per_bin * period_s * 2.0, 0.3))


def _find_extremes(values: Floats, per_bin: int) -> Floats:
    """Return the lowest and the highest of every bin in the order they occur; NaN of an empty bin."""
    if per_bin == 1:
        return values
    bins = np.append(values, np.full(-len(values) % per_bin, np.nan)).reshape(-1, per_bin)
    known = np.isfinite(bins)
    ends = np.stack(
        [np.where(known, bins, np.inf).argmin(axis=1), np.where(known, bins, -np.inf).argmax(axis=1)], axis=1
    )
    return np.take_along_axis(bins, np.sort(ends, axis=1), axis=1).ravel()


def make_track_series(track: pa.Table, timeline: Timeline, xy_m: Floats) -> Series:
    """Return the fused track with its places in the plane of the map (N, 2); columns without a value are left out."""
    values = {name: to_floats(track, column) for name, column in _TRACK_COLUMNS.items()}
    values["position_std"] = np.hypot(to_floats(track, "x_std_m"), to_floats(track, "y_std_m"))
    columns = {name: (_TRACK_DIGITS.get(name, 3), part) for name, part in values.items() if np.isfinite(part).any()}
    places: dict[str, Column] = {axis: ("steps", xy_m[:, number]) for number, axis in enumerate("xy")}
    return downsample_columns("track", _compute_seconds(track, timeline), columns, sampled=places)


def make_rail_series(power: pa.Table, timeline: Timeline) -> Iterator[Series]:
    """Yield voltage and current of each rail as measured, or its power where only that is known."""
    rails = to_texts(power.column("rail"))
    for rail in dict.fromkeys(rails.tolist()):
        rail_power = power.filter(rails == rail)
        quantities: tuple[tuple[str, str, int], ...] = (("voltage", "voltage_volt", 2), ("current", "current_amp", 3))
        if is_power_only(to_floats(rail_power, "voltage_volt")):
            quantities = (("power", "current_amp", 2),)
        for name, column, digits in quantities:
            values, t_s = to_floats(rail_power, column), _compute_seconds(rail_power, timeline)
            known = np.isfinite(values) & np.isfinite(t_s)
            if known.any():
                columns = {name: (digits, values[known])}
                yield downsample_columns(f"{name} {rail}", t_s[known], columns, most=MOST_VALUES // 2)


def _compute_seconds(table: pa.Table, timeline: Timeline) -> Floats:
    return timeline.seconds(to_integers(table, "stamp_ns"), to_integers(table, "clock_epoch"))


def make_speed_series(role: str, table: pa.Table, timeline: Timeline) -> Series | None:
    """Return the speed [m/s] of a sensor: measured, else by positions a second apart; None without either."""
    t_s = _compute_seconds(table, timeline)
    table, t_s = table.filter(np.isfinite(t_s)), t_s[np.isfinite(t_s)]
    speed = _read_speed(table)
    if not np.isfinite(speed).any():
        t_s, speed = _compute_chord_speed(table, t_s)
    known = np.isfinite(speed)
    if not known.any():
        return None
    return downsample_columns(role, t_s[known], {"speed": (3, speed[known])}, most=MOST_VALUES // 2)


def _read_speed(table: pa.Table) -> Floats:
    if "east_velocity_mps" in table.column_names:
        return np.hypot(to_floats(table, "east_velocity_mps"), to_floats(table, "north_velocity_mps"))
    if "velocity_x_mps" in table.column_names:
        return to_floats(table, "velocity_x_mps")
    return np.full(table.num_rows, np.nan)


def _compute_chord_speed(table: pa.Table, t_s: Floats) -> tuple[Floats, Floats]:
    """Return times in the middle of a second, and how fast the place moved over it [m/s]."""
    if "x_m" in table.column_names:
        xy_m = stack_floats(table, "x_m", "y_m")
    else:
        lon, lat, alt = (to_floats(table, name) for name in ("lon_deg", "lat_deg", "alt_m"))
        first = (float(lon[0]), float(lat[0]), float(alt[0])) if len(lon) else (0.0, 0.0, 0.0)
        xy_m = enu_from_geodetic(lon, lat, alt, datum_deg_m=first)[:, :2]
    known = np.isfinite(xy_m).all(axis=1)
    xy_m, t_s = xy_m[known], t_s[known]
    rows = np.flatnonzero(np.diff(np.floor(t_s - t_s[:1]), prepend=-1.0))
    apart_s = np.diff(t_s[rows])
    near = (apart_s > 0.5) & (apart_s < 2.0)
    chord_m = np.hypot(*np.diff(xy_m[rows], axis=0).T)
    return (t_s[rows][:-1] + apart_s / 2)[near], chord_m[near] / apart_s[near]


def find_mask_spans(track: pa.Table, timeline: Timeline, rate_hz: float) -> dict[str, Column]:
    """Return spans of the track whose rows have the same reasons, also of kept rows: start, end [s] and bits, (M,) each.

    A row lasts one period of the track, missing rows end a span.
    """
    t_s, bits = _compute_seconds(track, timeline), to_integers(track, "dropped_by")
    period_s = 1.0 / rate_hz
    begin = np.flatnonzero(np.r_[True, (np.diff(bits) != 0) | (np.diff(t_s) > 1.5 * period_s)])
    last = np.r_[begin[1:], len(t_s)] - 1
    ends_s = t_s[begin] - period_s / 2, t_s[last] + period_s / 2
    return {"start": ("f32", ends_s[0]), "end": ("f32", ends_s[1]), "bits": ("u16", bits[begin])}


FindingSpan = tuple[Finding, float, float]
"""An error or a warning, and when it holds on the page's axis [s]."""


def find_finding_spans(findings: Iterable[Finding], track: pa.Table, timeline: Timeline) -> list[FindingSpan]:
    """Return the spans of errors and warnings that have one; ends outside the clock epochs are seconds of the axis."""
    spans, start_ns = list[FindingSpan](), int(to_integers(track, "stamp_ns")[0])
    for finding in findings:
        if finding.severity == "note" or finding.span_s is None:
            continue
        ends_s = np.array(finding.span_s)
        on_axis_s = timeline.seconds(start_ns + np.round(ends_s * 1e9).astype(np.int64))
        start_s, end_s = np.clip(np.where(np.isnan(on_axis_s), ends_s, on_axis_s), 0.0, timeline.end_s).tolist()
        spans.append((finding, start_s, end_s))
    return spans


REASON_WORDS = {
    DropReason.GAP: "no usable motion or power: gap of a sensor, jump, or uncertain position",
    DropReason.STATIONARY: "it stands",
    DropReason.STUCK: "the wheels turn but the robot does not move",
    DropReason.TURNING_IN_PLACE: "turning in place, or nearly",
    DropReason.REVERSING: "driving backwards",
    DropReason.ACCELERATING: "the speed changes",
    DropReason.BELOW_FULL_SPEED: "commanded below full speed: the terrain does not limit the speed",
    DropReason.TIME_WINDOW: "outside the recipe's time windows",
    DropReason.POSITION_UNCERTAIN: "the position is less certain than the recipe requires",
}
"""Why a row of the track is not used."""

_SPEEDS = {
    "gnss_velocity": "GNSS, Doppler",
    "gnss": "GNSS, displacement over 1 s",
    "visual_odometry": "visual odometry",
    "pose": "poses, displacement over 1 s",
}
SPEED_ROLES = tuple(_SPEEDS)
_UNITS = {"power": "W", "current": "A", "voltage": "V", "speed": "m/s", "height": "m", "σ": "m"}
_MOST_REFUSED = 10_000


Line = tuple[str, str, str, str]
"""A line: its plot, its name there, and the series and column that it draws."""

_TRACK_LINES: tuple[Line, ...] = (
    ("power", "", "track", "power"),
    *(("speed", name, "track", column) for name, column in (("fused", "speed"), ("wheels",) * 2, ("commanded",) * 2)),
    ("height", "", "track", "height"),
    ("σ", "position (DRMS)", "track", "position_std"),
    ("σ", "height", "track", "height_std"),
    ("σ", "displacement over 1 s", "track", "chord_std"),
)


def make_trace_lines(series: Sequence[Series]) -> list[Line]:
    """Return the lines of these series, in the order of the page."""
    columns = {(part.name, column) for part in series for column in part.columns}
    lines = [line for line in _TRACK_LINES if line[2:] in columns]
    for part in series:
        kind, _, rail = part.name.partition(" ")
        if kind in {"voltage", "current"}:
            lines.append((kind, rail, part.name, kind))
        elif part.name in _SPEEDS:
            lines.append(("speed", _SPEEDS[part.name], part.name, "speed"))
    return sorted(lines, key=lambda line: list(_UNITS).index(line[0]))


def time_plots(
    timeline: Timeline,
    *,
    lines: Sequence[Line],
    spans: Mapping[str, Column],
    rejections: pa.Table,
    has_labels: bool,
    findings: Sequence[FindingSpan] = (),
) -> tuple[list[Plot], list[Json]]:
    """Return the plots, one below the other, and the lines as the page's script reads them."""
    first = _draw_masks(timeline, spans, findings)
    plots = [first]
    lines_json: list[Json] = []
    for name in dict.fromkeys(plot for plot, *_ in lines):
        drawn = [line for line in lines if line[0] == name]
        colours = _choose_colours([line[1] for line in drawn])
        legend = colours if len(colours) > 1 else {}
        plot = _draw_panel(name, f"{name} [{_UNITS[name]}]", first, legend=legend)
        places = [f"line {len(lines_json) + number}" for number in range(len(colours))]
        for place, colour in reversed(list(zip(places, colours.values(), strict=True))):  # the first is drawn on top
            ends = {"t": [0.0, 1.0], "y": [0.0, 1.0]}  # until the page's script has unpacked the series
            plot.figure.line("t", "y", color=colour, line_width=1.3, source=ends, name=place)
        fields = ("plot", "name", "series", "column", "colour", "unit")
        lines_json += [dict(zip(fields, (*line, colours[line[1]], _UNITS[name]), strict=True)) for line in drawn]
        plots.append(plot)
    plots += _draw_rejections(timeline, first, rejections)
    if has_labels:
        plots.append(_draw_labels(first))
    for plot in plots[1:-1]:
        plot.figure.xaxis.visible = False
    for plot in (first, plots[-1]) if len(plots) > 1 else (first,):
        plot.figure.xaxis.axis_label = "time since the track began [s]"
        plot.figure.height += 40
    border_px = max(112, 16 + 7 * max(map(len, first.figure.y_range.factors)))
    for plot in plots:
        figure = plot.figure
        figure.toolbar_location = None
        figure.min_border_left = border_px
        figure.min_border_right = 12
        shade = {"x0": [0.0], "x1": [0.0], "colour": [KEPT]}
        name = f"shade {figure.name}"
        figure.vstrip("x0", "x1", color="colour", alpha=0.13, source=shade, level="underlay", name=name)
        add_cursor(plot)
    return plots, lines_json


def _choose_colours(names: Sequence[str]) -> dict[str, str]:
    return {name: LINE_COLOURS[number % len(LINE_COLOURS)] for number, name in enumerate(names)}


def _draw_panel(name: str, label: str, first: Plot, *, legend: Mapping[str, str] | None = None, alt: str = "") -> Plot:
    plot = make_plot(
        name,
        alt=alt or f"{label} over time; zoom and cursor are those of all plots here.",
        axes=("", label),
        legend=legend,
        height_px=130,
        tools="xbox_zoom",
        x_range=first.figure.x_range,
        waits=True,
    )
    plot.figure.yaxis.ticker.desired_num_ticks = 4
    return plot


def _draw_masks(timeline: Timeline, spans: Mapping[str, Column], findings: Sequence[FindingSpan]) -> Plot:
    """Return the plot of findings, kept rows, and reasons for dropping the others; all plots share its time axis."""
    least_s = 0.004 * timeline.end_s  # so that short events are visible
    events = [
        (one.code, start_s, max(end_s, start_s + least_s), SEVERITY_COLOURS[one.severity], describe_finding(one))
        for one, start_s, end_s in findings
    ]
    problems, bits = dict.fromkeys(row for row, *_ in events), spans["bits"][1].astype(np.int64)
    reasons = [flag_name(bit).replace("_", " ") for bit in DropReason if (bits & int(bit)).any()]
    rows = [*problems, "kept", *reasons]
    plot = make_plot(
        "gates",
        alt="Spans of findings, kept sections of the drive, and masks of the rest.",
        axes=("", ""),
        height_px=40 + 20 * len(rows),
        tools="xbox_zoom",
        y_range=rows[::-1],
        x_range=(0.0, max(timeline.end_s, 1.0)),
    )
    figure = plot.figure
    bars = {"left": [0.0], "right": [1.0], "row": ["kept"], "colour": [KEPT]}
    figure.hbar(y="row", left="left", right="right", height=0.75, color="colour", source=bars, name="gates bars")
    if events:
        names = ("row", "left", "right", "colour", "text")
        source = dict(zip(names, zip(*events, strict=True), strict=True))
        show_text(plot, figure.hbar(y="row", left="left", right="right", height=0.75, color="colour", source=source))
    figure.ygrid.visible = False
    return plot


def _draw_rejections(timeline: Timeline, first: Plot, rejections: pa.Table) -> Iterator[Plot]:
    """Yield the plot of rejected measurements; those without a χ² are at 1."""
    if not rejections.num_rows:
        return
    roles, t_s = to_texts(rejections.column("role")), timeline.seconds(to_integers(rejections, "stamp_ns"))
    ratio = to_floats(rejections, "normalized_innovation_squared") / to_floats(rejections, "threshold")
    times_allowed = np.sqrt(np.where(np.isfinite(ratio), ratio, 1.0))
    colours = _choose_colours(sorted(set(roles.tolist())))
    plot = _draw_panel(
        "refused",
        "√(χ²/gate)",
        first,
        legend={role.replace("_", " "): colour for role, colour in colours.items()},
        alt="Measurements that the outlier gate rejected: distance relative to the limit of the gate. The table below counts them.",
    )
    for role, colour in colours.items():
        rows = (roles == role) & np.isfinite(t_s)
        if rows.any():
            shown = downsample_columns(role, t_s[rows], {"y": (6, times_allowed[rows])}, most=_MOST_REFUSED)
            x, y = shown.t_s.astype(np.float32), shown.columns["y"][1].astype(np.float32)
            plot.figure.scatter(x, y, size=5, color=colour, alpha=0.7)
    plot.figure.y_range.start = 0
    yield plot


def _draw_labels(first: Plot) -> Plot:
    plot = _draw_panel(
        "label plot",
        "w [W], ± σ",
        first,
        legend={"segment": KEPT, "segment with a flag": LINE_COLOURS[1]},
        alt="The label chosen above, for each segment, with its standard deviation.",
    )
    ends = [0.0, 1.0]
    empty = {"t": ends, "y": ends, "low": ends, "high": ends, "colour": [KEPT] * 2}
    bars = plot.figure.segment("t", "low", "t", "high", color="colour", line_width=1.5, source=empty)
    plot.figure.scatter("t", "y", size=5, color="colour", source=bars.data_source, name="labels")
    return plot
