"""Whether runs of robots that no profile knows can be of one robot: their sensors tell."""

from __future__ import annotations

from collections.abc import Mapping

from tcpipe.formats.index_files import KnownSensor
from tcpipe.tables.levels import Sensor

Seen = dict[str, tuple[str, str, str]]
"""By role: a sensor's topic, its type and its frame, as far as a run shows them."""


def alike(sensors: Mapping[str, Mapping[str, Sensor | KnownSensor]]) -> list[tuple[list[str], Seen]]:
    """Return groups of runs, and what is seen of each, so that all sensors within one agree in type, frame and namespace.

    A run belongs to the first group with which it shares a role and differs in none: a sensor may be off for a drive.

    Parameters
    ----------
    sensors : by run and role, what its run.json says of the sensor.
    """
    groups: list[tuple[list[str], Seen]] = []
    seen = {run_id: _seen(of) for run_id, of in sensors.items()}
    for run_id, mine in sorted(seen.items(), key=lambda item: (-len(item[1]), item[0])):
        for runs, theirs in groups:
            shared = mine.keys() & theirs.keys()
            if all(_agree(mine[role], theirs[role]) for role in shared) and (shared or not (mine or theirs)):
                runs.append(run_id)
                theirs.update({role: of for role, of in mine.items() if role not in theirs})
                break
        else:
            groups.append(([run_id], mine))
    return groups


def in_words(seen: Seen) -> str:
    """Return what is seen of a robot as one line."""
    parts = (f"{role} {topic} ({kind}, frame {frame or 'none'})" for role, (topic, kind, frame) in sorted(seen.items()))
    return ", ".join(parts) or "no sensor is known"


def _seen(sensors: Mapping[str, Sensor | KnownSensor]) -> Seen:
    return {role: (of.topic, of.type_name, of.frame_id.strip("/")) for role, of in sensors.items()}


def _agree(one: tuple[str, str, str], other: tuple[str, str, str]) -> bool:
    return one[1:] == other[1:] and not _in_two_namespaces(one[0], other[0])


def _in_two_namespaces(one: str, other: str) -> bool:
    """Return whether two topics are one but for what their names begin with: /imu, /rover1/imu and /rover2/imu."""
    a, b = one.strip("/").split("/"), other.strip("/").split("/")
    return a != b and (a[1:] == b or a == b[1:] or (a[1:] == b[1:] and len(a) > 1))
