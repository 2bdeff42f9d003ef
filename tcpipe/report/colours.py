"""The colours of pages and pictures: told apart with any colour vision, on white and on dark ground."""

from __future__ import annotations

INK = "#22303c"
FAINT = "#8a97a3"
KEPT = "#009e73"
DROPPED = "#d55e00"
SPLIT_COLOURS = {"train": "#0072b2", "test": "#e69f00", "unseen": "#c2185b", "buffer": FAINT}
CLASS_COLOURS = ("#aa3377", "#228833", "#66ccee", "#ccbb44", "#ee6677", "#4477aa", "#bbbbbb")
"""Paul Tol's bright scheme; class 1 has the first one, beyond the last they begin again."""


def class_colour(number: int) -> str:
    """Return the colour of a terrain class; 0 is unknown."""
    return CLASS_COLOURS[(number - 1) % len(CLASS_COLOURS)] if number > 0 else FAINT
