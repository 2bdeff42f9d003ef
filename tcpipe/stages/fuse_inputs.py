"""What fusing needs of the streams: measurements by clock epoch; and what was set aside on the way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from tcpipe.fusion import preparation
from tcpipe.fusion.checks.mounting import Arm, Tilt
from tcpipe.fusion.checks.odometry_scale import Scale
from tcpipe.fusion.checks.stamp_jitter import steadied
from tcpipe.fusion.measurements import DOPPLER, GNSS, IMU, VISUAL, WHEELS, Measurements
from tcpipe.fusion.preparation import Prepared
from tcpipe.recipe import FuseConfig
from tcpipe.tables.arrays import rows_where
from tcpipe.tables.columns import FloatColumns, integers
from tcpipe.tables.findings import Finding, Subject, make_finding
from tcpipe.tables.levels import Sensor, Streams


@dataclass(slots=True)
class FusionInputs:
    """Measurements by epoch; datum (longitude, latitude, height) or None; by role, unusable stamps and counts; findings; refused roles."""

    datum_deg_m: tuple[float, float, float] | None
    measurements: dict[int, Measurements] = field(default_factory=dict)
    invalid_ns: dict[str, list[NDArray[np.int64]]] = field(default_factory=dict)
    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    refused: frozenset[str] = frozenset()
    arm: Arm | None = None
    """What is known of the antenna's arm where it was mended or nobody stated it."""
    imu_tilt: Tilt | None = None
    """Roll and pitch of the IMU's mounting that were taken out."""
    scales: Mapping[str, Scale] = field(default_factory=dict)
    """By odometry, the scale that was taken out."""

    def note(self, role: str, prepared: Prepared) -> None:
        """Remember what was set aside."""
        self.invalid_ns.setdefault(role, []).append(prepared.invalid_ns)
        count = self.counts.setdefault(role, {"invalid": 0, "repeated": 0, "variances_replaced": 0})
        count["invalid"] += prepared.invalid_ns.size
        count["repeated"] += prepared.repeated
        count["variances_replaced"] += prepared.variances_replaced
        self.findings += [finding for finding in prepared.findings if finding not in self.findings]


def prepare_inputs(streams: Streams, config: FuseConfig) -> FusionInputs:
    """Turn the motion streams into measurements, one set a clock epoch."""
    tables = {role: streams.tables[role] for role in (GNSS, DOPPLER, IMU, WHEELS, VISUAL) if role in streams.tables}
    datum = None
    if GNSS in tables:
        fixes = FloatColumns(tables[GNSS])
        datum = preparation.find_datum(fixes["lon_deg"], fixes["lat_deg"], fixes["alt_m"])
    inputs = FusionInputs(datum)
    if config.estimator == "ukf" and tables.pop(DOPPLER, None) is not None:
        names = {"estimator": config.estimator}
        inputs.findings.append(make_finding("unused-by-estimator", Subject("role", DOPPLER), names=names))
    for epoch in sorted({int(e) for table in tables.values() for e in pc.unique(table["epoch"]).to_pylist()}):
        parts = {role: rows_where(table, "epoch", epoch) for role, table in tables.items()}
        found = {role: _prepare(role, part, streams.sensors[role], config, inputs) for role, part in parts.items()}
        gnss, findings = steadied(found.get(GNSS), found.get(WHEELS) or found.get(VISUAL))
        inputs.findings += findings
        inputs.measurements[epoch] = Measurements(
            gnss=gnss,
            doppler=found.get(DOPPLER),
            imu=found.get(IMU),
            wheels=found.get(WHEELS),
            visual=found.get(VISUAL),
            nonholonomic_std_mps=config.nonholonomic_std_mps,
        )
    return inputs


def _prepare(role: str, table: pa.Table, sensor: Sensor, config: FuseConfig, inputs: FusionInputs) -> Any:
    stamp_ns, columns = integers(table, "stamp_ns"), FloatColumns(table)
    place: Mapping[str, Any] = {"xyz_m": sensor.xyz_m, "quat_xyzw": sensor.quat_xyzw}
    made: Any
    if role == GNSS:
        if inputs.datum_deg_m is None:
            inputs.note(role, Prepared(stamp_ns))
            return None
        made, prepared = preparation.positions(
            stamp_ns,
            columns,
            datum_deg_m=inputs.datum_deg_m,
            lever_arm_m=sensor.xyz_m,
            default_std_m=config.gnss_default_std_m,
            floor_std_m=config.gnss_std_floor_m,
        )
    elif role == DOPPLER:
        made, prepared = preparation.ground_velocities(stamp_ns, columns, default_std_mps=config.gnss_velocity_std_mps)
    elif role == IMU:
        made, prepared = preparation.inertial(
            stamp_ns,
            columns,
            **place,
            gyro_std_radps=config.gyro_noise_radps,
            accelerometer_std_mps2=config.accelerometer_noise_mps2,
        )
    else:
        std = config.wheel_std_mps if role == WHEELS else config.visual_std_mps
        made, prepared = preparation.body_velocities(
            stamp_ns, columns, **place, default_std_mps=std, only_forward=role == WHEELS
        )
    inputs.note(role, prepared)
    return made if made.stamp_ns.size else None
