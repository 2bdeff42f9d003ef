"""When the recorder received what was measured at a time: by hand, over a step of the clock and in simulated time."""

import numpy as np
import pyarrow as pa

from tcpipe.pipeline.overlay import _Clock

SECOND = 10**9


def clock(stamp_s, log_s, epoch):
    """A clock of rows; log times begin in 2026."""
    columns = {"stamp_ns": stamp_s, "log_time_ns": log_s}
    table = {name: pa.array((np.asarray(values) * SECOND).astype(np.int64)) for name, values in columns.items()}
    return _Clock(pa.table({**table, "clock_epoch": pa.array(epoch, pa.int16())}))


def asked(of, stamp_s, epoch=None):
    epochs = None if epoch is None else np.asarray(epoch, np.int16)
    return (of((np.asarray(stamp_s) * SECOND).astype(np.int64), epochs) / SECOND).tolist()


def test_a_step_of_the_clock_divides_two_delays():
    stepped = clock([100.0, 101.0, 3000.0, 3001.0], [107.0, 108.0, 109.0, 110.0], [0, 0, 1, 1])
    assert asked(stepped, [100.5, 101.5, 2999.5, 3000.25], [0, 0, 1, 1]) == [107.5, 108.5, 108.5, 109.25]
    assert asked(stepped, [100.5, 3000.25]) == [107.5, 109.25]


def test_simulated_time_that_runs_at_half_the_rate_is_stretched():
    simulated = clock([0.0, 10.0, 20.0], [5000.0, 5020.0, 5040.0], [0, 0, 0])
    assert asked(simulated, [0.0, 2.5, 15.0], [0, 0, 0]) == [5000.0, 5005.0, 5030.0]
