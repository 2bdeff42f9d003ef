"""Distances by each sensor: one that counts in other units, or does not move, has another distance than the rest.

Distances are chords over ten seconds, or thirty where fixes are coarse, so that the noise of fixes does not count as driving: of fixes
their difference, of an odometry what its own velocity and yaw rate add up to. A command is a voice where two sensors differ, though a
robot may be slower than it is told.

A sensor that repeats one value to the last digit while the others show motion is frozen: a driver that died, a cable that is out.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.lags import GRID_S, Floats, resample_fixes
from tcpipe.fusion.checks.plausibility import SensorExclusion
from tcpipe.fusion.measurements import GNSS, IMU, WHEELS, Measurements, Positions
from tcpipe.robust import estimate_robust_std

COMMAND = "command"
"""The command's name among the distances; it is never excluded."""

_WINDOW = round(10.0 / GRID_S)
_LONG_WINDOW = 3 * _WINDOW
"""Where the fixes' noise hides what is driven in the shorter one."""
_STEP = round(5.0 / GRID_S)
_FAR_M = 3.0
_SURE = 6.0  # standard deviations
_FEWEST_WINDOWS = 3
_FACTOR = 2.0
_STILL = 0.05
_BEND_M = 0.3
_UNLIKE_M = 1.0
_UNLIKE_SHARE = 0.3
_UNLIKE_WINDOWS = 0.3
_CLEARLY = 3.0
_NEAR_ONE = (0.7, 1.4)
"""What lies between is told by the track (`odometry_scale`)."""
_MOST = 5.0
_ALIKE = 0.25
_KMH = (3.2, 4.0)
_RADIANS = (1 / 75, 1 / 30)


@dataclass(frozen=True, slots=True)
class Distances:
    """Distance in each window by each source [m], shape (W,), NaN where unknown; ``least_m`` may be noise."""

    chord_m: Mapping[str, Floats]
    least_m: float

    def without(self, names: Collection[str]) -> Distances:
        """Return the distances without those of some sources."""
        return Distances({name: chord for name, chord in self.chord_m.items() if name not in names}, self.least_m)

    def ratio(self, name: str, other: str) -> float | None:
        """Return how many times as far as the other a source goes, where either goes far; None where that is hardly ever."""
        mine, its = self.chord_m[name], self.chord_m[other]
        far = np.isfinite(mine + its) & (np.fmax(mine, its) > self.least_m)
        if far.sum() < _FEWEST_WINDOWS:
            return None
        return float(np.median(mine[far])) / max(float(np.median(its[far])), 1e-3)

    def differ(self, name: str, other: str) -> bool:
        """Return whether one goes more than twice as far as the other."""
        ratio = self.ratio(name, other)
        return ratio is not None and not 1 / _FACTOR <= ratio <= _FACTOR

    def agree(self, name: str, other: str) -> bool:
        """Return whether both go about as far."""
        ratio = self.ratio(name, other)
        return ratio is not None and 1 / _FACTOR <= ratio <= _FACTOR


def find_distances(gnss: Positions | None, twists: Mapping[str, Floats], at_ns: NDArray[np.int64]) -> Distances:
    """Return the distances of all sources; ``twists`` are forward velocity [m/s] and yaw rate [rad/s] on the grid, shape (M, 2)."""
    places = {name: _dead_reckon(twist) for name, twist in twists.items()}
    least_m = _FAR_M
    if gnss is not None:
        places[GNSS] = resample_fixes(gnss, at_ns)
        least_m += _SURE * float(np.sqrt(np.median(gnss.variance_m2[:, :2])))
    found = Distances({name: _compute_chords_m(place, _WINDOW) for name, place in places.items()}, least_m)
    if any(found.ratio(*pair) is not None for pair in combinations(places, 2)):
        return found
    return Distances({name: _compute_chords_m(place, _LONG_WINDOW) for name, place in places.items()}, least_m)


def find_contradictions(found: Distances, *, turning: frozenset[str]) -> dict[str, SensorExclusion]:
    """Return the excluded sensors: of two that differ the one that fewer others agree with, or both.

    Of ``turning`` sensors the gyroscope confirms the yaw rate: the robot does drive when they say so.
    """
    sensors = [name for name in found.chord_m if name != COMMAND]
    heard = {name: [other for other in found.chord_m if other != name and found.agree(name, other)] for name in sensors}
    refusals: dict[str, SensorExclusion] = {}
    for slow, fast, ratio in _find_differing_pairs(found, sensors):
        still = ratio > 1 / _STILL
        # A command tells how fast a robot that moves is to go, not that it moves; a gyroscope that turns with it does.
        for_fast = len(set(heard[fast]) - {COMMAND}) + (fast in turning) if still else len(heard[fast])
        for_slow = len(heard[slow])
        if still and fast == WHEELS and not for_fast:
            continue  # the wheels turn, the robot stands: stuck
        undecided = for_fast == for_slow
        if for_slow <= for_fast:
            refusals.setdefault(slow, _refuse(slow, fast, 1 / ratio, undecided=undecided))
        if for_fast <= for_slow:
            refusals.setdefault(fast, _refuse(fast, slow, ratio, undecided=undecided))
    return refusals


def compare_path_of_fixes(
    gnss: Positions, twist: Floats, at_ns: NDArray[np.int64]
) -> Literal["alike", "mirrored", "unlike"] | None:
    """Return how the path of the fixes lies to what an odometry adds up to; None where there is too little to tell.

    In every window the fixes are laid on the odometry's path by rotation and scale, and again on its mirror image. Unlike is what fits
    neither way, by more than the fixes' noise, what slip bends, and a metre.
    """
    left, bound = [], []
    noise_m2 = _SURE**2 * float(np.median(gnss.variance_m2[:, :2]))
    for a, b in _iterate_path_pairs(gnss, twist, at_ns):
        left.append((_compute_path_misfit_m2(a, b), _compute_path_misfit_m2(a, np.conj(b))))
        bound.append(_UNLIKE_M**2 + noise_m2 + _UNLIKE_SHARE**2 * float(np.mean(np.abs(b) ** 2)))
    if len(left) < _FEWEST_WINDOWS:
        return None
    as_it_is, as_mirrored = np.array(left).T
    if np.mean(as_it_is > bound) > _UNLIKE_WINDOWS and np.mean(as_mirrored > bound) > _UNLIKE_WINDOWS:
        return "unlike"
    most, least = max(as_it_is.sum(), as_mirrored.sum()), min(as_it_is.sum(), as_mirrored.sum())
    if most / len(left) < _BEND_M**2 + noise_m2 or most < _CLEARLY * least:
        return None
    return "alike" if as_it_is.sum() < as_mirrored.sum() else "mirrored"


def estimate_far_scale(gnss: Positions, twist: Floats, at_ns: NDArray[np.int64]) -> tuple[float, float] | None:
    """Return how many times as far as the fixes an odometry goes, and its standard deviation, where that is far from 1 throughout.

    In every window the odometry's path is laid on the fixes by rotation and scale. The scale is the odometry's where the paths are alike
    and the windows agree; fixes that are metres off tell it as well, once a window is longer than that.
    """
    noise_m2 = 2.0 * float(np.median(gnss.variance_m2[:, :2]))
    ratios, windows = [], 0
    for a, b in _iterate_path_pairs(gnss, twist, at_ns):
        energy, own = float(np.mean(np.abs(a) ** 2)), float(np.mean(np.abs(b) ** 2))
        if energy > max(noise_m2, _UNLIKE_M**2) and own > 0.0:
            windows += 1
            if _compute_path_misfit_m2(a, b) < noise_m2 + _UNLIKE_SHARE**2 * energy:
                ratios.append(own / float(np.abs(np.mean(a * np.conj(b)))))
    if len(ratios) < max(_FEWEST_WINDOWS, (1.0 - _UNLIKE_WINDOWS) * windows):
        return None
    factor = float(np.median(ratios))
    spread = estimate_robust_std(np.array(ratios) - factor)
    low, high = _NEAR_ONE
    if low < factor < high or not 1 / _MOST < factor < _MOST or spread > _ALIKE * abs(factor - 1.0):
        return None
    return factor, spread / float(np.sqrt(len(ratios) / 2))  # windows overlap by half


def _iterate_path_pairs(
    gnss: Positions, twist: Floats, at_ns: NDArray[np.int64]
) -> Iterable[tuple[NDArray[np.complex128], NDArray[np.complex128]]]:
    """Yield the fixes and what an odometry adds up to in every window of twice the length, each about its mean."""
    fixes, path = resample_fixes(gnss, at_ns), _dead_reckon(twist)
    for first in range(0, at_ns.size - 2 * _WINDOW, _WINDOW):
        rows = slice(first, first + 2 * _WINDOW)
        if np.isfinite(fixes[rows] + path[rows]).all():
            yield fixes[rows] - fixes[rows].mean(), path[rows] - path[rows].mean()


def _compute_path_misfit_m2(a: NDArray[np.complex128], b: NDArray[np.complex128]) -> float:
    """Return the mean square that is left when b, turned and scaled, is laid on a; both about their mean."""
    energy, own = float(np.mean(np.abs(a) ** 2)), float(np.mean(np.abs(b) ** 2))
    return energy - float(np.abs(np.mean(a * np.conj(b))) ** 2) / own if own > 0 else energy


def _find_differing_pairs(found: Distances, sensors: list[str]) -> Iterable[tuple[str, str, float]]:
    """Return the pairs that differ: the slower, the faster, and how many times as far it goes."""
    for a, b in combinations(sensors, 2):
        ratio = found.ratio(a, b)
        if ratio is not None and found.differ(a, b):
            yield (b, a, ratio) if ratio > 1 else (a, b, 1 / ratio)


def _refuse(role: str, other: str, ratio: float, *, undecided: bool) -> SensorExclusion:
    """Return the exclusion of a sensor that goes ``ratio`` times as far as another."""
    names = {"reference": other} | ({"suspect": other} if undecided else {})
    numbers = {"distance_ratio": ratio}
    if _KMH[0] < ratio < _KMH[1]:
        return SensorExclusion(role, "unit-suspected", {**names, "unit": "km/h"}, numbers)
    if role == GNSS and _RADIANS[0] < ratio < _RADIANS[1]:
        return SensorExclusion(role, "unit-suspected", {**names, "unit": "radians"}, numbers)
    return SensorExclusion(role, "distance-contradicted", names, numbers)


def _dead_reckon(twist: Floats) -> NDArray[np.complex128]:
    """Return the places that a twist (M, 2) adds up to, east and i times north [m]; NaN where it is unknown."""
    known = np.isfinite(twist.sum(1))
    forward, yaw_rate = np.where(known[:, None], twist, 0.0).T
    place = np.cumsum(forward * np.exp(1j * np.cumsum(yaw_rate) * GRID_S)) * GRID_S
    return np.where(known, place, np.nan)


def _compute_chords_m(place_m: NDArray[np.complex128], window: int) -> Floats:
    """Return the distance over every window of so many rows [m]; NaN where a place in it is unknown."""
    lost = np.concatenate(([0], np.cumsum(np.isnan(place_m))))
    first = np.arange(0, place_m.size - window, _STEP)
    whole = lost[first + window + 1] == lost[first]
    return np.where(whole, np.abs(place_m[first + window] - place_m[first]), np.nan)


_FEWEST_ROWS = 20
_APART = 0.5
_FEWEST_FROZEN_WINDOWS = 2


def find_frozen_sensors(m: Measurements, found: Distances) -> dict[str, SensorExclusion]:
    """Return the exclusions by sensor; ``found`` are the distances of the others."""
    refusals = {}
    if m.gnss is not None and _is_one_value(m.gnss.position_enu_m) and _is_contradicted(GNSS, found):
        refusals[GNSS] = refuse_frozen(GNSS, "position", m.gnss.stamp_ns.size)
    for role, source in m.odometries().items():
        if _is_contradicted(role, found) and _is_one_value(source.velocity_mps):
            refusals[role] = refuse_frozen(role, "velocity", source.stamp_ns.size)
    if m.imu is not None and any(np.nanmax(chord, initial=0.0) > found.least_m for chord in found.chord_m.values()):
        for what, values in (
            ("angular_velocity", m.imu.angular_velocity_radps),
            ("acceleration", m.imu.specific_force_mps2),
        ):
            if _is_one_value(values):
                refusals[IMU] = refuse_frozen(IMU, what, m.imu.stamp_ns.size)
    return refusals


def refuse_frozen(role: str, quantity: str, messages: int) -> SensorExclusion:
    """Return the exclusion of a sensor that repeats one value."""
    return SensorExclusion(role, "frozen", {"quantity": quantity}, {"message_count": messages})


def _is_one_value(values: Floats) -> bool:
    """Return whether all rows of (N, k) are the same to the last digit, and enough of them."""
    return values.shape[0] >= _FEWEST_ROWS and bool(
        np.array_equal(values, np.broadcast_to(values[0], values.shape), equal_nan=True)
    )


def _is_contradicted(role: str, found: Distances) -> bool:
    """Return whether another sensor goes clearly further, or less far, in some windows."""
    mine = found.chord_m.get(role)
    for name, chord in found.chord_m.items():
        if name != role and mine is not None:
            apart = np.abs(chord - mine) > np.maximum(found.least_m, _APART * np.fmax(chord, mine))
            if apart.sum() >= _FEWEST_FROZEN_WINDOWS:
                return True
    return False
