"""What the 15-state filter takes and gives, as its kernel does: belief, sources, events, outcomes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

NOT_RUN = 0
"""Outcome of a measurement that was not reached."""
ACCEPTED = 1
"""Outcome: fused."""
REJECTED = 2
"""Outcome: refused by the gate."""
RECOVERED = 3
"""Outcome: fused although outside the gate, after the states it measures were opened up (see `tcpipe.fusion.ukf15_kernel.run`)."""


class FilterState(NamedTuple):
    """What the filter knows at one moment; moved in place, so that a long run can be filtered in blocks."""

    x: NDArray[np.float64]
    """State, shape (16,), the last entry 0."""
    P: NDArray[np.float64]
    """Covariance, shape (15, 16), the last column 0."""
    clock_s: NDArray[np.float64]
    """Its time, seconds since the run's origin, shape (1,)."""
    refused: NDArray[np.float64]
    """Per source, how often it has been refused without a break, and since when [s], shape (S, 2)."""


class Sources(NamedTuple):
    """What each source measures; see `tcpipe.fusion.ukf15_kernel.update`."""

    kind: NDArray[np.int64]
    """`SELECT`, `ANTENNA`, `SPECIFIC_FORCE` or `SENSOR_VELOCITY`, shape (S,)."""
    width: NDArray[np.int64]
    """Entries in a measurement, shape (S,)."""
    entries: NDArray[np.int64]
    """Which states, or which of the sensor's three entries, shape (S, 6)."""
    lever_m: NDArray[np.float64]
    """Position of the sensor in base_link [m], shape (S, 3)."""
    gate: NDArray[np.float64]
    """Largest normalised innovation squared that is fused, shape (S,)."""


class Events(NamedTuple):
    """All measurements of a run in order of time."""

    time_s: NDArray[np.float64]
    """Seconds since the run's origin, ascending, shape (E,)."""
    source: NDArray[np.int8]
    """Which source, shape (E,)."""
    at: NDArray[np.int64]
    """Where in ``z`` the measurement begins, shape (E,)."""
    z: NDArray[np.float64]
    """Measurements, end to end."""
    variance: NDArray[np.float64]
    """Their variances, end to end."""


class Outputs(NamedTuple):
    """What a run writes."""

    time_s: NDArray[np.float64]
    """When the state is wanted, seconds since the run's origin, ascending, shape (K,)."""
    x: NDArray[np.float64]
    """States, shape (K, 15)."""
    variance: NDArray[np.float64]
    """Their variances, shape (K, 15)."""
    nis: NDArray[np.float64]
    """Normalised innovation squared of each event, shape (E,)."""
    outcome: NDArray[np.int8]
    """`NOT_RUN`, `ACCEPTED`, `REJECTED` or `RECOVERED`, shape (E,)."""
