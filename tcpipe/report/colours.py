"""Colours of pages and pictures, which differ for any colour vision, on light and dark backgrounds."""

from collections.abc import Iterable

from tcpipe.tables.bits import DropReason
from tcpipe.terrain.layers import TerrainClass

FAINT = "#8a97a3"
KEPT = "#009e73"
DROPPED = "#d55e00"
SPLIT_COLOURS = {"train": "#0072b2", "test": "#e69f00", "unseen": "#c2185b", "buffer": FAINT}
CLASS_COLOURS = ("#aa3377", "#228833", "#66ccee", "#ccbb44", "#ee6677", "#4477aa", "#bbbbbb")
"""Paul Tol's bright scheme, for robots, runs, and classes without a colour word; it repeats after the last."""
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


_GROUND_COLOURS = {
    "#b89a63": ("unpaved",),
    "#4a4f55": ("paved", "asphalt"),
    "#c9c8c0": ("concrete",),
    "#9b9b9b": ("gravel",),
    "#77706a": ("rock", "stone"),
    "#e0c37c": ("sand",),
    "#dfeaf2": ("snow", "ice"),
    "#6b4423": ("mud",),
    "#8f653c": ("soil", "dirt"),
    "#2f7fd6": ("water",),
    "#17592d": ("tree", "forest"),
    "#2f8f5b": ("vegetation", "bush"),
    "#6cb52d": ("grass", "meadow"),
    "#c0392b": ("obstacle", "building"),
}
"""Words of a class's name by colour; of several colours the first one here counts."""


def choose_class_colours(classes: Iterable[TerrainClass]) -> dict[int, str]:
    """Return a colour for each class id: of the class table, else by its name, else, or if taken, by its id."""
    chosen = dict[int, str]()
    for entry in classes:
        name = entry.name.lower()
        named = (colour for colour, words in _GROUND_COLOURS.items() if any(word in name for word in words))
        colour = entry.color or next(named, "")
        is_free = colour and colour not in chosen.values()
        chosen[entry.id] = colour if is_free else CLASS_COLOURS[(entry.id - 1) % len(CLASS_COLOURS)]
    return chosen
