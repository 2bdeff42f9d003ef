"""Colours of pages and pictures, which differ for any colour vision, on light and dark backgrounds."""

from __future__ import annotations

from tcpipe.tables.bits import DropReason

FAINT = "#8a97a3"
KEPT = "#009e73"
DROPPED = "#d55e00"
SPLIT_COLOURS = {"train": "#0072b2", "test": "#e69f00", "unseen": "#c2185b", "buffer": FAINT}
CLASS_COLOURS = ("#aa3377", "#228833", "#66ccee", "#ccbb44", "#ee6677", "#4477aa", "#bbbbbb")
"""Paul Tol's bright scheme; class 1 has the first one, beyond the last they begin again."""
CURSOR = "#ff2d95"
DOUBTED = "#e69f00"
UNUSED = "#8fd3bd"
"""Kept rows that belong to no segment."""
SEVERITY_COLOURS = {"error": "#b3202a", "warning": DOUBTED, "note": "#56b4e9"}
REASON_COLOURS = {
    DropReason.GAP: "#cc79a7",
    DropReason.STATIONARY: FAINT,
    DropReason.STUCK: "#6b4a1b",
    DropReason.TURNING_IN_PLACE: "#b8a200",
    DropReason.REVERSING: "#56b4e9",
    DropReason.ACCELERATING: DROPPED,
    DropReason.BELOW_FULL_SPEED: "#0072b2",
    DropReason.TIME_WINDOW: "#999999",
    DropReason.POSITION_UNCERTAIN: "#aa3377",
}
"""Reasons why a row of the track is not used, on the map and over time."""
LINE_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", FAINT)
"""Lines in one plot; the first is the fused value."""


def find_class_colour(number: int) -> str:
    """Return the colour of a terrain class; 0 is unknown."""
    return CLASS_COLOURS[(number - 1) % len(CLASS_COLOURS)] if number > 0 else FAINT
