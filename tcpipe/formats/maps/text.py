"""A map in a few plain lines, for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_SHARES = 5
"""Classes that a line lists by their share, commonest first."""


def map_lines(summary: Mapping[str, Any]) -> list[str]:
    """Return where a map lies and what each layer holds; ``summary`` is `tcpipe.formats.maps.map_files.MapFile.summary`'s."""
    rows, cols, pitch_m = summary["rows"], summary["cols"], summary["pitch_m"]
    crs = summary["crs"] if len(summary["crs"]) < 20 else "a CRS of its own"
    lines = [f"{cols} x {rows} px of {pitch_m:g} m ({cols * pitch_m:.0f} x {rows * pitch_m:.0f} m) in {crs}"]
    width = max(8, *(len(layer) for layer in summary["layers"]))
    for layer in summary["layers"]:
        covered = summary["covered"][layer]
        line = f"{layer:{width}s} {_percent(covered):>5s} covered, from {summary['sources'][layer]}"
        lines.append(line + _detail(layer, summary))
    return lines


def _detail(layer: str, summary: Mapping[str, Any]) -> str:
    if layer == "height":
        return f": {summary['height_min_m']:.1f} to {summary['height_max_m']:.1f} m"
    described = summary.get("described", {}).get(layer, {})
    if "actual_range" in described:
        low, high = described["actual_range"]
        return f": {low:.6g} to {high:.6g}" + ("" if described["units"] == "1" else f" {described['units']}")
    if layer == "terrain" or described:
        classes = summary["class_share"] if layer == "terrain" else summary["class_shares"][layer]
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
