"""What confirms position, time and energy of a run: each label is compared with measurements that do not enter it.

Witnesses are independent sensors or physics outside of the label's own sensor; an internal consistency check is none. A witness that
contradicts makes a label unusable; a label without a witness is "confirmed by nothing" and at best usable with care.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from tcpipe.fusion.measurements import FIXES, VISUAL, WHEELS
from tcpipe.power.witnesses import RESISTANCE_OHM, Climb, ScaleVerdict, compute_weight_ratio, estimate_climb
from tcpipe.recipe.suggestions import suggest
from tcpipe.robots import Robot
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.facts import StageFacts
from tcpipe.tables.findings import (
    NOTHING,
    WITNESSES_OF_LABEL,
    Affected,
    Finding,
    Subject,
    make_finding,
    read_threshold,
)

_IMPLAUSIBLE, _SIDE, _LARGE = "power-implausible", "power-side-missing", "energy-per-metre-large"
_POWER = Subject("role", "power")


@dataclass(frozen=True, slots=True)
class _Comparison:
    """A witness of the scale of power: its name, the measured ratio, and the smallest and largest possible ratio."""

    witness: str
    ratio: float
    low: float
    high: float
    proves: ScaleVerdict

    @property
    def excess(self) -> float:
        """By how much the ratio is outside of the range, as a logarithm."""
        return float(max(np.log(abs(self.ratio) / self.high), np.log(self.low / max(abs(self.ratio), 1e-9))))

    @property
    def scale(self) -> float:
        """The power of ten by which the current has to be multiplied to bring the ratio nearest to the middle of the range."""
        middle = np.sqrt(self.low * self.high)
        return float(10.0 ** -round(np.log10(abs(self.ratio) / middle)))


def find_witnesses(table: pa.Table, facts: StageFacts, robot: Robot) -> Iterator[Finding]:
    """Yield what confirms each label of labelled segments, and what contradicts the power; nothing without segments."""
    if not table.num_rows:
        return
    sensors = _list_confirming_sensors(table, facts)
    if any(role in (facts.fuse.sensors if facts.fuse else ()) for role in FIXES):
        position_m = np.nanmedian(to_floats(table, "position_std_m"))
        yield _make_witnesses("position", sensors, "one sensor of motion", std_m=position_m)
    yield _make_witnesses("time", sensors, "one sensor of motion", **_summarize(table, "duration", "s", "spm"))
    if np.isfinite(to_floats(table, "energy_joule")).any():
        yield from _find_energy_witnesses(table, facts, robot)


def _make_witnesses(label: Affected, witnesses: list[str], missing: str, **numbers: Any) -> Finding:
    names = {"witnesses": ", ".join(witnesses) or NOTHING} | ({} if witnesses else {"missing": missing})
    return make_finding(WITNESSES_OF_LABEL, Subject("label", label), names=names, **numbers)


def _summarize(table: pa.Table, name: str, unit: str, per_metre: str) -> dict[str, float]:
    """Return mean and median σ of a label per metre of chord."""
    chord_m = to_floats(table, "chord_m")
    value, std = (to_floats(table, f"{name}{part}_{unit}") / chord_m for part in ("", "_std"))
    return {f"mean_{per_metre}": float(np.nanmean(value)), f"std_{per_metre}": float(np.nanmedian(std))}


def _list_confirming_sensors(table: pa.Table, facts: StageFacts) -> list[str]:
    """Return the odometries that confirm the motion of most segments, beside fixes or another odometry."""
    fused = facts.fuse.sensors if facts.fuse else ()
    if np.median(to_integers(table, "confirming_sensor_count")) < 2:
        return []
    odometries = [role for role in (WHEELS, VISUAL) if role in fused]
    return odometries if any(role in fused for role in FIXES) else odometries[1:]


def _find_energy_witnesses(table: pa.Table, facts: StageFacts, robot: Robot) -> Iterator[Finding]:
    """Yield what confirms or contradicts the energy."""
    comparisons, missing = _compare_power(table, facts, robot)
    confirming = [each.witness for each in comparisons if each.proves == "confirmed"]
    contradicting = [each for each in comparisons if each.proves == "contradicted"]
    if contradicting:
        yield _make_implausible(max(contradicting, key=lambda each: each.excess), comparisons)
    share = facts.power.side_share if facts.power else None
    limit = read_threshold(_SIDE, "min_share_fraction")
    if share is not None and not limit <= share <= 1.0 - limit:
        yield make_finding(_SIDE, _POWER, share_fraction=min(share, 1.0 - share))
    energy = _summarize(table, "energy", "joule", "jpm")
    if not contradicting and energy["mean_jpm"] > read_threshold(_LARGE, "max_mean_jpm"):
        yield make_finding(_LARGE, _POWER, mean_jpm=energy["mean_jpm"], max_jpm=read_threshold(_LARGE, "max_mean_jpm"))
    idle_watt = to_floats(table, "idle_power_watt")[0]
    sizes = {"driving_watt": np.nanmedian(to_floats(table, "power_watt")), "idle_watt": idle_watt}
    why = (
        f"contradicted by {', '.join(each.witness for each in contradicting)}" if contradicting else ", ".join(missing)
    )
    sensor = facts.label.power_sensor if facts.label else None
    if sensor is not None and sensor.battery_ohm is not None:
        sizes[RESISTANCE_OHM] = sensor.battery_ohm
    yield _make_witnesses("energy", confirming, why, **energy, **sizes)


def _make_implausible(found: _Comparison, comparisons: list[_Comparison]) -> Finding:
    """Return the finding that a witness contradicts the scale of power; only a warning where another witness confirms it."""
    is_confirmed = any(each.proves == "confirmed" for each in comparisons)
    above = found.ratio > found.high
    bound = found.high if above else found.low
    scale = found.scale
    mends = scale != 1.0 and all(each.low < each.ratio * scale < each.high for each in comparisons)
    return make_finding(
        _IMPLAUSIBLE,
        _POWER,
        severity="warning" if is_confirmed else None,
        names={"witness": found.witness, "bound": "largest" if above else "smallest"},
        remedies=suggest("scale", {"read": {"current_scale": scale}}) if mends else (),
        ratio=found.ratio / bound,
    )


def _compare_power(table: pa.Table, facts: StageFacts, robot: Robot) -> tuple[list[_Comparison], list[str]]:
    """Return what each witness proves of the scale of power, and why others are missing."""
    limit = {name: read_threshold(_IMPLAUSIBLE, name) for name in _LIMITS}
    found, missing = list[_Comparison](), list[str]()
    power = facts.power
    for witness, ratio, most in (
        ("charge", power.charge_ratio if power else None, limit["max_charge_factor"]),
        ("second_meter", 1.0 / power.meter_slope if power and power.meter_slope else None, limit["max_meter_factor"]),
    ):
        if ratio is None:
            missing += [f"no {witness.replace('_', ' ')}"]
            continue
        proves: ScaleVerdict = "confirmed" if 1.0 / most < ratio < most else "contradicted"
        found.append(_Comparison(witness, ratio, 1.0 / most, most, proves))
    if robot.power_range_watt is not None:
        found += _compare_driving_power(table, *robot.power_range_watt)
    if robot.mass_kg is None:
        return found, [*missing, "mass unknown"]
    low, high = limit["min_climb_factor"], limit["max_climb_factor"]
    climb = _estimate_climb(table, robot.mass_kg)
    proves = "unconfirmed" if climb is None else climb.judge(
        low, high, min_reliability=limit["min_slope_reliability"], max_std_fraction=limit["max_climb_std_fraction"]
    )  # fmt: skip
    if climb is None or proves == "unconfirmed":
        missing.append("too little slope")
    else:
        found.append(_Comparison("slope", climb.factor, low, high, proves))
    found += _compare_with_weight(table, robot.mass_kg, limit["min_weight_ratio"], limit["max_weight_ratio"])
    return found, missing


_LIMITS = (
    "min_climb_factor", "max_climb_factor", "min_slope_reliability", "max_climb_std_fraction", "min_weight_ratio", "max_weight_ratio",
    "max_charge_factor", "max_meter_factor",
)  # fmt: skip


def _compute_rise(table: pa.Table) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return (to_floats(table, "end_z_m") - to_floats(table, "start_z_m")) / to_floats(table, "chord_m")


def _estimate_climb(table: pa.Table, mass_kg: float) -> Climb | None:
    start_ns, end_ns = to_integers(table, "start_ns"), to_integers(table, "end_ns")
    return estimate_climb(
        power_watt=to_floats(table, "power_watt"),
        velocity_mps=to_floats(table, "velocity_mps"),
        rise=_compute_rise(table),
        mean_abs_yaw_rate_radps=to_floats(table, "mean_abs_yaw_rate_radps"),
        piece=np.cumsum(np.concatenate(([False], start_ns[1:] != end_ns[:-1]))).astype(np.int64),
        mass_kg=mass_kg,
    )


def _compare_with_weight(table: pa.Table, mass_kg: float, low: float, high: float) -> Iterator[_Comparison]:
    """Yield that energy per metre is impossible for the robot's weight; the range is too wide to confirm anything."""
    net_jpm = to_floats(table, "net_energy_joule") / to_floats(table, "chord_m")
    ratio = compute_weight_ratio(net_jpm, _compute_rise(table), mass_kg)
    if ratio is not None and not low < ratio < high:
        yield _Comparison("weight", ratio, low, high, "contradicted")


def _compare_driving_power(table: pa.Table, low_watt: float, high_watt: float) -> Iterator[_Comparison]:
    """Yield that the median power is outside the range of this robot model; the range is too wide to confirm anything."""
    watt = float(np.nanmedian(to_floats(table, "power_watt")))
    if not low_watt < watt < high_watt:
        yield _Comparison("robot_model", watt, low_watt, high_watt, "contradicted")
