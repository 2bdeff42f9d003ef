"""How well physics predicts metres that it was not fitted on, and what its terms are worth: blocks of a drive held out in turn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.cost.physics import FEWEST, FitSamples, fit_physics
from tcpipe.tables.facts import PhysicsFit, PhysicsScore, PhysicsTerm

Floats = NDArray[np.float64]

_FOLDS = 5  # contiguous: neighbours of a held-out metre are held out, too
_BLOCK = 10  # consecutive segments that are drawn together
_DRAWS = 2000
_SEED = 20260101
_LEAST_JPM = 10.0  # a percentage of less says nothing, as in `tcpipe.learning.metrics`
PHYSICS_UNITS = {"idle": "W", "drivetrain": "N", "rolling": "N", "grade": "N", "turning": "W s/rad"}
"""Of the terms of physics."""


@dataclass(frozen=True, slots=True)
class _HeldOut:
    """Energy a metre of known metres [J/m], and what fits on the other folds say of it, shape (M,)."""

    true: Floats
    said: Floats


def fit_and_validate_physics(metres: FitSamples, *, idle_watt: float | None) -> PhysicsFit | None:
    """Fit a robot's metres, in the order of driving; None where nothing can be fitted, or no robot can be so.

    Parameters
    ----------
    metres : of one robot.
    idle_watt : power while standing, None where the robot never stood.
    """
    found = fit_physics(metres, idle_watt=idle_watt)
    if found is None or not found.is_plausible():
        return None
    known = metres.take(np.isfinite(metres.power_watt + metres.velocity_mps + metres.rise))
    parts = found.parts_watt(known) / known.velocity_mps[:, None]
    kinds = list(dict.fromkeys(term for term, _ in found.terms))
    whole = float(np.nansum(known.power_watt / known.velocity_mps))
    share = {kind: float(np.nansum(parts[:, [term == kind for term, _ in found.terms]])) / whole for kind in kinds}
    scored = _predict_held_out(known, idle_watt, turning=True)
    without = _predict_held_out(known, idle_watt, turning=False) if "turning" in kinds else None
    return PhysicsFit(
        segments=found.segments,
        terms=tuple(
            PhysicsTerm(term, terrain, value, np.sqrt(found.covariance[at, at]).item(), PHYSICS_UNITS[term])
            for at, ((term, terrain), value) in enumerate(zip(found.terms, found.value.tolist(), strict=True))
        ),
        rolling_resistance={
            name: (of[0], of[1])
            for term, name in found.terms
            if term == "rolling" and (of := found.rolling_resistance(name)) is not None
        },
        recovered_downhill=found.recovered,
        residual_watt=found.residual_watt,
        energy_share=share,
        held_out=None if scored is None else _score(scored),
        without_turning=None if without is None else _score(without),
        mean_turn_radpm=_compute_mean_turn(known),
        gain_of_turning=_compare_held_out(scored, without),
    )


def _compute_mean_turn(metres: FitSamples) -> float:
    """Return how far a metre turns in the mean [rad/m]; 0 where no rate is known."""
    turned = metres.mean_abs_yaw_rate_radps / metres.velocity_mps
    return float(turned[np.isfinite(turned)].mean()) if np.isfinite(turned).any() else 0.0


def _predict_held_out(metres: FitSamples, idle_watt: float | None, *, turning: bool) -> _HeldOut | None:
    """Return energies of every fifth of the drive by a fit on the others; None where too few are left to fit."""
    count = len(metres.power_watt)
    fold = np.arange(count) * _FOLDS // max(count, 1)
    said = np.full(count, np.nan)
    for number in range(_FOLDS):
        mine = fold == number
        found = fit_physics(metres.take(~mine), idle_watt=idle_watt, turning=turning)
        if found is None or mine.sum() < FEWEST // _FOLDS:
            return None
        here = metres.take(mine)
        said[mine] = found.power_watt(here) / here.velocity_mps
    true = metres.power_watt / metres.velocity_mps
    told = np.isfinite(true + said)
    return _HeldOut(true[told], said[told])


def _score(held: _HeldOut) -> PhysicsScore:
    off = held.true - held.said
    spread = float(np.square(held.true - held.true.mean()).sum())
    r2 = 1.0 - float(np.square(off).sum()) / spread if spread > 0.0 else 0.0
    enough = np.abs(held.true) >= _LEAST_JPM
    counted = enough if enough.any() else held.true != 0.0
    return PhysicsScore(r2, float(np.mean(np.abs(off[counted] / held.true[counted]))) if counted.any() else 0.0)


def _compare_held_out(scored: _HeldOut | None, without: _HeldOut | None) -> tuple[float, float] | None:
    """Return the 90 % interval of how much R² rises by turning: blocks of consecutive metres drawn again (Künsch 1989)."""
    if scored is None or without is None or len(scored.true) != len(without.true):
        return None
    starts = np.arange(0, len(scored.true), _BLOCK)
    better = np.add.reduceat(np.square(without.true - without.said) - np.square(scored.true - scored.said), starts)
    spread = np.add.reduceat(np.square(scored.true - scored.true.mean()), starts)
    rng, gain = np.random.default_rng(_SEED), np.empty(_DRAWS)
    for turn in range(_DRAWS):  # one after the other: all at once are 3 kB a metre
        drawn = rng.integers(0, len(starts), len(starts))
        gain[turn] = better[drawn].sum() / max(spread[drawn].sum(), 1e-12)
    low, high = np.quantile(gain, [0.05, 0.95]).tolist()
    return low, high
