"""The smallest logs that give a run: half a minute straight ahead, by the wheels alone."""

from pathlib import Path

import numpy as np

from tcpipe.formats.logs.writing import MessageStream, write_mcap
from tcpipe.pipeline.options import IngestOptions
from tcpipe.pipeline.status import find_log_states
from tcpipe.recipe import Recipe

START_NS = 1_700_000_000_000_000_000


def wheel_drive(*, seed=0, start_ns=START_NS, rows=1500):
    """The streams of a drive; two of one seed and start are one recording, the shorter the beginning of the longer."""
    log_ns = start_ns + np.arange(rows) * 20_000_000
    velocity_mps = 1.0 + 0.01 * np.random.default_rng(seed).standard_normal(10_000)[:rows]
    columns = {
        "header.stamp.sec": (log_ns // 10**9).astype(np.int32),
        "header.stamp.nanosec": (log_ns % 10**9).astype(np.uint32),
        "pose.pose.position.x": np.cumsum(velocity_mps) * 0.02,
        "pose.pose.orientation.w": np.ones(rows),
        "twist.twist.linear.x": velocity_mps,
    }
    texts = {"header.frame_id": "odom", "child_frame_id": "base_link"}
    return [MessageStream("/wheel/odom", "nav_msgs/msg/Odometry", log_ns, columns, texts)]


def drive_at(path: Path, **how) -> Path:
    """Write the log of a drive, also over another one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    write_mcap(path, wheel_drive(**how))
    return path


def ask_status(store, *logs, **how):
    """Return the status of logs, or of those that were ingested before."""
    return find_log_states(IngestOptions(logs, store=store, **{"recipe": Recipe(), "min_age": 600.0, **how}))
