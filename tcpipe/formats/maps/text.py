"""A map in a few plain lines, for people."""

from __future__ import annotations

from pathlib import Path

from tcpipe.formats.layer_descriptions import layers_described
from tcpipe.formats.maps.map_facts import MapSummary

_SHARES = 5
"""Classes that a line lists by their share, commonest first."""


def map_lines(of: MapSummary) -> list[str]:
    """Return where a map lies and what each layer holds."""
    rows, cols, pitch_m = of.rows, of.cols, of.pitch_m
    crs = of.crs if len(of.crs) < 20 else "a CRS of its own"
    lines = [f"{cols} x {rows} px of {pitch_m:g} m ({cols * pitch_m:.0f} x {rows * pitch_m:.0f} m) in {crs}"]
    width = max(8, *(len(layer) for layer in of.layers))
    for layer in of.layers:
        line = f"{layer:{width}s} {_percent(of.covered[layer]):>5s} covered, from {of.sources[layer]}"
        lines.append(line + _detail(layer, of))
    return lines


def _detail(layer: str, of: MapSummary) -> str:
    if layer == "height":
        return f": {of.height_min_m:.1f} to {of.height_max_m:.1f} m"
    own = layers_described(of.described, (), Path(of.name)).get(layer)
    if own is not None and own.stack == "floats":
        return f": {own.low:.6g} to {own.high:.6g}" + ("" if own.unit == "1" else f" {own.unit}")
    if layer == "terrain" or own is not None:
        classes = of.class_share if layer == "terrain" else of.class_shares[layer]
        shares = sorted(classes.items(), key=lambda entry: (-entry[1], entry[0]))
        listed = [f"{_percent(share)} {name}" for name, share in shares[:_SHARES]]
        return ": " + ", ".join(listed) + (" …" if len(shares) > _SHARES else "")
    return ""


def _percent(share: float) -> str:
    """Return a share as per cent; never 0 % of something or 100 % of less than all."""
    percent = 100.0 * share
    if 0.0 < percent < 0.5:
        return "<1 %"
    return ">99 %" if 99.5 <= percent < 100.0 else f"{percent:.0f} %"
