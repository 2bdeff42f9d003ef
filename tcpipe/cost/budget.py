"""The error budget of a set of labels: how large the noise floor is, what makes it, and what a faster power source would leave of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

CAUSES = ("position", "rate", "current", "voltage")
"""Displacement of both ends; what the current did between samples; noise and rounding of the current; the voltage's."""


def energy_budget(
    energy_joule: NDArray[np.float64], variance_j2: Mapping[str, NDArray[np.float64]]
) -> dict[str, Any] | None:
    """Return the noise floor of E as shares of the mean energy, [1], root mean square over segments; None without energies.

    Parameters
    ----------
    energy_joule : [J], shape (M,); NaN where there is no label.
    variance_j2 : [J²], shape (M,), by name; the `CAUSES` are independent and add up, other names are told beside them.
    """
    known = np.isfinite(energy_joule)
    mean_joule = float(np.abs(energy_joule[known]).mean()) if known.any() else 0.0
    if mean_joule <= 0.0:
        return None
    mean_square = {name: float(values[known].mean()) for name, values in variance_j2.items()}
    total = sum(mean_square[cause] for cause in CAUSES)
    return {
        "segments": int(known.sum()),
        "mean_energy_joule": mean_joule,
        "total": float(np.sqrt(total)) / mean_joule,
        **{name: float(np.sqrt(value)) / mean_joule for name, value in mean_square.items()},
    }


def pooled(budgets: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Return the budget of several sets of segments together; None of none."""
    count = sum(each["segments"] for each in budgets)
    if not count:
        return None
    mean_joule = sum(each["segments"] * each["mean_energy_joule"] for each in budgets) / count
    shares = [name for name in budgets[0] if name not in {"segments", "mean_energy_joule"}]
    squares = {
        name: sum(each["segments"] * (each[name] * each["mean_energy_joule"]) ** 2 for each in budgets) / count
        for name in shares
    }
    return {
        "segments": count,
        "mean_energy_joule": mean_joule,
        **{name: float(np.sqrt(square)) / mean_joule for name, square in squares.items()},
    }


def in_words(budget: Mapping[str, Any]) -> str:
    """Return the budget as a sentence: the floor, its causes from the largest, and what power at 20 Hz would leave where that is less."""
    names = {"position": "position", "rate": "power rate", "current": "current noise", "voltage": "voltage"}
    ordered = sorted(CAUSES, key=lambda cause: -budget[cause])
    causes = ", ".join(f"{names[cause]} {100 * budget[cause]:.1f}" for cause in ordered)
    floor = f"Noise floor of E {100 * budget['total']:.1f} % of a segment's mean {budget['mean_energy_joule']:.0f} J"
    text = f"{floor}: {causes} (they add in square)"
    if budget["at_20_hz"] < 0.95 * budget["total"]:
        text += f"; power at 20 Hz would leave {100 * budget['at_20_hz']:.1f} %"
    return text + "."
