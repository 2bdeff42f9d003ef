"""What a dataset covers, how much of it is independent, and how well its labels repeat themselves: sections of its page."""

from __future__ import annotations

from collections.abc import Sequence

from tcpipe.balance.cells import SLOPE_NAMES
from tcpipe.formats.dataset_card import Balance, CellRow
from tcpipe.report.page import Section, Shaded

_UNITS = {"watt": "W", "mps": "m/s", "s": "s", "joule": "J"}


def balance_sections(balance: Balance) -> list[Section]:
    """Return the sections."""
    return [_by_class(balance), _by_speed(balance), _repeatability(balance)]


def _by_class(balance: Balance) -> Section:
    cells = balance.by_class_and_slope
    text = (
        f"Samples, and in brackets how many independent ones they are worth: neighbours are alike ({_alike(balance)}). "
        f"{sum(cell['rare'] for cell in cells)} of {len(cells)} cells are worth fewer than {balance.enough_effective:g} and marked "
        "with * and a dashed border; – is ground of the map that nobody drove. drive-next.geojson holds where to drive for them."
    )
    header, rows = _table(cells, "class", [(cell["class"] or "any",) for cell in cells])
    return Section("Balance of class and slope", text, header=header, rows=rows)


def _by_speed(balance: Balance) -> Section:
    cells = balance.cells
    keys = [(cell["class"] or "any", cell["speed_mps"]) for cell in cells]
    header, rows = _table(cells, "class, speed [m/s]", keys)
    return Section(
        "Balance of class, slope and speed",
        "The same by the velocity that is the label.",
        header=header,
        rows=rows,
        folded=True,
    )


def _table(
    cells: Sequence[CellRow], name: str, keys: Sequence[tuple[str, ...]]
) -> tuple[list[str], list[list[str | Shaded]]]:
    """Return header and rows: one row a key, in order of appearance, one column a range of slope."""
    seen = {cell["slope"] for cell in cells}
    slopes = [slope for slope in SLOPE_NAMES if slope in seen]
    most = max((sum(cell["samples"].values()) for cell in cells), default=0)
    texts = {(key, cell["slope"]): _shaded(cell, most) for key, cell in zip(keys, cells, strict=True)}
    return [name, *slopes], [
        [", ".join(key), *(texts.get((key, slope), "") for slope in slopes)] for key in _in_order(keys)
    ]


def _in_order(keys: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return each key once: classes as they come, which is by id, and under each its ranges of speed, rising."""
    classes = list(dict.fromkeys(key[0] for key in keys))
    return sorted(dict.fromkeys(keys), key=lambda key: (classes.index(key[0]), *map(_lower_end, key[1:])))


def _lower_end(speeds: str) -> tuple[float, bool]:
    words = speeds.split()
    return float(words[-1] if words[0] == "above" else words[0]), words[0] == "above"


def _shaded(row: CellRow, most: int) -> Shaded:
    count = sum(row["samples"].values())
    worth = "" if row["effective"] is None else f" ({row['effective']:.0f})"
    text = f"{count}{worth}{'*' if row['rare'] else ''}" if count else "–"
    return Shaded(text, (count / max(most, 1)) ** 0.5, alarm=row["rare"])


def _alike(balance: Balance) -> str:
    found = [
        f"{_name(label)} over {entry.length_m:.1f} m, {100 * entry.share:.0f} % of its variance"
        for label, entry in balance.correlation.items()
        if entry is not None
    ]
    return "; ".join(found) or "how far cannot be told from so few"


def _repeatability(balance: Balance) -> Section:
    rows = []
    for label, entry in balance.repeatability.items():
        unit = _UNITS[label.rsplit("_", 1)[1]]
        if entry is not None:
            ends = (entry.std_low, entry.std_high)
            interval = "too few places" if None in ends else f"{ends[0]:.3g} to {ends[1]:.3g}"
            rows.append((_name(label), f"{entry.std:.3g} {unit}", interval, entry.pairs, entry.places,
                         f"{100 * (1 - min(entry.share_of_variance, 1.0)):.1f} %"))  # fmt: skip
    text = (
        "Places that were driven again in the same direction: no model can predict a single label better than it repeats itself."
        if rows
        else "No place was driven twice in the same direction; do so to learn how well a label repeats itself."
    )
    header = ("label", "repeats to (standard deviation)", "95 % interval", "pairs", "places", "variance to explain")
    return Section("Repeatability: no model can beat this", text, header=header if rows else (), rows=rows)


def _name(label: str) -> str:
    return label.rsplit("_", 1)[0].replace("_", " ")
