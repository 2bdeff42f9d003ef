"""Noise of each sensor, estimated from residuals of pairs of sensors over several time differences.

`fit_noise` returns a `NoiseModel`: a `SensorNoise` for each quantity that a sensor measures. No sensor is excluded
because of its noise. The *claimed* variance of a fix is the one that the receiver reports.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls

from tcpipe.arrays import Floats, Ints
from tcpipe.fusion.level_motion import KNOT_S, get_turn_rates
from tcpipe.fusion.measurements import IMU, MAX_VARIANCE, Measurements, Positions
from tcpipe.fusion.pair_residuals import ACROSS, ALONG, FIX_S, SCALE_S, UP, Residuals
from tcpipe.fusion.signals import compute_median_period_ns, multiply_by_vector
from tcpipe.robust import MEDIAN_OF_SQUARES, estimate_robust_std


@dataclass(frozen=True, slots=True)
class GaussMarkov:
    """Stationary process with covariance ``variance * exp(-|dt| / time_s)``; variance in the squared unit.

    Without ``time_s`` it is white noise, and ``variance`` is its density.
    """

    variance: float
    time_s: float = 0.0

    def difference_variance(self, time_s: Floats) -> Floats:
        """Return the variance of the change over each time difference [s]: the structure function."""
        return np.asarray(2.0 * self.variance * -np.expm1(-time_s / self.time_s))


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """Errors of one quantity: white noise, and a Gauss-Markov process, which is a state of the filter.

    Attributes
    ----------
    white : for fixes, the variance along an axis [m²]; for an odometry, the variance that its distance gains in
        a second of driving [m²/s], zero while the robot is stationary; for a yaw rate, the variance that its angle
        gains in a second [rad²/s]. A rate at f Hz has the variance ``white * f``.
    correlated : for fixes, the error of position [m]: the process with the structure function nearest to the fitted sum
        of processes between 1 and 40 s; for an odometry, the error of its scale around its mean [1]; for a yaw rate,
        its bias around its mean [rad/s].
    claimed_m2 : median claimed variance of the fixes of a run. ``white`` and ``correlated`` belong to a fix with this
        claim; for other fixes they are proportional to the claim.
    """

    white: float
    correlated: GaussMarkov
    claimed_m2: float = 0.0


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Noise of all sensors of a section; ``horizontal`` (east, north) and ``vertical``: of fixes, None without fixes.

    ``shared_scale`` is the scale error that all odometries have in common.
    """

    horizontal: SensorNoise | None
    vertical: SensorNoise | None
    odometries: Mapping[str, SensorNoise]
    turns: Mapping[str, SensorNoise]
    shared_scale: GaussMarkov


PRIORS = {
    # Share of the claimed variance. RTK: 0.8 cm of 1.5 cm (real logs: 0.5 to 3 cm over 5 to 60 s); code phase:
    # atmosphere and orbits.
    "fix, centimetres": GaussMarkov(0.3, 15.0),
    "fix, more": GaussMarkov(0.8, 60.0),
    # m²/s, added to the noise observed in the samples: 2 mm after a second.
    "wheel_odometry velocity": GaussMarkov(4e-6),
    "visual_odometry velocity": GaussMarkov(4e-6),
    # [1]: slip that depends on load and ground; cameras vary by 5 to 15 % on slopes. Shared: tilt and slip that
    # differences of odometries do not contain.
    "wheel_odometry scale": GaussMarkov(0.01**2, 30.0),
    "visual_odometry scale": GaussMarkov(0.03**2, 30.0),
    "shared scale": GaussMarkov(0.003**2, 30.0),
    "slide velocity": GaussMarkov(1e-4),  # m²/s: 1 cm sideways after a second
    # rad²: errors of heading and pitch after the alignment; roll and pitch if no accelerometer measures them.
    "heading scale": GaussMarkov(0.005**2, 30.0),
    "pitch scale": GaussMarkov(0.0015**2, 30.0),
    # rad²/s, added to the noise observed in the samples.
    "imu turn": GaussMarkov(1e-8),
    "wheel_odometry turn": GaussMarkov(1e-5),
    "visual_odometry turn": GaussMarkov(1e-6),
    # rad²/s²: in-run instability of uncooled MEMS, 0.04 °/s.
    "imu bias": GaussMarkov(7e-4**2, 100.0),
    "wheel_odometry bias": GaussMarkov(1e-3**2, 100.0),
    "visual_odometry bias": GaussMarkov(3e-4**2, 100.0),
    # [1]: wheels skid in turns.
    "imu turn scale": GaussMarkov(1e-3**2, 100.0),
    "wheel_odometry turn scale": GaussMarkov(0.1**2, 100.0),
    "visual_odometry turn scale": GaussMarkov(0.02**2, 100.0),
}
"""Prior variances, and densities of white noise, which have no correlation time; units in the comments."""

_NO_PROCESS = GaussMarkov(0.0, 10.0)  # [s]: any correlation time, since the variance is zero
_FLOOR_M, _FLOOR_SHARE = 0.002, 0.0025
"""Least white noise of fixes [m], and as a share of the claimed variance [1]: filters repeat their errors to 0.1 mm."""
_CENTIMETRES_M2 = 0.1**2  # fixes that claim less are RTK fixes
_SUMMARY_S = np.array([1.0, 2.0, 5.0, 10.0, 20.0, 40.0])  # at these times one process approximates a sum
_SUMMARY_TAU_S = np.geomspace(2.0, 100.0, 40)
_ROUNDS = 16  # rounds of the fit [1]; medians in the first half, means below the gate in the second
_GATE = 9.0  # gate of z² [1], 3σ
_TRUNCATED = 0.9733  # mean of a χ² variate of one degree of freedom below the gate [1]
_LEAST_WINDOWS = 15.0  # windows of the longest length in a section [1]: fewer do not determine a variance
_FEW_WINDOWS, _FEW_WINDOWS_S = 4.0, 20.0  # largest factor [1] and length [s] of longer windows in the fit
_PROCESS_MARGIN = 0.6  # the filter uses a process larger by this many standard deviations [1]
_REDUNDANCY = 2.0  # windows per independent window [1]: lengths and axes share errors
_MIN_ROWS = 8  # fewest windows of a cell [1]
_MAX_VARIANCE_RATIO = 1.5  # observed over stated variance of unclaimed fixes [1]; above it, observed
_CODE_PHASE_M2 = 1.5**2  # variance of each axis [m²]; GPS Standard Positioning Service, Performance Standard 2020
_PROCESS_STD = 0.6  # 1σ of the share of the claimed variance [1] at one correlation time
_AXES_STD = 0.25  # 1σ of the relative difference of horizontal and vertical processes [1]
_MAX_PRIOR_GROWTH = 25.0  # largest factor by which a prior's σ grows with the density [1]
_CLAIM_LASTS_S = 0.05  # correlation time of the claimed error of an odometry [s]
_ROUNDING = 1e-10  # variance of rounding [m²]


def inflate_unclaimed_fixes(m: Measurements, residuals: Sequence[Residuals]) -> Measurements:
    """Inflate the variance of fixes to the observed noise, if most have no claim and the recipe's is too small.

    Fixes with an error above a decimetre are not RTK-fixed. Their errors have the correlation of code-phase errors,
    which last longer than a run can measure.
    """
    if m.gnss is None or m.gnss.unclaimed is None or m.gnss.has_claims:
        return m
    found = replace(m, gnss=replace(m.gnss, unclaimed=None))
    noise = fit_noise(found, residuals)
    if noise.horizontal is None or noise.vertical is None:
        return m
    shown_m2 = noise.horizontal.white + noise.horizontal.correlated.variance
    if shown_m2 < _MAX_VARIANCE_RATIO * noise.horizontal.claimed_m2:
        return m
    least_m2 = shown_m2 if shown_m2 < _CENTIMETRES_M2 else max(shown_m2, _CODE_PHASE_M2)
    times = np.where(m.gnss.unclaimed[:, None], max(1.0, least_m2 / noise.horizontal.claimed_m2), 1.0)
    return replace(found, gnss=replace(m.gnss, unclaimed=None, variance_m2=m.gnss.variance_m2 * times))


def fit_noise(measurements: Measurements, residuals: Sequence[Residuals]) -> NoiseModel:
    """Return the noise of each sensor, fitted to the residuals of `find_residuals`: first heights, then the plane."""
    prior = make_prior_model(measurements)
    if not residuals:
        return prior
    section_ns = max(each.end_ns.max() for each in residuals) - min(each.start_ns.min() for each in residuals)
    longest_s = 1e-9 * float(section_ns) / _LEAST_WINDOWS
    by_heights, of_heights = _Fit([each for each in residuals if each.axis == UP], prior, {}, longest_s), {}
    horizontal = prior.horizontal
    has_claims = measurements.gnss is not None and measurements.gnss.has_claims
    if has_claims and prior.vertical and prior.vertical.claimed_m2 < MAX_VARIANCE:
        vertical = by_heights.find_noise(prior.vertical, "up white", "up process")
        prior, of_heights = replace(prior, vertical=vertical), by_heights.get_densities()
    plane = _Fit([each for each in residuals if each.axis in (ALONG, ACROSS)], prior, of_heights, longest_s)
    if has_claims and horizontal:
        horizontal = plane.find_noise(horizontal, "fix white", "fix process")
    return replace(
        prior,
        horizontal=horizontal,
        odometries={
            role: plane.find_noise(of, f"{role} velocity", f"{role} scale") for role, of in prior.odometries.items()
        },
        shared_scale=plane.find_process(prior.shared_scale, "shared scale"),
    )


@dataclass(frozen=True, slots=True)
class _Cell:
    """Residuals of one pair, axis and window length, moving or stationary; ``features`` (M, C), ``square`` (M,)."""

    residuals: Residuals
    is_still: bool
    features: Floats
    square: Floats
    apart_s: float
    """Time between the starts of successive windows [s]."""

    def find_level(self, variances: Floats, *, truncated: bool) -> tuple[Floats, float]:
        """Return the features over the fitted sum, their mean (C,), and the level of the squares."""
        fitted = multiply_by_vector(self.features, variances) + _ROUNDING
        z2 = self.square / fitted
        relative = (self.features / fitted[:, None]).mean(0)
        inside = z2[z2 < _GATE]
        if truncated and inside.size:
            return relative, float(inside.mean()) / _TRUNCATED
        return relative, float(np.median(z2)) / MEDIAN_OF_SQUARES


class _Fit:
    """Non-negative densities by name, fitted to residuals: E r² = Σ density × feature, with the weights of that sum."""

    def __init__(
        self, residuals: Sequence[Residuals], prior: NoiseModel, of_heights: Mapping[str, float], longest_s: float
    ) -> None:
        self._names = sorted({name for each in residuals for name in each.features})
        self._longest_s = longest_s
        self._cells = [cell for each in residuals for cell in _split_cells(each, self._names)]
        pairs = np.array([_find_prior(name, prior, of_heights) for name in self._names]).reshape(-1, 2)
        self._mean, self._std = pairs.T
        self._variances, self._covariance = self._mean, np.diag(self._std**2)
        cells = [
            cell
            for cell in self._cells
            if cell.residuals.time_s <= max(longest_s, min(_FEW_WINDOWS * longest_s, _FEW_WINDOWS_S))
        ]
        for number in range(_ROUNDS if cells else 0):
            rows, levels = zip(
                *(cell.find_level(self._variances, truncated=number >= _ROUNDS // 2) for cell in cells), strict=True
            )
            counts = self._count_windows(cells)
            weight = np.sqrt(0.5 * counts)
            # The σ of a prior grows with the density, so that the prior does not bound a large density.
            std = np.clip(self._variances, self._std, _MAX_PRIOR_GROWTH * self._std)
            matrix = np.concatenate((np.array(rows) * weight[:, None], np.diag(1.0 / std)))
            # The misfit of the logarithm is symmetric for sums that are too large and too small.
            # The mean of the logarithm is too small by 1 / n.
            logarithm = np.log(levels) + np.minimum(1.0 / (_REDUNDANCY * counts), 0.5)
            target = np.concatenate(((1.0 + logarithm) * weight, self._mean / std))
            # Solve in units of the prior, to reduce rounding errors.
            fitted = nnls(matrix * std, target)[0] * std
            self._variances = 0.5 * (self._variances + fitted)
            self._covariance = np.linalg.inv(np.einsum("mi,mj->ij", matrix, matrix))

    def _count_windows(self, cells: Sequence[_Cell]) -> Floats:
        """Return the number of independent windows of each cell.

        Windows of length Δ that begin s apart have the correlation (D(Δ + s) + D(|Δ - s|) - 2 D(s)) / 2 D(Δ), with the
        structure function D of the fitted sum. Overlapping windows are independent for white noise, but not for a
        random walk.
        """
        levels: dict[tuple[tuple[str, str], str, bool], list[tuple[float, float]]] = {}
        for cell in cells:
            key = cell.residuals.pair, cell.residuals.axis, cell.is_still
            levels.setdefault(key, []).append(
                (cell.residuals.time_s, float((multiply_by_vector(cell.features, self._variances)).mean()) + _ROUNDING)
            )
        counts = []
        for cell in cells:
            time_s, level = np.array(levels[cell.residuals.pair, cell.residuals.axis, cell.is_still]).T
            length_s = cell.residuals.time_s
            later_s = cell.apart_s * np.arange(1, 2 * round(length_s / cell.apart_s) + 1)
            at = [
                np.interp(each, time_s, level) * (each > 1e-3)
                for each in (length_s + later_s, np.abs(length_s - later_s), later_s)
            ]
            correlation = (at[0] + at[1] - 2.0 * at[2]) / (2.0 * np.interp(length_s, time_s, level))
            counts.append(cell.square.size / (1.0 + 2.0 * np.square(correlation).sum()) / _REDUNDANCY)
        return np.array(counts)

    def get_densities(self) -> dict[str, float]:
        """Return every density by name."""
        return dict(zip(self._names, self._variances.tolist(), strict=True))

    def find_noise(self, prior: SensorNoise, white: str, *processes: str) -> SensorNoise:
        """Return the noise of a sensor from the names of its white density and of its processes."""
        density = self.get_densities().get(white, prior.white)
        floor = max(_FLOOR_M**2, _FLOOR_SHARE * prior.claimed_m2) if prior.claimed_m2 else 0.0
        correlated = self.find_process(prior.correlated, *processes)
        return SensorNoise(max(density, floor), correlated, prior.claimed_m2)

    def find_process(self, prior: GaussMarkov, *names: str) -> GaussMarkov:
        """Return the Gauss-Markov process that is nearest to the sum of the named processes.

        At times that are too long for the section, it is the larger of fit and prior.
        """
        taus = {
            row: float(name.rpartition(" ")[2])
            for row, name in enumerate(self._names)
            if name.rpartition(" ")[0] in names
        }
        if not taus:
            return prior
        shape = np.zeros((_SUMMARY_S.size, len(self._names)))
        for row, tau in taus.items():
            shape[:, row] = GaussMarkov(1.0, tau).difference_variance(_SUMMARY_S)
        unsure = np.sqrt(np.einsum("ij,jk,ik->i", shape, self._covariance, shape))
        fitted = shape @ self._variances + _PROCESS_MARGIN * unsure
        least = np.where(self._longest_s < _SUMMARY_S, prior.difference_variance(_SUMMARY_S), 0.0)
        return _summarize(np.maximum(fitted, least))


def _split_cells(each: Residuals, names: Sequence[str]) -> Iterator[_Cell]:
    """Yield the residuals of the moving and of the stationary robot, without exact zeros of repeated values."""
    features = np.stack([each.features.get(name, np.zeros(each.value.size)) for name in names], -1)
    for is_still in (False, True):
        if is_still:  # the small motions of a stationary robot must not explain them
            features = features * np.array([" scale" not in name for name in names])
        rows = np.flatnonzero((each.is_still == is_still) & np.isfinite(each.value) & (each.value != 0.0))
        if rows.size < _MIN_ROWS:
            continue
        apart_s = float(np.median(np.diff(each.start_ns[rows]))) * 1e-9
        yield _Cell(each, is_still, features[rows], np.square(each.value[rows]), apart_s)


def _find_prior(name: str, prior: NoiseModel, of_heights: Mapping[str, float]) -> tuple[float, float]:
    """Return prior mean and standard deviation of a density; ``of_heights``: fitted densities of heights."""
    kind, _, last = name.rpartition(" ")
    if name.startswith(("fix ", "up ")) and prior.horizontal is not None and prior.vertical is not None:
        return _find_fix_prior(name, prior.horizontal, prior.vertical, of_heights)
    known = PRIORS[kind if kind in PRIORS else name]
    variance = known.variance
    if last == "velocity" and kind in prior.odometries:
        variance = prior.odometries[kind].white
    elif kind == "heading scale":
        variance = _find_heading_variance(prior)
    share = _share_process(known.time_s, float(last), SCALE_S) if known.time_s else 1.0
    # The scale of an odometry often varies several times as much.
    return share * variance, 4.0 * variance if kind.endswith("odometry scale") else variance


def _find_fix_prior(
    name: str, horizontal: SensorNoise, vertical: SensorNoise, of_heights: Mapping[str, float]
) -> tuple[float, float]:
    """Return the prior noise of fixes in the plane: that of heights times the ratio of claims, if heights are compared.

    Heights are compared with a track whose pitch error is small. In the plane, the scale of an odometry hides slow
    errors of fixes.
    """
    axis, kind, time_s = (*name.split(), "0")[:3]
    fixes = vertical if axis == "up" else horizontal
    if kind == "white":
        return fixes.white, fixes.claimed_m2
    usual = fixes.correlated.variance * _share_process(fixes.correlated.time_s, float(time_s), FIX_S)
    if axis == "up" or not of_heights:
        return usual, _PROCESS_STD * fixes.claimed_m2
    ratio = horizontal.claimed_m2 / vertical.claimed_m2
    by_heights = {each: ratio * variance for each, variance in of_heights.items() if each.startswith("up process")}
    return by_heights[f"up process {time_s}"], _AXES_STD * max(sum(by_heights.values()), horizontal.correlated.variance)


def _find_heading_variance(prior: NoiseModel) -> float:
    """Return the variance of the heading [rad²] between knots of the alignment, for a Brownian bridge."""
    best = next(iter(prior.turns.values()))
    return KNOT_S / 6.0 * best.white + KNOT_S**2 / 100.0 * best.correlated.variance


def _share_process(time_s: float, tau_s: float, taus_s: Sequence[float]) -> float:
    """Return the part of a process that belongs to one of several correlation times: linear in log time."""
    place = np.interp(np.log(time_s), np.log(taus_s), np.arange(len(taus_s)))
    return float(max(0.0, 1.0 - abs(place - taus_s.index(tau_s))))


def _summarize(structure: Floats) -> GaussMarkov:
    """Return the process whose structure function is nearest to a given one at `_SUMMARY_S`, in the logarithm."""
    if not (structure > 0.0).all():
        return _NO_PROCESS
    shape = -2.0 * np.expm1(-_SUMMARY_S / _SUMMARY_TAU_S[:, None])
    ratio = np.log(structure / shape)
    best = int(np.argmin(ratio.std(1)))
    return GaussMarkov(float(np.exp(ratio[best].mean())), float(_SUMMARY_TAU_S[best]))


def make_prior_model(measurements: Measurements) -> NoiseModel:
    """Return the noise from priors and claims alone."""
    gnss, imu = measurements.gnss, [IMU] if measurements.imu is not None else []
    return NoiseModel(
        horizontal=None if gnss is None else _make_fix_prior(gnss, slice(0, 2)),
        vertical=None if gnss is None else _make_fix_prior(gnss, slice(2, 3)),
        odometries={
            role: SensorNoise(
                max(
                    _compute_density(each.stamp_ns, each.velocity_mps[:, 0]) + PRIORS[f"{role} velocity"].variance,
                    _CLAIM_LASTS_S * float(np.median(each.variance_m2ps2[:, 0])),
                ),
                PRIORS[f"{role} scale"],
            )
            for role, each in measurements.odometries().items()
        },
        turns={
            role: SensorNoise(
                _compute_density(stamp_ns, rate[:, 2]) + PRIORS[f"{role} turn"].variance, PRIORS[f"{role} bias"]
            )
            for role in (*imu, *measurements.turning_odometries())
            for stamp_ns, rate in [get_turn_rates(measurements, role)]
        },
        shared_scale=PRIORS["shared scale"],
    )


def _make_fix_prior(gnss: Positions, axes: slice) -> SensorNoise:
    """Return the prior noise of fixes: white noise and process together have the claimed variance."""
    claimed = float(np.median(gnss.variance_m2[:, axes]))
    if claimed >= MAX_VARIANCE:  # not measured: a correlated error would be kilometres large
        return SensorNoise(claimed, _NO_PROCESS, claimed)
    prior = PRIORS["fix, centimetres" if claimed < _CENTIMETRES_M2 else "fix, more"]
    return SensorNoise((1.0 - prior.variance) * claimed, GaussMarkov(prior.variance * claimed, prior.time_s), claimed)


def _compute_density(stamp_ns: Ints, values: Floats) -> float:
    """Return the density of white noise [u² s] by the median of the second differences that are not zero."""
    finite = np.isfinite(values)
    second = np.abs(np.diff(values[finite], n=2))
    second = second[second > 0.0]
    if second.size < _MIN_ROWS:
        return 0.0
    return estimate_robust_std(second) ** 2 / 6.0 * compute_median_period_ns(stamp_ns[finite]) * 1e-9
