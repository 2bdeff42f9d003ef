"""Sections on labels: quality bits, error budget, physics of the robot, and how samples are spread over ground, slope and speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tcpipe.balance.cells import SLOPE_NAMES
from tcpipe.cost.labels import format_budget
from tcpipe.formats.dataset_card import Balance, CellRow
from tcpipe.report.page import Section, Shaded
from tcpipe.tables.bits import Quality, flag_name
from tcpipe.tables.facts import EnergyBudget, PhysicsFit, PhysicsTerm

QUALITY_WORDS = {
    Quality.LOW_POWER_RATE: "power was sampled too slowly",
    Quality.NEAR_GAP: "a gap in the data is less than a chord away",
    Quality.HIGH_SLIP: "wheels and ground differ by more than 20 %",
    Quality.WEAK_GNSS: "position is uncertain",
    Quality.CURVED: "the path bends",
    Quality.MEAN_POWER_DIFFERS: "mean power and energy over time differ by more than 5 %",
    Quality.NO_COMMAND: "no command topic: full speed is not proved",
    Quality.VOLTAGE_OUT_OF_RANGE: "voltage leaves the robot's range",
    Quality.CLOCK_DOUBTFUL: "a clock is doubtful",
    Quality.PHYSICS_OUTLIER: "power is far from what physics predicts",
    Quality.NOT_AT_LIMIT: "commanded below full speed",
    Quality.SENSORS_DISAGREE: "sensors disagree",
}
"""What a bit says, in words."""


def make_quality_sections(counts: Mapping[str, int], of_what: str) -> list[Section]:
    """Return the table of the bits that any label carries; ``counts`` are by the bit's name."""
    rows = [(flag_name(bit).replace("_", " "), count) for bit in Quality if (count := counts.get(flag_name(bit), 0))]
    if not rows:
        return [Section("Quality flags", f"None: all {of_what} are clean.")] if counts else []
    return [
        Section(
            "Quality flags",
            "A label may carry several; docs/reference/columns.md says what each means.",
            header=("flag", of_what),
            rows=rows,
        )
    ]


_ROWS = {
    "position": "position of both ends",
    "rate": "what the current did between two samples",
    "current": "noise and rounding of the current",
    "voltage": "voltage",
    "total": "all together",
    "at_20_hz": "all together, with power at 20 Hz",
}


def make_budget_sections(budget: EnergyBudget | None) -> list[Section]:
    """Return the section on the noise floor of E; none where no segment has an energy."""
    if budget is None:
        return []
    rows = [(text, f"{100 * getattr(budget, name):.2f} %") for name, text in _ROWS.items()]
    return [
        Section("How wrong a label may be", format_budget(budget), header=("from", "of E"), rows=rows, figures_from=1)
    ]


_ASIDE = {"grade": "weight over efficiency"}


def describe_physics(robot: str, fit: PhysicsFit) -> str:
    """Return the fit as a few sentences: the numbers that a roboticist wants first, each with its standard deviation."""
    grounds = list(dict.fromkeys(of.terrain for of in fit.terms if of.term in {"rolling", "turning"}))
    values = {(of.term, of.terrain): of for of in fit.terms}
    everywhere = [
        f"{_format_with_std(of)} {of.unit} {_ASIDE.get(of.term, of.term)}"
        for of in fit.terms
        if of.term not in {"rolling", "turning"}
    ]
    said = [", ".join((f"{robot}: {everywhere[0]}", *everywhere[1:]) if everywhere else (f"{robot}",))]
    for ground in grounds:
        parts = []
        if ground in fit.rolling_resistance:
            value, std = fit.rolling_resistance[ground]
            parts.append(f"C_rr {value:.3f} ± {std:.3f}")
        elif (rolling := values.get(("rolling", ground))) is not None:
            parts.append(f"rolling {_format_with_std(rolling)} N")
        if (turning := values.get(("turning", ground))) is not None:
            parts.append(f"{_format_with_std(turning)} W per rad/s of turning")
        said.append(f"on {'all ground' if ground == 'all' else ground}: {', '.join(parts)}")
    share = ", ".join(f"{name} {100.0 * part:.0f} %" for name, part in fit.energy_share.items())
    text = f"{'; '.join(said)}. Of all energy: {share} ({fit.segments} segments)."
    if fit.held_out is not None:
        text += f" On held-out fifths it explains {fit.held_out.r2:.2f} of the variance of E (R²), "
        text += f"mean error {100 * fit.held_out.mape:.0f} % where it is 10 J and more"
        if fit.without_turning is not None and fit.gain_of_turning is not None:
            low, high = (round(gain, 2) + 0.0 for gain in fit.gain_of_turning)  # no -0.00
            without = f"{fit.without_turning.r2:.2f} and {100 * fit.without_turning.mape:.0f} %"
            text += f"; without turning {without} (R² by turning {low:+.2f} to {high:+.2f}, 90 %)"
        text += "."
    return text


def _format_with_std(of: PhysicsTerm) -> str:
    digits = 0 if of.std >= 1.0 else 1
    return f"{of.value:.{digits}f} ± {of.std:.{digits}f}"


def make_physics_sections(fits: dict[str, PhysicsFit]) -> list[Section]:
    """Return a section of the fits by robot; none where there are none."""
    text = " ".join(describe_physics(robot, fit) for robot, fit in fits.items())
    return [Section("What a metre costs: standing, drivetrain, rolling, grade, turning", text)] if fits else []


_UNITS = {"watt": "W", "mps": "m/s", "s": "s", "joule": "J"}


def balance_sections(balance: Balance) -> list[Section]:
    """Return the sections."""
    return [_make_class_section(balance), _make_speed_section(balance), _make_repeatability_section(balance)]


def _make_class_section(balance: Balance) -> Section:
    cells = balance.by_class_and_slope
    text = (
        f"Samples, and in brackets how many independent ones they are worth: neighbours are alike ({_format_correlation(balance)}). "
        f"{sum(cell['rare'] for cell in cells)} of {len(cells)} cells are worth fewer than {balance.enough_effective:g} and marked "
        "with * and a dashed border; – is ground of the map that nobody drove. drive-next.geojson holds where to drive for them."
    )
    header, rows = _table(cells, "class", [(cell["class"] or "any",) for cell in cells])
    return Section("Balance of class and slope", text, header=header, rows=rows)


def _make_speed_section(balance: Balance) -> Section:
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
        [", ".join(key), *(texts.get((key, slope), "") for slope in slopes)] for key in _sort_keys(keys)
    ]


def _sort_keys(keys: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
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


def _format_correlation(balance: Balance) -> str:
    found = [
        f"{_name(label)} over {entry.length_m:.1f} m, {100 * entry.share:.0f} % of its variance"
        for label, entry in balance.correlation.items()
        if entry is not None
    ]
    return "; ".join(found) or "how far cannot be told from so few"


def _make_repeatability_section(balance: Balance) -> Section:
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
