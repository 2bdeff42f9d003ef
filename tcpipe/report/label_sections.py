"""Sections on labels: losses, quality bits, error budget, physics of the robot, repeatability."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from tcpipe.arrays import AnyInts
from tcpipe.formats.finding_lines import advise_on_loss, format_budget
from tcpipe.motion.distance_breakdown import find_largest_losses
from tcpipe.report.page import PageSection
from tcpipe.report.plots import draw_waterfall
from tcpipe.tables.bits import Quality, flag_name
from tcpipe.tables.facts import EnergyBudget, Floor, PhysicsFit, PhysicsTerm

LABELS = {
    "power": ("power_watt", "power_std_watt", 1),
    "velocity": ("velocity_mps", "velocity_std_mps", 4),
    "duration": ("duration_s", "duration_std_s", 4),
    "energy": ("energy_joule", "energy_std_joule", 1),
    "slip": ("slip_fraction", "slip_std_fraction", 4),
    "vibration": ("vibration_mps2", "vibration_std_mps2", 3),
}
"""Column, column of the standard deviation and decimals of each label on a page."""

QUALITY_WORDS = {
    Quality.LOW_POWER_RATE: "power was sampled too slowly",
    Quality.NEAR_GAP: "a gap in the data is within one chord",
    Quality.HIGH_SLIP: "wheels and ground differ by more than 20 %",
    Quality.WEAK_GNSS: "position is uncertain",
    Quality.CURVED: "the path bends",
    Quality.POWER_MEAN_MISMATCH: "mean power and energy over time differ by more than 5 %",
    Quality.NO_COMMAND: "no command: full speed is unverified",
    Quality.VOLTAGE_OUT_OF_RANGE: "voltage leaves the robot's range",
    Quality.CLOCK_DOUBTFUL: "a clock is uncertain",
    Quality.BELOW_FULL_SPEED: "commanded below full speed",
    Quality.SENSORS_DISAGREE: "sensors disagree",
    Quality.UNPOWERED: "the robot moves with its idle power",
    Quality.MAP_CONTRADICTS_TRACK: "slope or heights of the map differ from the track",
}
"""Meaning of each bit."""


def make_losses_sections(ledgers_m: Sequence[Mapping[str, float]], text: str, *, names_runs: bool) -> list[PageSection]:
    """Return the largest losses of distance of runs with their remedies; none without a run."""
    if not ledgers_m:
        return []
    rows = [
        (
            loss.reason.replace("_", " "),
            f"{loss.metres:.{0 if names_runs else 1}f}",
            f"{100 * loss.share:.1f} %",
            *([loss.runs] if names_runs else []),
            advise_on_loss(loss.reason),
        )
        for loss in find_largest_losses(ledgers_m)
    ]
    header = ("lost to", "metres", "of all", *(["runs"] if names_runs else []), "remedy")
    total_m = Counter[str]()
    for distance_by_reason_m in ledgers_m:
        total_m.update(distance_by_reason_m)
    return [PageSection("Distance breakdown", text, header=header, rows=rows, plots=[draw_waterfall(total_m)])]


def find_distinguishing_bits(bits: AnyInts) -> int:
    """Return the quality bits that some but not all labels have; only these are useful on a map."""
    bits = bits.astype(np.int64)
    return int(np.bitwise_or.reduce(bits, initial=0) & ~np.bitwise_and.reduce(bits)) if len(bits) else 0


def make_quality_section(bits: AnyInts, noun: str) -> PageSection:
    """Return how many labels carry each quality bit."""
    counts = {flag_name(bit).replace("_", " "): int(((bits & int(bit)) != 0).sum()) for bit in Quality}
    rows = [item for item in counts.items() if item[1]]
    if not rows:
        return PageSection("Quality flags", f"None: all {noun} are clean.")
    text = "A label may have several flags; docs/reference/columns.md explains them."
    return PageSection("Quality flags", text, header=("flag", noun), rows=rows)


_BUDGET_ROWS = {
    "position": "position of both ends",
    "rate": "variation of the current between samples",
    "current": "noise and rounding of the current",
    "voltage": "voltage",
    "total": "all together",
    "at_20_hz": "all together, with power at 20 Hz",
    "common": "one error of the whole run: power sensor, scale of a lone odometry (apart)",
    "delay": "delay of power against the motion (apart)",
}


def make_budget_sections(budget: EnergyBudget | None) -> list[PageSection]:
    """Return the section on the noise floor of E; none if no segment has an energy."""
    if budget is None:
        return []
    shares = {text: getattr(budget, name) for name, text in _BUDGET_ROWS.items()}
    rows = [(text, f"{100 * share:.2f} %") for text, share in shares.items()]
    title = "Uncertainty of labels"
    return [PageSection(title, format_budget(budget), header=("from", "of E"), rows=rows)]


_ASIDE = {"grade": "weight over efficiency"}


def describe_physics(robot: str, fit: PhysicsFit) -> str:
    """Return the fit as a few sentences: the most wanted numbers first, each with its standard deviation."""
    grounds = list(dict.fromkeys(term.terrain for term in fit.terms if term.term in {"rolling", "turning"}))
    values = {(term.term, term.terrain): term for term in fit.terms}
    everywhere = [
        f"{_format_with_std(term)} {term.unit} {_ASIDE.get(term.term, term.term)}"
        for term in fit.terms
        if term.term not in {"rolling", "turning"}
    ]
    parts_of_text = [", ".join((f"{robot}: {everywhere[0]}", *everywhere[1:]) if everywhere else (f"{robot}",))]
    for ground in grounds:
        parts = []
        if ground in fit.rolling_resistance:
            value, std = fit.rolling_resistance[ground]
            parts.append(f"C_rr {value:.3f} ± {std:.3f}")
        elif (rolling := values.get(("rolling", ground))) is not None:
            parts.append(f"rolling {_format_with_std(rolling)} N")
        if (turning := values.get(("turning", ground))) is not None:
            parts.append(f"{_format_with_std(turning)} W per rad/s of turning")
        parts_of_text.append(f"on {'all ground' if ground == 'all' else ground}: {', '.join(parts)}")
    share = ", ".join(f"{name} {100.0 * part:.0f} %" for name, part in fit.energy_share.items())
    text = f"{'; '.join(parts_of_text)}. Of all energy: {share} ({fit.segments} segments)."
    if fit.held_out is not None:
        text += f" On held-out fifths it explains {fit.held_out.r2:.2f} of the variance of E (R²), "
        text += f"mean error {100 * fit.held_out.mape:.0f} % where it is 10 J and more."
    return text


def _format_with_std(term: PhysicsTerm) -> str:
    digits = 0 if term.std >= 1.0 else 1
    return f"{term.value:.{digits}f} ± {term.std:.{digits}f}"


def make_physics_sections(fits: Mapping[str, PhysicsFit]) -> list[PageSection]:
    """Return the section on the fits by robot, if any."""
    text = " ".join(describe_physics(robot, fit) for robot, fit in fits.items())
    return [PageSection("Power by cause: idle, drivetrain, rolling, grade, turning", text)] if fits else []


_UNITS = {"watt": "W", "mps": "m/s", "s": "s", "joule": "J"}


def make_repeatability_section(repeatability: Mapping[str, Floor | None]) -> PageSection:
    """Return the repeatability of labels, the lower bound of model errors."""
    rows = []
    for label, entry in repeatability.items():
        unit = _UNITS[label.rsplit("_", 1)[1]]
        if entry is not None:
            ends = (entry.std_low, entry.std_high)
            interval = "too few places" if None in ends else f"{ends[0]:.3g} to {ends[1]:.3g}"
            rows.append((label.rsplit("_", 1)[0].replace("_", " "), f"{entry.std:.3g} {unit}", interval, entry.pairs, entry.places,
                         f"{100 * (1 - min(entry.share_of_variance, 1.0)):.1f} %"))  # fmt: skip
    text = (
        "Places that were driven twice in the same direction: this variation limits the accuracy of every model."
        if rows
        else "No place was driven twice in the same direction; drive some ground twice to measure the repeatability of labels."
    )
    header = ("label", "repeatability (σ)", "95 % interval", "pairs", "places", "variance to explain")
    return PageSection("Repeatability: lower bound of model errors", text, header=header if rows else (), rows=rows)
