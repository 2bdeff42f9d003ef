"""Physics model of power fitted to labels (idle, drivetrain, rolling, grade, turning), and its held-out error.

On a slope that rises by tan(s) a robot of weight m g at horizontal speed v does the mechanical work

    m g v (c + tan(s))               (rolling resistance m g c cos(s), grade m g sin(s), along the surface)

a second, and a skid-steered one drags its wheels sideways with a torque that hardly depends on the yaw rate. The drive
needs 1 / efficiency of both, and gives back a share of negative work (the slope drives the wheels)::

    P = P0 + D v / cos(s) + g(F v + N v tan(s) + M |yaw rate|),   g(x) = x for x > 0, k x for x < 0

P0 is the idle power, D [N] the loss of turning motors and gears, on any grade, per metre along the surface (for rolling
the cosine cancels), N = m g / efficiency [N]; F = N c [N] and M [W per rad/s] belong to a terrain class, or to all
ground without classes. None is negative. The onset of downhill driving distinguishes D from F, and D is a term only
where it is observed; else F includes it. They are fitted to the force P / v with Huber's weights (Huber 1964; k =
1.345), so that a minority of outliers has little effect. Their standard deviations account for correlated neighbours
(White's sandwich over blocks of consecutive segments; Cameron and Miller, J. Human Resources 50, 2015).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls

from tcpipe.arrays import Floats, Ints, Mask, Texts
from tcpipe.robust import estimate_robust_std
from tcpipe.tables.facts import PhysicsFit, PhysicsScore, PhysicsTerm

FEWEST = 20  # segments for a fit, and for coefficients of a class
_LEAST_SLOPE = 0.02  # standard deviation of the rises; on flatter ground weight and rolling are not observable
_LEAST_SPEED = 0.1  # variation of speed over its median; with less, idle power and rolling are not observable
_LEAST_TURNS = (
    5.0  # variance of a class's turns, in metres of the variance of all; with less its turning is not observable
)
_IDLE_STD = 0.005  # relative standard deviation of the measured idle power; with a larger one it would absorb rolling
_LEAST_IDLE_STD_WATT = 0.1  # smallest standard deviation of the idle power [W]
_FEWEST_DOWNHILL = 10  # segments that drive the robot, for the recovered share
_MOST_RECOVERED = 0.9  # share above which power has no bend downhill, so that the drivetrain is not observable
_BEND = 0.1  # distance of a rise from the bend below which a metre weighs less, since slope varies within a metre
_STEPS = 100  # reweightings at most
_HUBER = 1.345  # 95 % efficient for normal errors (Huber, Robust Statistics, 1981)
_FINEST = 0.02  # smallest residual standard deviation over the median power
_PLAUSIBLE_RESISTANCE = 1.5  # largest coefficient of rolling resistance: tracks in deep sand are below
_BLOCK, _FEWEST_BLOCKS = 20, 20  # segments of a block with correlated errors, and fewest blocks
_MOST_ROWS = (
    20_000  # rows of a fit, evenly selected from more; its coefficients have relative errors of a few per mille
)

_FOLDS = 5  # contiguous parts of a drive, so that neighbours of a held-out metre are held out too
_LEAST_JPM = 10.0  # smallest energy in a mean relative error [J/m], as in `tcpipe.learning.metrics`

_ALWAYS = ("idle", "drivetrain")  # terms that cost power on any grade and are never recovered

PHYSICS_UNITS = {"idle": "W", "drivetrain": "N", "rolling": "N", "grade": "N", "turning": "W s/rad"}
"""Units of the terms of physics."""

ALL = "all"
"""Name of the ground of a fit without classes, and of classes with too few segments."""


@dataclass(frozen=True, slots=True)
class FitSamples:
    """Labelled metres, all of shape (M,), in the order of driving.

    Attributes
    ----------
    power_watt, velocity_mps, rise : labels [W], horizontal speeds [m/s], tan of the slopes.
    mean_abs_yaw_rate_radps : mean of |yaw rate| [rad/s].
    terrain : names of their classes.
    """

    power_watt: Floats
    velocity_mps: Floats
    rise: Floats
    mean_abs_yaw_rate_radps: Floats
    terrain: Texts

    def take(self, rows: Ints | Mask) -> FitSamples:
        """Return the samples in ``rows``."""
        return FitSamples(*(getattr(self, name)[rows] for name in self.__slots__))


@dataclass(frozen=True, slots=True)
class Physics:
    """Fit of the physics model.

    Attributes
    ----------
    terms : term and class of each coefficient (idle, drivetrain, rolling, grade or turning; terrain class or
        `ALL`), J of them.
    value : P0 [W], D [N], F [N], N [N], M [W per rad/s], shape (J,).
    covariance : of the values, shape (J, J); 0 if a coefficient is bounded at zero.
    recovered : k, share of downhill work that comes back; 0 unless steep downhill segments determine it.
    residual_watt : robust standard deviation of the residuals [W], at least 2 % of the power.
    segments : number of fitted segments.
    """

    terms: tuple[tuple[str, str], ...]
    value: Floats
    covariance: Floats
    recovered: float
    residual_watt: float
    segments: int

    def of(self, term: str, terrain: str = ALL) -> tuple[float, float] | None:
        """Return a coefficient and its standard deviation, of all ground if the class has none; None without either."""
        if (term, terrain) in self.terms:
            at = self.terms.index((term, terrain))
            return float(self.value[at]), float(np.sqrt(self.covariance[at, at]))
        return None if terrain == ALL else self.of(term)

    def rolling_resistance(self, terrain: str = ALL) -> tuple[float, float] | None:
        """Return c = F / N of a class with its standard deviation; None if the slopes do not vary."""
        places = [self.terms.index(key) for key in (("rolling", terrain), ("grade", ALL)) if key in self.terms]
        if len(places) < 2 or self.value[places[1]] <= 0.0:
            return None
        rolling, grade = self.value[places].tolist()
        slope = np.array([1.0 / grade, -rolling / grade**2])
        return rolling / grade, float(np.sqrt(slope @ self.covariance[np.ix_(places, places)] @ slope))

    def is_driven(self, metres: FitSamples) -> Mask:
        """Return where motors, not the slope, drive the robot, shape (M,)."""
        always = _always(self.terms)
        return _build_design_matrix(metres, self.terms)[:, ~always] @ self.value[~always] > 0.0

    def parts_watt(self, metres: FitSamples) -> Floats:
        """Return the part of each coefficient in the predicted power [W], shape (M, J)."""
        gain = np.where(_always(self.terms) | self.is_driven(metres)[:, None], 1.0, self.recovered)
        return _build_design_matrix(metres, self.terms) * gain * self.value

    def power_watt(self, metres: FitSamples) -> Floats:
        """Return the predicted power [W], shape (M,)."""
        return np.asarray(self.parts_watt(metres).sum(axis=1))

    def is_plausible(self) -> bool:
        """Return whether the fit is possible: rolling and climbing cost power, at most as tracks in sand."""
        rolling = [at for at, (term, _) in enumerate(self.terms) if term in {"rolling", "drivetrain"}]
        resistances = [self.rolling_resistance(name) for term, name in self.terms if term == "rolling"]
        climb = self.of("grade")
        return bool(self.value[rolling].max() > 0.0 and (climb is None or climb[0] > 0.0)) and all(
            resistance is None or resistance[0] < _PLAUSIBLE_RESISTANCE for resistance in resistances
        )


def fit_physics(metres: FitSamples, *, idle_watt: float | None = None) -> Physics | None:
    """Fit the terms to labels; None for fewer than 20.

    Parameters
    ----------
    metres : rows with NaN are left out; without any turn rate there is no term for it.
    idle_watt : idle power, measured while stationary; None: fit it if the speeds vary enough.
    """
    turning = bool(np.isfinite(metres.mean_abs_yaw_rate_radps).any())
    known = metres.power_watt + metres.velocity_mps + metres.rise + (metres.mean_abs_yaw_rate_radps if turning else 0.0)
    rows = np.flatnonzero(np.isfinite(known) & (metres.velocity_mps > 0.0))
    if rows.size < FEWEST:
        return None
    used = metres.take(rows[:: -(-rows.size // _MOST_ROWS)])
    terms = _list_determined_terms(used, idle_watt=idle_watt, turning=turning)
    found = _fit_robustly(used, terms, idle_watt)
    for term in ("drivetrain", "idle"):
        if not _is_significant(found, term, used) and not (term == "idle" and idle_watt is not None):
            terms = [known for known in terms if known[0] != term]
            found = _fit_robustly(used, terms, idle_watt)
    residual_watt = used.power_watt - found.power_watt(used)
    spread = estimate_robust_std(residual_watt - np.median(residual_watt))
    return replace(
        found, residual_watt=max(spread, _FINEST * float(np.median(np.abs(used.power_watt)))), segments=rows.size
    )


def _is_significant(found: Physics, term: str, metres: FitSamples) -> bool:
    """Return whether a term is significant; otherwise rolling includes it."""
    value, std = found.of(term) or (np.inf, 0.0)
    bend = (~found.is_driven(metres)).sum() >= _FEWEST_DOWNHILL and found.recovered < _MOST_RECOVERED
    return bool(value > 2.0 * std and (bend or term != "drivetrain"))


def _always(terms: Sequence[tuple[str, str]]) -> Mask:
    return np.array([term in _ALWAYS for term, _ in terms])


def _list_determined_terms(metres: FitSamples, *, idle_watt: float | None, turning: bool) -> list[tuple[str, str]]:
    """Return the coefficients that these segments determine."""
    names, counts = np.unique(metres.terrain, return_counts=True)
    own = [str(name) for name, count in zip(names, counts, strict=True) if count >= FEWEST and name != ALL]
    classes = own if len(own) == len(names) else [*own, ALL]
    spread = float(np.std(metres.velocity_mps)) > _LEAST_SPEED * float(np.median(metres.velocity_mps))
    terms = [("idle", ALL)] if idle_watt is not None or spread else []
    hilly = float(np.std(metres.rise)) >= _LEAST_SLOPE
    terms += [("drivetrain", ALL)] if hilly else []
    terms += [("rolling", name) for name in classes]
    terms += [("grade", ALL)] if hilly else []
    if not turning:
        return terms
    groups = {name: metres.mean_abs_yaw_rate_radps[metres.terrain == name] for name in own}
    groups |= {ALL: metres.mean_abs_yaw_rate_radps[~np.isin(metres.terrain, own)]} if ALL in classes else {}
    least = _LEAST_TURNS * float(np.var(metres.mean_abs_yaw_rate_radps))
    return terms + [("turning", name) for name, rates in groups.items() if rates.size * np.var(rates) >= least]


def _build_design_matrix(metres: FitSamples, terms: Sequence[tuple[str, str]]) -> Floats:
    """Return the factors of the coefficients, shape (M, J)."""
    properties = {
        "idle": np.ones_like(metres.velocity_mps),
        "drivetrain": metres.velocity_mps * np.sqrt(1.0 + metres.rise**2),  # wheels run along the surface
        "rolling": metres.velocity_mps,
        "grade": metres.velocity_mps * metres.rise,
        "turning": metres.mean_abs_yaw_rate_radps,
    }
    own = {term: [name for kind, name in terms if kind == term and name != ALL] for term in properties}
    columns = [
        properties[term] * (metres.terrain == name if name != ALL else ~np.isin(metres.terrain, own[term]))
        for term, name in terms
    ]
    return np.column_stack(columns)


def _fit_robustly(metres: FitSamples, terms: Sequence[tuple[str, str]], idle_watt: float | None) -> Physics:
    """Return coefficients by iteratively reweighted least squares on the force P / v; the idle power adds one row.

    On downhill segments force is a product of k and coefficients: each step solves for both by its tangent
    (Gauss-Newton).
    """
    always, count = _always(terms), len(terms)
    design = _build_design_matrix(metres, terms) / metres.velocity_mps[:, None]
    force = metres.power_watt / metres.velocity_mps
    value, recovered = np.zeros(count), 0.0
    prior = None if idle_watt is None else np.zeros(count + 1)
    if prior is not None and idle_watt is not None:
        prior[terms.index(("idle", ALL))] = 1.0 / max(_IDLE_STD * idle_watt, _LEAST_IDLE_STD_WATT)
    made, off, weight, scale = design, force, np.ones_like(force), 1.0
    for _ in range(_STEPS):
        wanted = design[:, ~always] @ value[~always]
        traction, clear = np.minimum(wanted, 0.0), np.ones_like(force)
        driven = traction == 0.0
        if (~driven).sum() < _FEWEST_DOWNHILL:
            traction, recovered = np.zeros_like(force), 0.0
        elif ("drivetrain", ALL) in terms:  # which hangs on the bend; without it the others would lose
            clear = np.minimum(1.0, np.abs(wanted) / max(_BEND * value[terms.index(("grade", ALL))], 1e-9)) ** 2
        made = np.column_stack([np.where(always | driven[:, None], design, recovered * design), traction])
        off = force - made[:, :count] @ value
        scale = max(estimate_robust_std(off), 1e-9)
        weight = clear * np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(off), 1e-12))
        by = made * np.sqrt(weight)[:, None] / scale
        target = (force + recovered * traction) * np.sqrt(weight) / scale
        if prior is not None and idle_watt is not None:
            by, target = np.vstack([by, prior]), np.append(target, prior.max() * idle_watt)
        q, r = np.linalg.qr(by)
        before, found = value, _fit_non_negative(r, q.T @ target)
        value, recovered = found[:count], min(float(found[count]), 1.0)
        if np.abs(value - before).max() < 1e-7 * np.abs(value).max():
            break
    free = np.append(value > 0.0, 0.0 < recovered < 1.0)
    covariance = _estimate_covariance(made, off, weight, scale, free=free, prior=prior)[:count, :count]
    return Physics(tuple(terms), value, covariance, recovered, 0.0, len(force))


def _fit_non_negative(made: Floats, target: Floats) -> Floats:
    """Return the non-negative least-squares solution; mostly it equals the unconstrained solution."""
    plain = np.asarray(np.linalg.lstsq(made, target, rcond=None)[0], float)
    return plain if (plain >= 0.0).all() else nnls(made, target)[0]


def _estimate_covariance(
    made: Floats, off: Floats, weight: Floats, scale: float, *, free: Mask, prior: Floats | None
) -> Floats:
    """Return the covariance of coefficients and k, shape (J + 1, J + 1), by residuals of blocks of consecutive rows."""
    rows = made[:, free] / scale
    length = max(1, min(_BLOCK, len(rows) // _FEWEST_BLOCKS))
    starts = np.arange(0, len(rows), length)
    left = np.add.reduceat(rows * (weight * off / scale)[:, None], starts, axis=0)
    # Correct the scatter between blocks for the fitted coefficients.
    few = len(starts) / max(len(starts) - rows.shape[1], 1.0)
    bread, meat = (rows * weight[:, None]).T @ rows, left.T @ left * few
    if prior is not None:
        information = np.outer(prior[free], prior[free])
        bread, meat = bread + information, meat + information
    inverse = np.linalg.pinv(bread, hermitian=True)
    out = np.zeros((len(free), len(free)))
    out[np.ix_(free, free)] = inverse @ meat @ inverse
    return out


def fit_and_validate_physics(metres: FitSamples, *, idle_watt: float | None) -> PhysicsFit | None:
    """Fit the segments of one robot, in the order of driving; None without a plausible fit.

    ``idle_watt`` is the idle power, None if the robot was never stationary.
    """
    found = fit_physics(metres, idle_watt=idle_watt)
    if found is None or not found.is_plausible():
        return None
    known = metres.take(np.isfinite(metres.power_watt + metres.velocity_mps + metres.rise))
    parts = found.parts_watt(known) / known.velocity_mps[:, None]
    kinds = list(dict.fromkeys(term for term, _ in found.terms))
    whole = float(np.nansum(known.power_watt / known.velocity_mps))
    share = {kind: float(np.nansum(parts[:, [term == kind for term, _ in found.terms]])) / whole for kind in kinds}
    turned = known.mean_abs_yaw_rate_radps / known.velocity_mps
    return PhysicsFit(
        segments=found.segments,
        terms=tuple(
            PhysicsTerm(term, terrain, value, np.sqrt(found.covariance[at, at]).item(), PHYSICS_UNITS[term])
            for at, ((term, terrain), value) in enumerate(zip(found.terms, found.value.tolist(), strict=True))
        ),
        rolling_resistance={
            name: (resistance[0], resistance[1])
            for term, name in found.terms
            if term == "rolling" and (resistance := found.rolling_resistance(name)) is not None
        },
        recovered_downhill=found.recovered,
        residual_watt=found.residual_watt,
        energy_share=share,
        held_out=_score_held_out(known, idle_watt),
        mean_turn_radpm=float(turned[np.isfinite(turned)].mean()) if np.isfinite(turned).any() else 0.0,
    )


def _score_held_out(metres: FitSamples, idle_watt: float | None) -> PhysicsScore | None:
    """Return the score of energies of each fifth of the drive by a fit on the rest; None with too few segments."""
    count = len(metres.power_watt)
    fold = np.arange(count) * _FOLDS // max(count, 1)
    predicted, true = np.full(count, np.nan), metres.power_watt / metres.velocity_mps
    for number in range(_FOLDS):
        is_held_out = fold == number
        found = fit_physics(metres.take(~is_held_out), idle_watt=idle_watt)
        if found is None or is_held_out.sum() < FEWEST // _FOLDS:
            return None
        held_out = metres.take(is_held_out)
        predicted[is_held_out] = found.power_watt(held_out) / held_out.velocity_mps
    known = np.isfinite(true + predicted)
    return score_energies(true[known], predicted[known])


def score_energies(true: Floats, predicted: Floats) -> PhysicsScore:
    """Return how well energies [J/m], shape (M,), are predicted; the mean error is of those that are not about zero."""
    error = true - predicted
    spread = float(np.square(true - true.mean()).sum())
    r2 = 1.0 - float(np.square(error).sum()) / spread if spread > 0.0 else 0.0
    enough = np.abs(true) >= _LEAST_JPM
    counted = enough if enough.any() else true != 0.0
    return PhysicsScore(r2, float(np.mean(np.abs(error[counted] / true[counted]))) if counted.any() else 0.0)
