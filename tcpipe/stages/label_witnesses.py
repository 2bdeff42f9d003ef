"""Witnesses of position, time and energy of a run: measurements that do not enter the label.

An internal consistency check is no witness. A witness that contradicts a label makes it unusable; a label without a
witness is "confirmed by nothing" and at best usable with care.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from tcpipe.fusion.measurements import FIXES, VISUAL, WHEELS
from tcpipe.power.witnesses import IMPLAUSIBLE, RESISTANCE_OHM, compute_weight_ratio, estimate_climb
from tcpipe.recipe.suggestions import suggest
from tcpipe.robots import Robot
from tcpipe.tables.columns import read_rise, read_spans_ns, to_floats, to_integers
from tcpipe.tables.facts import StageFacts
from tcpipe.tables.findings import NOTHING, WITNESSES_OF_LABEL, Affected, Finding, Subject, make_finding, read_threshold

_SIDE, _LARGE = "power-side-missing", "energy-per-metre-large"
_POWER = Subject("role", "power")


@dataclass(frozen=True, slots=True)
class _Comparison:
    """A witness of the scale of power: its name, the measured ratio, and the smallest and largest possible ratio."""

    witness: str
    ratio: float
    low: float
    high: float

    @property
    def is_possible(self) -> bool:
        """Whether the ratio is inside its range."""
        return self.low < self.ratio < self.high

    @property
    def excess(self) -> float:
        """Distance of the ratio from the range, as a logarithm."""
        return float(max(np.log(abs(self.ratio) / self.high), np.log(self.low / max(abs(self.ratio), 1e-9))))


def find_witnesses(table: pa.Table, facts: StageFacts, robot: Robot) -> Iterator[Finding]:
    """Yield the witnesses of each label, and contradictions of the power; nothing without segments."""
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
    """Return the odometries that confirm the motion of most segments, next to fixes or another odometry."""
    fused = facts.fuse.sensors if facts.fuse else ()
    if np.median(to_integers(table, "confirming_sensor_count")) < 2:
        return []
    odometries = [role for role in (WHEELS, VISUAL) if role in fused]
    return odometries if any(role in fused for role in FIXES) else odometries[1:]


def _find_energy_witnesses(table: pa.Table, facts: StageFacts, robot: Robot) -> Iterator[Finding]:
    """Yield the witnesses that confirm or contradict the energy."""
    comparisons, missing = _compare_power(table, facts, robot)
    contradicting = [each for each in comparisons if not each.is_possible]
    if contradicting:
        yield _make_implausible(max(contradicting, key=lambda each: each.excess), comparisons)
        missing = [f"contradicted by {', '.join(each.witness for each in contradicting)}"]
    share, limit = facts.power.side_share if facts.power else None, read_threshold(_SIDE, "min_share_fraction")
    if share is not None and not limit <= share <= 1.0 - limit:
        yield make_finding(_SIDE, _POWER, share_fraction=max(min(share, 1.0 - share), 0.0))
    energy, max_jpm = _summarize(table, "energy", "joule", "jpm"), read_threshold(_LARGE, "max_mean_jpm")
    if not contradicting and energy["mean_jpm"] > max_jpm:
        yield make_finding(_LARGE, _POWER, mean_jpm=energy["mean_jpm"], max_jpm=max_jpm)
    sizes = {
        "driving_watt": np.nanmedian(to_floats(table, "power_watt")),
        "idle_watt": to_floats(table, "idle_power_watt")[0],
    }
    sensor = facts.label.power_sensor if facts.label else None
    if sensor is not None and sensor.battery_ohm is not None:
        sizes[RESISTANCE_OHM] = sensor.battery_ohm
    confirming = [each.witness for each in comparisons if each.is_possible]
    yield _make_witnesses("energy", confirming, ", ".join(missing), **energy, **sizes)


def _make_implausible(worst: _Comparison, comparisons: list[_Comparison]) -> Finding:
    """Return the finding that a witness contradicts the scale of power; a warning if another one confirms it."""
    bound, limit = ("largest", worst.high) if worst.ratio > worst.high else ("smallest", worst.low)
    # The power of ten, a factor on the current, that brings the ratio nearest to the middle of its range.
    scale = float(10.0 ** -round(np.log10(abs(worst.ratio) / np.sqrt(worst.low * worst.high))))
    is_clear = worst.excess > np.log(read_threshold(IMPLAUSIBLE, "min_unit_excess_ratio"))
    is_remedy = is_clear and scale != 1.0 and all(each.low < each.ratio * scale < each.high for each in comparisons)
    return make_finding(
        IMPLAUSIBLE,
        _POWER,
        severity="warning" if any(each.is_possible for each in comparisons) else None,
        names={"witness": worst.witness, "bound": bound},
        remedies=suggest("scale", {"read": {"current_scale": scale}}) if is_remedy else (),
        ratio=worst.ratio / limit,
    )


def _compare_power(table: pa.Table, facts: StageFacts, robot: Robot) -> tuple[list[_Comparison], list[str]]:
    """Return the witnesses that confirm or contradict the scale of power, and why others are missing."""
    charge_ratio, meter_slope = (facts.power.charge_ratio, facts.power.meter_slope) if facts.power else (None, None)
    found, missing = list[_Comparison](), list[str]()
    for witness, ratio, limit in (
        ("charge", charge_ratio, "max_charge_factor"),
        ("second_meter", 1.0 / meter_slope if meter_slope else None, "max_meter_factor"),
    ):
        if ratio is None:
            missing.append(f"no {witness.replace('_', ' ')}")
        else:
            found.append(
                _Comparison(
                    witness, ratio, 1.0 / read_threshold(IMPLAUSIBLE, limit), read_threshold(IMPLAUSIBLE, limit)
                )
            )
    coarse = []  # ranges that are too wide to confirm anything
    power_watt = to_floats(table, "power_watt")
    if robot.power_range_watt is not None:
        coarse.append(_Comparison("robot_model", float(np.nanmedian(power_watt)), *robot.power_range_watt))
    if robot.mass_kg is None:
        missing.append("mass unknown")
    else:
        rise = read_rise(table)
        start_ns, end_ns = read_spans_ns(table)
        climb = estimate_climb(
            power_watt=power_watt,
            velocity_mps=to_floats(table, "velocity_mps"),
            rise=rise,
            mean_abs_yaw_rate_radps=to_floats(table, "mean_abs_yaw_rate_radps"),
            piece=np.cumsum(np.concatenate(([False], start_ns[1:] != end_ns[:-1]))).astype(np.int64),
            mass_kg=robot.mass_kg,
        )
        if climb is None or not climb.is_certain():
            missing.append("too little slope")
        else:
            found.append(_Comparison("slope", climb.factor, *_read_range("climb_factor")))
        net_jpm = to_floats(table, "net_energy_joule") / to_floats(table, "chord_m")
        if (ratio := compute_weight_ratio(net_jpm, rise, robot.mass_kg)) is not None:
            coarse.append(_Comparison("weight", ratio, *_read_range("weight_ratio")))
    return [*found, *(each for each in coarse if not each.is_possible)], missing


def _read_range(name: str) -> tuple[float, float]:
    return read_threshold(IMPLAUSIBLE, f"min_{name}"), read_threshold(IMPLAUSIBLE, f"max_{name}")
