"""One simulated drive as messages in memory, of which a test leaves sensors out or changes what they say."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tcpipe.formats.logs.writing import MessageStream
from tcpipe.simulation import Faults, Truth, compute_true_cost, find_scenario
from tcpipe.simulation.messages import TOPICS
from tcpipe.simulation.route import Wander
from tcpipe.simulation.site_files import simulate_messages
from tcpipe.store import Store
from tcpipe.tables.columns import to_floats, to_integers

NAMES = TOPICS["ros2"]
Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Drive:
    truth: Truth
    messages: tuple[MessageStream, ...]

    def without(self, *sensors: str) -> "Drive":
        return Drive(self.truth, tuple(m for m in self.messages if m.topic not in {NAMES[s] for s in sensors}))

    def changed(self, sensor: str, change: Callable[[Columns], Mapping[str, np.ndarray]]) -> "Drive":
        """Every column of a sensor's messages may be replaced; ``change`` gets copies of all, constants as columns too."""

        def apply(m: MessageStream) -> MessageStream:
            if m.topic != NAMES[sensor]:
                return m
            columns = {name: np.array(values) for name, values in m.columns.items()}
            return replace(m, columns={**columns, **change(columns)})

        return Drive(self.truth, tuple(apply(m) for m in self.messages))


def make(plan=None, *, placements: bool = True) -> Drive:
    demo = find_scenario("demo")
    spec = demo.drives[0]
    spec = replace(
        spec,
        plan=plan or Wander(40.0, (110.0, 30.0)),
        recorder=replace(spec.recorder, placements=placements),
        faults=replace(Faults.every(), gnss_outage=False, visual_dropouts=False, power_gap=False),
    )
    demo = replace(demo, drives=(spec,))
    truth, messages = simulate_messages(demo, seed=5)
    return Drive(truth, tuple(messages))


def energy_ratio(drive: Drive, store: Path) -> float:
    """Return the energy of the segments of a store's only run over what they truly took."""
    (run,) = Store(store).runs()
    segments = run.segments()
    assert segments.num_rows > 15
    true = compute_true_cost(drive.truth, to_integers(segments, "start_ns"))
    return float(to_floats(segments, "energy_joule").sum() / true.energy_joule.sum())
