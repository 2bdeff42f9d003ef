"""Three invented loggers that write tables of one drive, each with names, units and clocks of its own, and the truth to judge labels by."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import polars as pl

from tcpipe.tables.columns import to_floats, to_integers

START = datetime(2025, 7, 9, 14, 3, 12, 250_000, tzinfo=ZoneInfo("Europe/Vienna"))
START_NS = round(START.timestamp() * 1000) * 1_000_000
COURSE_RAD, LATITUDE, LONGITUDE = 0.5, 47.0612, 15.4481
METRES_PER_DEG = 111_195.0
GRAVITY = 9.80665
Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Drive:
    """A straight drive of about 70 m: speed and power by time on a grid of 1 ms, noise of its sensors by a seed."""

    seed: int = 0
    seconds: float = 80.0

    def __post_init__(self) -> None:
        """Integrate distance and energy."""
        t = np.arange(0.0, self.seconds, 1e-3)
        ramp = np.clip((t - 4.0) / 2.0, 0.0, 1.0) * np.clip((self.seconds - 4.0 - t) / 2.0, 0.0, 1.0)
        speed = ramp * (1.0 + 0.06 * np.sin(2 * np.pi * t / 17.0))
        watt = 22.0 + ramp * (70.0 + 60.0 * speed + 8.0 * np.sin(2 * np.pi * t / 11.0))
        for name, values in {"t": t, "speed": speed, "watt": watt}.items():
            object.__setattr__(self, name, values)
        object.__setattr__(self, "distance", np.concatenate(([0.0], np.cumsum(speed[1:] + speed[:-1]) / 2e3)))
        object.__setattr__(self, "energy", np.concatenate(([0.0], np.cumsum(watt[1:] + watt[:-1]) / 2e3)))

    def sample(self, rate_hz: float) -> Columns:
        """Return what sensors measure at a rate, by quantity in SI units; ``fix`` rows come at 5 Hz, others repeat the last."""
        noise = np.random.default_rng(self.seed)
        t = np.arange(0.0, self.seconds - 0.1, 1 / rate_hz)

        def measure(values: np.ndarray, std: float) -> np.ndarray:
            return np.interp(t, self.t, values) + std * noise.standard_normal(t.size)

        volt = 25.4 - 0.02 * np.interp(t, self.t, self.watt) / 25.0
        fix_t = np.floor(t * 5) / 5
        along = np.interp(fix_t, self.t, self.distance)
        first = np.searchsorted(fix_t, fix_t)
        east, north = (
            along * part + 0.01 * noise.standard_normal(t.size)[first]
            for part in (np.cos(COURSE_RAD), np.sin(COURSE_RAD))
        )
        return {
            "t": t,
            "latitude": LATITUDE + north / METRES_PER_DEG,
            "longitude": LONGITUDE + east / METRES_PER_DEG / np.cos(np.radians(LATITUDE)),
            "altitude": 401.0 + 0.02 * noise.standard_normal(t.size)[first],
            "fix_t": fix_t,
            "is_fix": first == np.arange(t.size),
            "left": measure(self.speed, 0.01),
            "right": measure(self.speed, 0.01),
            "volt": volt + 0.005 * noise.standard_normal(t.size),
            "amp": measure(self.watt, 0.0) / volt + 0.02 * noise.standard_normal(t.size),
            **{f"gyro_{axis}": 0.004 * noise.standard_normal(t.size) for axis in "xyz"},
            "acc_x": measure(np.gradient(self.speed, 1e-3), 0.05),
            "acc_y": 0.05 * noise.standard_normal(t.size),
            "acc_z": GRAVITY + 0.05 * noise.standard_normal(t.size),
        }

    def judge(self, segments: object) -> tuple[int, float, float]:
        """Return the number of segments, and the shares of their durations and energies within 2σ of the truth."""
        start = (to_integers(segments, "start_ns") - to_integers(segments, "start_ns")[0]) / 1e9
        begin = (to_integers(segments, "start_ns")[0] - START_NS) / 1e9
        distance = np.interp(begin + start, self.t, self.distance)
        moving = np.concatenate(([True], np.diff(self.distance) > 0))
        end = np.interp(distance + 1.0, self.distance[moving], self.t[moving])
        true = {
            "duration": end - begin - start,
            "energy": np.interp(end, self.t, self.energy) - np.interp(begin + start, self.t, self.energy),
        }
        shares = [
            np.mean(
                np.abs(to_floats(segments, f"{name}_{unit}") - true[name])
                < 2 * to_floats(segments, f"{name}_std_{unit}")
            )
            for name, unit in (("duration", "s"), ("energy", "joule"))
        ]
        return len(start), float(shares[0]), float(shares[1])


def format_local(t: np.ndarray, form: str) -> list[str]:
    """Return local times as texts with milliseconds."""
    local = START.replace(tzinfo=None)
    stamps = pl.Series(np.round(t * 1e3).astype(np.int64)).cast(pl.Duration("ms")) + local
    return stamps.dt.strftime(form).to_list()


def write_text(
    path: Path, columns: Mapping[str, object], *, separator: str = ",", comma: bool = False, encoding: str = "utf-8"
) -> None:
    """Write a table as text, numbers with up to 9 decimals."""
    path.parent.mkdir(parents=True, exist_ok=True)
    frame = pl.DataFrame({name: list(values) for name, values in columns.items()})
    text = frame.write_csv(separator=separator, decimal_comma=comma, float_precision=9)
    path.write_text(text.replace(';""\n', ";\n"), encoding=encoding)


def write_german(drive: Drive, folder: Path) -> None:
    """Write one wide table, encoded as spreadsheets do, with date and time of day apart, decimal commas, repeated fixes, km/h and mA."""
    rows = drive.sample(20)
    columns = {
        "Datum": format_local(rows["t"], "%d.%m.%Y"),
        "Uhrzeit": [text.replace(".", ",") for text in format_local(rows["t"], "%H:%M:%S%.3f")],
        "Breite [°]": rows["latitude"],
        "Länge [°]": rows["longitude"],
        "Höhe [m]": rows["altitude"],
        "Geschwindigkeit links [km/h]": 3.6 * rows["left"],
        "Geschwindigkeit rechts [km/h]": 3.6 * rows["right"],
        "Ubat [V]": rows["volt"],
        "Ibat [mA]": 1000 * rows["amp"],
    }
    write_text(folder / "Messfahrt.csv", columns, separator=";", comma=True, encoding="cp1252")


def write_french(drive: Drive, folder: Path) -> None:
    """Write four tables of one drive with suffixes of their own, and local times as ISO texts without a zone."""
    fast, slow = drive.sample(50), drive.sample(20)
    fixes = {name: values[slow["is_fix"]] for name, values in slow.items()}
    stamps = {
        rate: format_local(rows["t"], "%Y-%m-%d %H:%M:%S%.3f") for rate, rows in ((50, fast), (20, slow), (5, fixes))
    }
    write_text(
        folder / "sortie1_gps.csv",
        {"horodatage": stamps[5], **{name: fixes[name] for name in ("latitude", "longitude", "altitude")}},
    )
    imu = {f"gyro_{axis} (deg/s)": np.degrees(fast[f"gyro_{axis}"]) for axis in "xyz"}
    imu |= {f"acc_{axis} (m/s²)": fast[f"acc_{axis}"] for axis in "xyz"}
    write_text(folder / "sortie1_imu.csv", {"horodatage": stamps[50], **imu})
    write_text(folder / "sortie1_roues.csv", {"horodatage": stamps[20], "vitesse (km/h)": 3.6 * slow["left"]})
    power = {"tension": slow["volt"], "courant": slow["amp"]}
    write_text(folder / "sortie1_puissance.csv", {"horodatage": stamps[20], **power})


def write_spanish(drive: Drive, folder: Path) -> None:
    """Write a Parquet table with times in milliseconds since 1970 and a table of the IMU with tcpipe's own names."""
    rows, fast = drive.sample(20), drive.sample(50)
    columns = {
        "tiempo": START_NS // 10**6 + np.round(1000 * rows["t"]).astype(np.int64),
        "latitud": rows["latitude"],
        "longitud": rows["longitude"],
        "altitud": rows["altitude"],
        "velocidad_rueda": rows["right"],
        "voltaje": rows["volt"],
        "corriente": rows["amp"],
    }
    folder.mkdir(parents=True, exist_ok=True)
    pl.DataFrame(columns).write_parquet(folder / "viaje.parquet")
    imu = {f"angular_velocity_{axis}": fast[f"gyro_{axis}"] for axis in "xyz"}
    imu |= {f"linear_acceleration_{axis}": fast[f"acc_{axis}"] for axis in "xyz"}
    write_text(folder / "imu.csv", {"timestamp": START_NS / 1e9 + fast["t"], **imu})


@dataclass(frozen=True)
class Logger:
    """A logger, what ``init --from`` and ``ingest`` are given (a path in its folder), and the lines that a person edits, by key."""

    write: Callable[[Drive, Path], None]
    given: str
    edits: Mapping[str, str]


LOGGERS = {
    "german": Logger(write_german, "Messfahrt.csv", {"stamp_zone": '"Europe/Vienna"'}),
    "french": Logger(write_french, ".", {"stamp_zone": '"Europe/Vienna"'}),
    "spanish": Logger(write_spanish, ".", {}),
}
