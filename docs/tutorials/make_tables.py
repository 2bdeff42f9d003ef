"""Write a drive of site-a as VESC Tool logs it, and its second half as a microcontroller does (docs/tutorials/csv-logger.md)."""

from pathlib import Path

import numpy as np
import polars as pl


def read(topic):
    stamp = pl.col("header.stamp.sec").cast(pl.Int64) * 10**9 + pl.col("header.stamp.nanosec")
    return pl.read_parquet(f"topics/a200_0000_{topic}.parquet").with_columns(ns=stamp).sort("ns")


rows = read("platform_mcu_status_power")
for topic in ("sensors_gps_0_fix", "sensors_imu_0_data", "platform_odom"):
    rows = rows.join_asof(read(topic), on="ns", suffix=f"_{topic}")
rows = rows.drop_nulls(["latitude", "angular_velocity.x", "twist.twist.linear.x"])
amp = pl.col("measured_currents").list.get(1) + pl.col("measured_currents").list.get(2)
inertial = {f"acc{axis.upper()}": pl.col(f"linear_acceleration.{axis}") / 9.80665 for axis in "xyz"}
inertial |= {f"gyro{axis.upper()}": pl.col(f"angular_velocity.{axis}").degrees() for axis in "xyz"}
vesc = rows.select(
    ms_today=(pl.col("ns") // 10**6 + 3_600_000) % 86_400_000,
    input_voltage=pl.col("measured_voltages").list.get(0),
    current_motor=2.5 * amp,
    current_in=amp,
    speed_meters_per_sec=pl.col("twist.twist.linear.x"),
    **inertial,
    gnss_lat=pl.col("latitude"),
    gnss_lon=pl.col("longitude"),
    gnss_alt=pl.col("altitude"),
    gnss_gVel=pl.col("twist.twist.linear.x"),
    gnss_hAcc=pl.col("position_covariance").arr.get(0).sqrt(),
)
Path("vesc").mkdir()
vesc.write_csv("vesc/2023-11-14_23-13-20.csv", separator=";")
plain = rows[len(rows) // 2 :].select(
    millis=(pl.col("ns") - rows["ns"][0]) // 10**6 + 41_500,
    gps_time=pl.from_epoch(pl.col("ns") // 10**9).dt.strftime("%Y-%m-%dT%H:%M:%SZ"),
    lat=pl.col("latitude"),
    lon=pl.col("longitude"),
    alt=pl.col("altitude"),
    **{f"a{axis}[g]": inertial[f"acc{axis.upper()}"] for axis in "xyz"},
    **{f"g{axis}[dps]": inertial[f"gyro{axis.upper()}"] for axis in "xyz"},
    rpm_L=(pl.col("twist.twist.linear.x") - 0.275 * pl.col("twist.twist.angular.z")) * 30 / np.pi / 0.165,
    rpm_R=(pl.col("twist.twist.linear.x") + 0.275 * pl.col("twist.twist.angular.z")) * 30 / np.pi / 0.165,
    Ubat=pl.col("measured_voltages").list.get(0),
    current_mA=1000 * amp,
)
Path("plain").mkdir()
plain.write_csv("plain/log7.csv")
