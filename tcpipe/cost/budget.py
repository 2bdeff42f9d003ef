"""The error budget of a set of labels: how large the noise floor is, what makes it, and what a faster power source would leave of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from tcpipe.tables.catalogue import read_threshold
from tcpipe.tables.facts import EnergyBudget
from tcpipe.tables.findings import Finding, Subject, make_finding

CAUSES = ("position", "rate", "current", "voltage")
"""Displacement of both ends; what the current did between samples; noise and rounding of the current; the voltage's."""


def estimate_energy_budget(
    energy_joule: NDArray[np.float64], variance_j2: Mapping[str, NDArray[np.float64]]
) -> EnergyBudget | None:
    """Return the noise floor of E; None without energies.

    Parameters
    ----------
    energy_joule : [J], shape (M,); NaN where there is no label.
    variance_j2 : [J²], shape (M,), by name: the `CAUSES`, which are independent and add up, and ``at_20_hz``.
    """
    known = np.isfinite(energy_joule)
    mean_joule = float(np.abs(energy_joule[known]).mean()) if known.any() else 0.0
    if mean_joule <= 0.0:
        return None
    mean_square = {name: float(values[known].mean()) for name, values in variance_j2.items()}
    total = sum(mean_square[cause] for cause in CAUSES)
    shares = {name: float(np.sqrt(value)) / mean_joule for name, value in {"total": total, **mean_square}.items()}
    return EnergyBudget(int(known.sum()), mean_joule, **shares)


def pool_budgets(budgets: Iterable[EnergyBudget | None]) -> EnergyBudget | None:
    """Return the budget of several sets of segments together; None of none."""
    known = [asdict(budget) for budget in budgets if budget is not None]
    count = sum(each["segments"] for each in known)
    if not count:
        return None
    mean_joule = sum(each["segments"] * each["mean_energy_joule"] for each in known) / count
    squares = {
        name: sum(each["segments"] * (each[name] * each["mean_energy_joule"]) ** 2 for each in known) / count
        for name in ("total", *CAUSES, "at_20_hz")
    }
    return EnergyBudget(
        count, mean_joule, **{name: float(np.sqrt(square)) / mean_joule for name, square in squares.items()}
    )


def find_noise(budget: EnergyBudget | None, subject: Subject) -> tuple[Finding, ...]:
    """Return the finding that the noise floor of E is high."""
    if budget is None or budget.total < read_threshold("energy-noise", "max_total_fraction"):
        return ()
    numbers = {f"{name}_fraction": getattr(budget, name) for name in ("total", *CAUSES, "at_20_hz")}
    return (make_finding("energy-noise", subject, **numbers),)


def format_budget(budget: EnergyBudget) -> str:
    """Return the budget as a sentence: the floor, its causes from the largest, and what power at 20 Hz would leave where that is less."""
    names = {"position": "position", "rate": "power rate", "current": "current noise", "voltage": "voltage"}
    shares = {cause: getattr(budget, cause) for cause in CAUSES}
    causes = ", ".join(
        f"{names[cause]} {100 * shares[cause]:.1f}" for cause in sorted(CAUSES, key=lambda c: -shares[c])
    )
    floor = f"Noise floor of E {100 * budget.total:.1f} % of a segment's mean {budget.mean_energy_joule:.0f} J"
    text = f"{floor}: {causes} (they add in square)"
    if budget.at_20_hz < 0.95 * budget.total:
        text += f"; power at 20 Hz would leave {100 * budget.at_20_hz:.1f} %"
    return text + "."
