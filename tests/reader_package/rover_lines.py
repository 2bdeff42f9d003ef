"""A reader for an invented format: a JSON object a line, with time [s], kind and values. It imports nothing of tcpipe."""

import json

import numpy as np

TYPES = {
    "gps": ("/gps", "sensor_msgs/msg/NavSatFix"),
    "battery": ("/battery", "sensor_msgs/msg/BatteryState"),
    "wheels": ("/wheels/odom", "nav_msgs/msg/Odometry"),
}
FIELDS = {
    "gps": {"latitude": "lat", "longitude": "lon", "altitude": "height"},
    "battery": {"voltage": "volt", "current": "amp"},
    "wheels": {"twist.twist.linear.x": "speed", "twist.twist.angular.z": "turn"},
}


def read(path):
    """Yield name, type, stamps [ns] and a function that returns the fields of each topic of a file."""
    messages = [json.loads(line) for line in path.read_text().splitlines()]
    for kind, (topic, type_name) in TYPES.items():
        rows = sorted((row for row in messages if row["kind"] == kind), key=lambda row: row["time"])
        if rows:
            stamp_ns = np.array([round(row["time"] * 1e9) for row in rows])
            yield topic, type_name, stamp_ns, lambda kind=kind, rows=rows: read_fields(kind, rows)


def read_fields(kind, rows):
    """Return a column of each field, by its name in the message: numbers of shape (N,) or (N, k), or a list of texts."""
    fields = {name: np.array([row[key] for row in rows]) for name, key in FIELDS[kind].items()}
    if kind == "gps":
        covariance = np.tile(np.diag([4e-4, 4e-4, 1e-3]).ravel(), (len(rows), 1))  # [m²], east, north, up
        fields |= {"status.status": np.full(len(rows), 2), "position_covariance": covariance}
        fields |= {"position_covariance_type": np.full(len(rows), 2), "header.frame_id": ["gps_link"] * len(rows)}
    if kind == "wheels":
        fields |= {f"twist.twist.linear.{axis}": np.zeros(len(rows)) for axis in "yz"}
        fields |= {"child_frame_id": ["base_link"] * len(rows)}
    return fields
