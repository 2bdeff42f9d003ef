"""The noise of a run's sensors over time differences, as fitted to the run and as they claim it, on the page of the run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tcpipe.report.colours import LINE_COLOURS
from tcpipe.report.page import Section
from tcpipe.report.plots import Plot, make_plot, show_text
from tcpipe.tables.facts import NoiseFacts, StageFacts

_TEXT = (
    "How much the error of each sensor changes over a time difference (1σ): fitted to the longest section of the run (line), and by the "
    "covariances of its messages, were their errors independent (dashed). A filled circle: the run determines more than half of the "
    "variance; an empty one: it is mostly what tcpipe assumes of such sensors."
)
_PLOTS = {
    "m": ("noise", "position, or distance driven [m]", 1.0),
    "rad": ("noise of turns", "angle turned [°]", 180.0 / np.pi),
}
"""By unit of the facts: name of the plot, label and factor of its axis."""
_TURN = " turn"


def make_noise_sections(facts: StageFacts) -> list[Section]:
    """Return the section on the noise of the sensors; none of a run whose estimator does not fit it."""
    stretches = [each for each in (facts.fuse.stretches if facts.fuse else ()) if each.noise]
    if not stretches:
        return []
    noise = max(stretches, key=lambda each: each.end_ns - each.start_ns).noise
    sensors = list(dict.fromkeys(name.removesuffix(_TURN) for name in noise))
    plots = []
    for unit in _PLOTS:
        drawn = {name: each for name, each in noise.items() if each.unit == unit}
        if drawn:
            plots.append(_draw(unit, drawn, [sensors.index(name.removesuffix(_TURN)) for name in drawn]))
    return [Section("Noise of the sensors", _TEXT, plots=plots)]


def _draw(unit: str, noise: Mapping[str, NoiseFacts], numbers: Sequence[int]) -> Plot:
    """Return the plot of sensors of one unit; a sensor has the colour of its number in the other plot, too."""
    name, label, factor = _PLOTS[unit]
    colours = {each.replace("_", " "): LINE_COLOURS[k] for each, k in zip(noise, numbers, strict=True)}
    plot = make_plot(
        name,
        alt=f"σ of the error in {label} over time differences, for {', '.join(colours)}: fitted to the run, and as claimed.",
        axes=("time difference [s]", f"σ of {label}"),
        legend=colours,
        tools="save",
        waits=True,
        x_axis_type="log",
        y_axis_type="log",
    )
    for (sensor, colour), each in zip(colours.items(), noise.values(), strict=True):
        std, claimed = (factor * np.array(values) for values in (each.std, each.claimed_std))
        plot.figure.line(each.time_s, claimed, color=colour, line_dash="dashed", line_width=1.3)
        plot.figure.line(each.time_s, std, color=colour, line_width=1.8)
        source = {
            "x": each.time_s,
            "y": std,
            "fill": [float(share > 0.5) for share in each.data_share],
            "text": _describe(sensor, each, std, claimed, "m" if unit == "m" else "°"),
        }
        show_text(plot, plot.figure.scatter("x", "y", size=7, color=colour, fill_alpha="fill", source=source))
    return plot


def _describe(sensor: str, each: NoiseFacts, std: Sequence[float], claimed: Sequence[float], unit: str) -> list[str]:
    return [
        f"{sensor} over {time_s:g} s: {fitted:.2g} {unit} fitted, {stated:.2g} {unit} claimed, {share:.0%} by the data"
        for time_s, fitted, stated, share in zip(each.time_s, std, claimed, each.data_share, strict=True)
    ]
