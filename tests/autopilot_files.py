"""Small logs of autopilots, written by hand: PX4 ULog and ArduPilot DataFlash, and a drive in both."""

import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

SYNC = bytes.fromhex("2f731320250cbb12")
_ULOG = {"uint64_t": "Q", "int32_t": "i", "uint8_t": "B", "bool": "?", "float": "f", "double": "d", "uint32_t": "I"}
_DATAFLASH = {
    "Q": "Q",
    "B": "B",
    "b": "b",
    "H": "H",
    "I": "I",
    "f": "f",
    "c": "h",
    "C": "H",
    "e": "i",
    "L": "i",
    "N": "16s",
    "Z": "64s",
    "h": "h",
    "n": "4s",
    "a": "64s",
    "q": "q",
}


@dataclass
class Ulog:
    """A ULog that is written message by message."""

    start_us: int = 1_000_000
    parts: list[bytes] = field(default_factory=list)
    codes: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.parts.append(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", self.start_us))
        self.message("B", bytes(40))

    def message(self, kind: str, content: bytes) -> None:
        self.parts.append(struct.pack("<HB", len(content), ord(kind)) + content)

    def format(self, name: str, *fields: str) -> None:
        """Define a format: fields as ``float[3] gyro_rad``; the layout of those that are written is that of the fields."""
        self.message("F", f"{name}:{';'.join(('uint64_t timestamp', *fields))};".encode())
        kept = [of.split()[0] for of in fields if "_padding" not in of]
        counts = [(of.split("[")[0], of.partition("[")[2].rstrip("]")) for of in kept]
        self.codes[name] = "<Q" + "".join(f"{count}{_ULOG[of]}" for of, count in counts)

    def parameter(self, name: str, value: float) -> None:
        key = f"float {name}".encode()
        self.message("P", bytes([len(key)]) + key + struct.pack("<f", value))

    def subscribe(self, name: str, number: int, instance: int = 0) -> None:
        self.message("A", struct.pack("<BH", instance, number) + name.encode())

    def data(self, name: str, number: int, time_us: int, *values: float) -> None:
        self.message("D", struct.pack("<H", number) + struct.pack(self.codes[name], time_us, *values))

    def bytes(self) -> bytes:
        return b"".join(self.parts)


@dataclass
class DataFlash:
    """A DataFlash log that is written message by message."""

    parts: list[bytes] = field(default_factory=list)
    codes: dict[str, tuple[int, str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._define(0x80, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")

    def format(self, name: str, letters: str, labels: str) -> None:
        code = "<" + "".join(_DATAFLASH[letter] for letter in letters)
        kind = 0x81 + len(self.codes)
        self.codes[name] = (kind, code)
        self._define(kind, 3 + struct.calcsize(code), name, letters, labels)

    def _define(self, kind: int, length: int, name: str, letters: str, labels: str) -> None:
        content = struct.pack("<BB4s16s64s", kind, length, name.encode(), letters.encode(), labels.encode())
        self.parts.append(b"\xa3\x95\x80" + content)

    def data(self, name: str, *values: float | bytes) -> None:
        kind, code = self.codes[name]
        self.parts.append(b"\xa3\x95" + bytes([kind]) + struct.pack(code, *values))

    def bytes(self) -> bytes:
        return b"".join(self.parts)


# ---------------------------------------------------------------- a drive
LAT_DEG, LON_DEG, HEIGHT_M, GEOID_M = 47.0, 8.0, 450.0, 48.0
SPEED_MPS, VOLT, AMP = 1.5, 24.0, 6.0
UTC_US = 1_700_000_000_000_000
"""UTC at a time since boot of 0."""
LEAP_S = 18
TRACK_M, RADIUS_M = 0.6, 0.165
ANTENNA_FRD = (0.3, 0.1, -0.5)
_EAST_M_PER_DEG = 111_320.0 * np.cos(np.radians(LAT_DEG))
_NORTH_M_PER_DEG = 111_174.0


@dataclass
class Drive:
    """Straight legs of 40 m at one speed, joined by left turns of 90 degrees; standing before and after. Columns by time [s] since boot."""

    seconds: float = 160.0
    rate_hz: int = 100

    def __post_init__(self) -> None:
        self.t = np.arange(0, self.seconds, 1 / self.rate_hz) + 5.0
        moving = np.clip(np.minimum(self.t - 15.0, self.t[-1] - 10.0 - self.t) / 2.0, 0.0, 1.0)
        self.speed = SPEED_MPS * moving
        leg_s, turn_s = 26.0, 4.0
        phase = np.mod(self.t - 19.0, leg_s + turn_s)
        turning = (phase > leg_s) & (moving == 1.0)
        self.turn = np.where(turning, np.pi / 2 / turn_s, 0.0)
        step = 1 / self.rate_hz
        self.yaw = 0.3 + np.cumsum(self.turn) * step
        self.east, self.north = (np.cumsum(self.speed * f(self.yaw)) * step for f in (np.cos, np.sin))
        self.force = np.gradient(self.speed, step), self.speed * self.turn
        self.rng = np.random.default_rng(4)

    def rows(self, rate_hz: float):
        """Yield the index and time since boot [µs] of rows at about a rate."""
        for row in range(0, len(self.t), round(self.rate_hz / rate_hz)):
            yield row, round(self.t[row] * 1e6)

    def antenna(self, row: int) -> tuple[float, float]:
        """Return latitude and longitude [deg] of the antenna."""
        ahead, left = ANTENNA_FRD[0], -ANTENNA_FRD[1]
        cos, sin = np.cos(self.yaw[row]), np.sin(self.yaw[row])
        east = self.east[row] + cos * ahead - sin * left + self.rng.normal(0, 0.01)
        north = self.north[row] + sin * ahead + cos * left + self.rng.normal(0, 0.01)
        return LAT_DEG + north / _NORTH_M_PER_DEG, LON_DEG + east / _EAST_M_PER_DEG

    def velocity(self, row: int) -> tuple[float, float]:
        """Return the velocity of the antenna east and north [m/s], as a receiver measures it."""
        cos, sin, turn = np.cos(self.yaw[row]), np.sin(self.yaw[row]), self.turn[row]
        ahead, aside = self.speed[row] + turn * ANTENNA_FRD[1], turn * ANTENNA_FRD[0]
        east, north = cos * ahead - sin * aside, sin * ahead + cos * aside
        return east + self.rng.normal(0, 0.03), north + self.rng.normal(0, 0.03)

    def imu(self, row: int) -> tuple[list[float], list[float]]:
        """Return rate [rad/s] and specific force [m/s²] in axes forward, right, down."""
        rate = np.array([0.0, 0.0, -self.turn[row]])
        force = np.array([self.force[0][row], -self.force[1][row], -9.81])
        return (rate + self.rng.normal(0, 0.002, 3)).tolist(), (force + self.rng.normal(0, 0.03, 3)).tolist()

    def power(self, row: int) -> tuple[float, float]:
        """Return voltage and current drawn."""
        amp = 0.5 + (AMP - 0.5) * self.speed[row] / SPEED_MPS
        return VOLT + self.rng.normal(0, 0.01), amp + self.rng.normal(0, 0.05)


def write_ulog(path: Path, drive: Drive) -> Path:
    """Write a drive as PX4 does."""
    log = Ulog()
    for axis, value in zip("XYZ", ANTENNA_FRD, strict=True):
        log.parameter(f"EKF2_GPS_POS_{axis}", value)
    log.parameter("RDD_WHEEL_RADIUS", RADIUS_M)
    log.format(
        "sensor_gps", "double latitude_deg", "double longitude_deg", "double altitude_msl_m", "double altitude_ellipsoid_m",
        "uint64_t time_utc_usec", "float s_variance_m_s", "float eph", "float epv", "float vel_n_m_s", "float vel_e_m_s",
        "float vel_d_m_s", "int32_t timestamp_time_relative", "uint8_t fix_type", "bool vel_ned_valid", "uint8_t[2] _padding0",
    )  # fmt: skip
    log.format(
        "sensor_combined", "float[3] gyro_rad", "uint32_t gyro_integral_dt", "int32_t accelerometer_timestamp_relative",
        "float[3] accelerometer_m_s2",
    )  # fmt: skip
    log.format("battery_status", "float voltage_v", "float current_a", "uint8_t id", "uint8_t[3] _padding0")
    log.format("wheel_encoders", "float[2] wheel_speed", "float[2] wheel_angle")
    log.format("rover_speed_setpoint", "float speed_body_x", "float speed_body_y")
    names = {"sensor_gps": 3, "sensor_combined": 1, "battery_status": 7, "wheel_encoders": 4, "rover_speed_setpoint": 9}
    for name, number in names.items():
        log.subscribe(name, number)
    rows = []
    for row, us in drive.rows(5):
        lat, lon = drive.antenna(row)
        east, north = drive.velocity(row)
        height = HEIGHT_M + drive.rng.normal(0, 0.02)
        values = (
            lat,
            lon,
            height - GEOID_M,
            height,
            UTC_US + us - 40,
            0.05,
            0.014,
            0.02,
            north,
            east,
            0.01,
            -40,
            6,
            True,
        )
        rows.append((us, "sensor_gps", values))
    for row, us in drive.rows(50):
        rate, force = drive.imu(row)
        rows.append((us, "sensor_combined", (*rate, 5000, 0, *force)))
    for row, us in drive.rows(20):
        rows.append((us, "battery_status", (*drive.power(row), 1)))
        outside, inside = (drive.speed[row] + side * drive.turn[row] * TRACK_M / 2 for side in (1, -1))
        rows.append((us, "wheel_encoders", (inside / RADIUS_M, outside / RADIUS_M, 0.0, 0.0)))
    for row, us in drive.rows(10):
        rows.append((us, "rover_speed_setpoint", (SPEED_MPS if drive.speed[row] else 0.0, np.nan)))
    for index, (us, name, values) in enumerate(sorted(rows, key=lambda of: of[0])):
        if index % 200 == 0:
            log.message("S", SYNC)
            log.message("L", b"6" + struct.pack("<Q", us) + b"a text")
        log.data(name, names[name], us, *values)
    path.write_bytes(log.bytes())
    return path


def write_dataflash(path: Path, drive: Drive) -> Path:
    """Write a drive as ArduRover does."""
    log = DataFlash()
    log.format("PARM", "QNff", "TimeUS,Name,Value,Default")
    log.format("GPS", "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U")
    log.format("GPA", "QBCCCCfBIHe", "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta,AEl")
    log.format("IMU", "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz")
    log.format("BAT", "QBfffffcf", "TimeUS,Instance,Volt,VoltR,Curr,CurrTot,EnrgTot,Temp,Res")
    log.format("WENC", "Qfbfb", "TimeUS,Dist0,Qual0,Dist1,Qual1")
    log.format("THR", "Qhffff", "TimeUS,ThrIn,ThrOut,DesSpeed,Speed,AccY")
    log.format("STER", "Qhfffff", "TimeUS,SteerIn,SteerOut,DesLatAcc,LatAcc,DesTurnRate,TurnRate")
    for axis, value in zip("XYZ", ANTENNA_FRD, strict=True):
        log.data("PARM", 10, f"GPS1_POS_{axis}".encode(), value, 0.0)
    for name, value in (
        ("WENC_TYPE", 1),
        ("WENC2_TYPE", 1),
        ("WENC_POS_Y", -TRACK_M / 2),
        ("WENC2_POS_Y", TRACK_M / 2),
    ):
        log.data("PARM", 11, name.encode(), value, 0.0)
    week_us = 7 * 86_400 * 10**6
    rows = []
    for row, us in drive.rows(5):
        lat, lon = drive.antenna(row)
        east, north = drive.velocity(row)
        height = HEIGHT_M + drive.rng.normal(0, 0.02)
        gps_us = UTC_US + us + LEAP_S * 10**6 - 315_964_800 * 10**6
        course = np.degrees(np.arctan2(east, north)) % 360
        fix = (0, 6, gps_us % week_us // 1000, gps_us // week_us, 20, 70, round(lat * 1e7), round(lon * 1e7))
        fix = (*fix, round((height - GEOID_M) * 100), np.hypot(east, north), course, 0.01, 0.0, 1)
        rows.append((us, "GPS", fix))
        rows.append((us, "GPA", (0, 90, 1, 2, 5, 0.0, 1, us // 1000, 200, round(height * 100))))
    for row, us in drive.rows(50):
        rate, force = drive.imu(row)
        rows.append((us, "IMU", (0, *rate, *force, 0, 0, 40.0, 1, 1, 1000, 1000)))
        rows.append((us, "IMU", (1, *rate, *force, 0, 0, 41.0, 1, 1, 1000, 1000)))
    left, right = (np.cumsum(drive.speed + side * drive.turn * TRACK_M / 2) / drive.rate_hz for side in (-1, 1))
    for row, us in drive.rows(20):
        volt, amp = drive.power(row)
        rows.append((us, "BAT", (0, volt, volt, amp, 0.0, 0.0, 2500, 0.01)))
        rows.append((us, "WENC", (left[row], 100, right[row], 100)))
    for row, us in drive.rows(10):
        rows.append((us, "THR", (0, 0.5, SPEED_MPS if drive.speed[row] else 0.0, drive.speed[row], 0.0)))
        rows.append((us, "STER", (0, 0.0, 0.0, 0.0, -np.degrees(drive.turn[row]), 0.0)))
    for us, name, values in sorted(rows, key=lambda of: of[0]):
        log.data(name, us, *values)
    path.write_bytes(log.bytes())
    return path
