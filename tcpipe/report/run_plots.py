"""A run over time: one axis of seconds under every plot, one cursor through all, what is not used shaded. The page's script fills them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from tcpipe.formats.json_files import Json
from tcpipe.report.colours import DROPPED, KEPT, LINE_COLOURS, REASON_COLOURS
from tcpipe.report.plots import Plot, add_cursor, make_plot, say_of
from tcpipe.report.run_series import Floats, Series, Spans, Timeline, downsample_columns
from tcpipe.tables.arrays import to_texts
from tcpipe.tables.bits import DropReason, flag_name
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.facts import StageFacts

REASON_WORDS = {
    DropReason.GAP: "no usable motion or power here: a gap of a sensor, a jump, or a position that is too uncertain",
    DropReason.STATIONARY: "it stands",
    DropReason.STUCK: "the wheels turn, the robot does not move",
    DropReason.TURNING_IN_PLACE: "it turns on the spot, or nearly",
    DropReason.REVERSING: "it drives backwards",
    DropReason.ACCELERATING: "its speed is changing",
    DropReason.BELOW_FULL_SPEED: "it is commanded below full speed: the speed is not the terrain's limit",
}
"""Why a row of the track is not used."""

_SPEEDS = {
    "gnss_velocity": "GNSS, Doppler",
    "gnss": "GNSS, a second's way",
    "visual_odometry": "visual odometry",
    "pose": "poses, a second's way",
}
SPEED_ROLES = tuple(_SPEEDS)
_UNITS = {"power": "W", "current": "A", "voltage": "V", "speed": "m/s", "height": "m", "σ": "m"}
_MOST_REFUSED = 10_000


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a plot: its name, and the series and column that it draws."""

    plot: str
    name: str
    series: str
    column: str

    def told(self, colour: str) -> Json:
        """Return it as the page's script reads it."""
        return {
            "plot": self.plot, "name": self.name, "series": self.series, "column": self.column, "colour": colour, "unit": _UNITS[self.plot],
        }  # fmt: skip


_OF_TRACK = (
    Line("power", "", "track", "power"),
    Line("speed", "fused", "track", "speed"),
    Line("speed", "wheels", "track", "wheels"),
    Line("speed", "commanded", "track", "commanded"),
    Line("height", "", "track", "height"),
    Line("σ", "position (DRMS)", "track", "position_std"),
    Line("σ", "height", "track", "height_std"),
    Line("σ", "a second's way", "track", "chord_std"),
)


def make_lines(series: Sequence[Series]) -> list[Line]:
    """Return what can be drawn, in the order of the page."""
    there = {(each.name, column) for each in series for column in each.columns}
    lines = [line for line in _OF_TRACK if (line.series, line.column) in there]
    for each in series:
        kind, _, rail = each.name.partition(" ")
        if kind in {"voltage", "current"}:
            lines.append(Line(kind, rail, each.name, kind))
        elif each.name in _SPEEDS:
            lines.append(Line("speed", _SPEEDS[each.name], each.name, "speed"))
    return sorted(lines, key=lambda line: list(_UNITS).index(line.plot))


@dataclass(frozen=True, slots=True)
class TimePlots:
    """The plots, one below the other, and the lines as the page's script reads them."""

    plots: tuple[Plot, ...]
    lines: tuple[Json, ...]


def time_plots(
    timeline: Timeline, *, lines: Sequence[Line], spans: Spans, facts: StageFacts, refused: pa.Table, labels: bool
) -> TimePlots:
    """Return the plots; ``labels`` is whether the run has segments."""
    first = _draw_masks(timeline, spans, facts)
    plots = [first]
    told: list[Json] = []
    for name in dict.fromkeys(line.plot for line in lines):
        mine = [line for line in lines if line.plot == name]
        coloured = {line: LINE_COLOURS[number % len(LINE_COLOURS)] for number, line in enumerate(mine)}
        legend = {line.name: colour for line, colour in coloured.items()} if len(mine) > 1 else {}
        plot = _draw_panel(name, f"{name} [{_UNITS[name]}]", first, legend=legend)
        at = [f"line {len(told) + number}" for number in range(len(mine))]
        for place, colour in reversed(list(zip(at, coloured.values(), strict=True))):  # the first lies on top
            ends = {"t": [0.0, 1.0], "y": [0.0, 1.0]}  # until the page's script has unpacked the series
            plot.figure.line("t", "y", color=colour, line_width=1.3, source=ends, name=place)
        told += [line.told(colour) for line, colour in coloured.items()]
        plots.append(plot)
    plots += [*_draw_rejections(timeline, first, refused), *_draw_clocks(timeline, first, facts)]
    if labels:
        plots.append(_draw_labels(first))
    for plot in plots[1:-1]:
        plot.figure.xaxis.visible = False
    plots[-1].figure.xaxis.axis_label = "time since the track began [s]"
    plots[-1].figure.height += 40
    for plot in plots:
        figure = plot.figure
        figure.toolbar_location = None
        figure.min_border_left = 112
        figure.min_border_right = 12
        shade = {"x0": [0.0], "x1": [0.0], "colour": [KEPT]}
        figure.vstrip(
            "x0", "x1", color="colour", alpha=0.13, source=shade, level="underlay", name=f"shade {figure.name}"
        )
        add_cursor(plot)
    return TimePlots(tuple(plots), tuple(told))


def _draw_panel(
    name: str, label: str, first: Plot | None, *, legend: Mapping[str, str] | None = None, alt: str = ""
) -> Plot:
    plot = make_plot(
        name,
        alt=alt or f"{label} over time; zoom and cursor are those of all plots here.",
        axes=("", label),
        legend=legend,
        height_px=130,
        tools="xbox_zoom",
        beside=first,
        waits=True,
    )
    plot.figure.yaxis.ticker.desired_num_ticks = 4
    return plot


def _draw_masks(timeline: Timeline, spans: Spans, facts: StageFacts) -> Plot:
    """Return the plot of what is kept and why the rest is not, and of what was found at a time; its axis is everyone's."""
    found = list(_iterate_events(timeline, facts))
    there = [bit for bit in DropReason if (spans.bits & int(bit)).any()]
    rows = ["kept", *(flag_name(bit).replace("_", " ") for bit in there), *dict.fromkeys(row for row, *_ in found)]
    plot = make_plot(
        "gates",
        alt="What of the drive is kept, by which gates the rest is dropped, and when sensors were refused or disagreed.",
        axes=("", ""),
        height_px=40 + 22 * len(rows),
        tools="xbox_zoom",
        names=rows[::-1],
        ends=(0.0, max(timeline.end_s, 1.0)),
    )
    figure = plot.figure
    bars = {"left": [0.0], "right": [1.0], "row": ["kept"], "colour": [KEPT]}
    figure.hbar(y="row", left="left", right="right", height=0.75, color="colour", source=bars, name="gates bars")
    if found:
        events = figure.hbar(
            y="row",
            left="left",
            right="right",
            height=0.75,
            color=DROPPED,
            source=dict(zip(("row", "left", "right", "text"), zip(*found, strict=True), strict=True)),
        )
        say_of(plot, events)
    figure.ygrid.visible = False
    return plot


def _iterate_events(timeline: Timeline, facts: StageFacts) -> Iterator[tuple[str, float, float, str]]:
    """Yield what has a time: its row, beginning and end [s], and what is to be said."""
    for each in facts.audit.disagreements if facts.audit else ():
        role = each.sensor.replace("_", " ")
        start_s, end_s = timeline.seconds(np.array([each.start_ns, each.end_ns]), np.full(2, each.clock_epoch))
        said = f"{role}: {each.what} off by {each.size:.2g} {each.unit}, {each.expected_std:.2g} expected"
        if np.isfinite(start_s):
            yield f"{role} disagrees", float(start_s), float(end_s), said
    for stretch in facts.fuse.stretches if facts.fuse else ():
        for opened in stretch.gate_resets:
            role = opened.role.replace("_", " ")
            start_s, end_s = timeline.seconds(
                np.array([opened.start_ns, opened.end_ns]), np.full(2, stretch.clock_epoch)
            )
            if np.isfinite(start_s):
                yield (
                    f"{role} shut out",
                    float(start_s),
                    float(end_s),
                    f"{role} was refused all this time, and off by {opened.size:.2g}",
                )
    for number, epoch in enumerate(timeline.epochs[1:]):
        steps = facts.clock_steps[number : number + 1]
        yield (
            "clock step",
            epoch.start_s - 1.0,
            epoch.start_s,
            f"the clock steps by {steps[0].step_s:+.3f} s" if steps else "the clock steps",
        )


def _draw_rejections(timeline: Timeline, first: Plot, refused: pa.Table) -> Iterator[Plot]:
    """Yield how far off refused measurements are; those without a χ² stand at 1."""
    if not refused.num_rows:
        return
    roles, t_s = to_texts(refused.column("role")), timeline.seconds(to_integers(refused, "stamp_ns"))
    ratio = to_floats(refused, "normalized_innovation_squared") / to_floats(refused, "threshold")
    names = sorted(set(roles.tolist()))
    colours = {role: LINE_COLOURS[number % len(LINE_COLOURS)] for number, role in enumerate(names)}
    plot = _draw_panel(
        "refused",
        "√(χ²/gate)",
        first,
        legend={role.replace("_", " "): colour for role, colour in colours.items()},
        alt="Measurements that the filter refused: how many times as far off as its gate allows. The table below counts them.",
    )
    for role, colour in colours.items():
        mine = (roles == role) & np.isfinite(t_s)
        if mine.any():
            shown = downsample_columns(role, t_s[mine], {"y": (6, _compute_allowed(ratio[mine]))}, most=_MOST_REFUSED)
            plot.figure.scatter(
                shown.t_s.astype(np.float32), shown.columns["y"][1].astype(np.float32), size=5, color=colour, alpha=0.7
            )
    plot.figure.y_range.start = 0
    yield plot


def _compute_allowed(ratio: Floats) -> Floats:
    return np.sqrt(np.where(np.isfinite(ratio), ratio, 1.0))


def _draw_clocks(timeline: Timeline, first: Plot, facts: StageFacts) -> Iterator[Plot]:
    """Yield how late sensors' stamps are over the run, pair by pair, where that is determined."""
    found = facts.clock_offsets
    start_s = {each.number: each.start_s for each in timeline.epochs}
    if found is None or found.clock_epoch not in start_s:
        return
    pairs = [pair for pair in found.pairs if pair.determined and pair.windows]
    names = [f"{pair.late} against {pair.against} by {pair.by}".replace("_", " ") for pair in pairs]
    colours = {name: LINE_COLOURS[number % len(LINE_COLOURS)] for number, name in enumerate(names)}
    if not pairs:
        return
    plot = _draw_panel("clocks", "late by [ms], ± σ", first, legend=colours)
    for pair, name in zip(pairs, names, strict=True):
        at_s, offset_s, std_s = np.array(pair.windows).T
        at_s = at_s + start_s[found.clock_epoch]
        plot.figure.segment(
            at_s, 1e3 * (offset_s - std_s), at_s, 1e3 * (offset_s + std_s), color=colours[name], line_width=2
        )
        plot.figure.scatter(at_s, 1e3 * offset_s, size=6, color=colours[name])
    yield plot


def _draw_labels(first: Plot) -> Plot:
    plot = _draw_panel(
        "label plot",
        "w [W], ± σ",
        first,
        legend={"segment": KEPT, "segment that carries a flag": LINE_COLOURS[1]},
        alt="The label of each segment that is chosen above, with its standard deviation.",
    )
    ends = [0.0, 1.0]
    empty = {"t": ends, "y": ends, "low": ends, "high": ends, "colour": [KEPT] * 2}
    drawn = plot.figure.segment("t", "low", "t", "high", color="colour", line_width=1.5, source=empty)
    plot.figure.scatter("t", "y", size=5, color="colour", source=drawn.data_source, name="labels")
    return plot


def make_reasons_data() -> Json:
    """Return the gates' bits, names, words and colours as the page's script reads them."""
    return [
        [int(bit), flag_name(bit).replace("_", " "), words, REASON_COLOURS[bit]] for bit, words in REASON_WORDS.items()
    ]
