"""What the turns of a path cost, by the physics of its robot: so many joules a radian, on the ground where it turns.

A model of patches knows of turning only what its segments did: they were steady and nearly straight. Of a path that turns more than a metre
of them, what is beyond costs ``M |turn|``: the torque of a skid-steered robot hardly depends on how fast it turns
(ADR-13). Nothing is said of the time that a turn takes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.geometry.angles import wrap_to_pi
from tcpipe.tables.facts import PhysicsFit
from tcpipe.terrain.classes import ClassTable

Floats = NDArray[np.float64]

_CLASSES = 256
_ALL = "all"


@dataclass(frozen=True, slots=True)
class Turning:
    """Energy of a turn by class id [J/rad], shape (256,), and what a metre of the model's segments turns anyway [rad/m]."""

    joule_per_rad: Floats
    usual_radpm: float

    def energy_joule(self, turn_rad: Floats, length_m: Floats, class_id: NDArray[np.uint8]) -> Floats:
        """Return what turns cost beyond the usual [J], shape (N,), of N pieces of path of these lengths on these classes."""
        beyond_rad = np.maximum(np.abs(turn_rad) - self.usual_radpm * length_m, 0.0)
        return np.asarray(self.joule_per_rad[class_id] * beyond_rad)


def turning_of(fit: PhysicsFit | None, classes: ClassTable) -> Turning | None:
    """Return what turning costs by a fit; a class that it does not name costs the mean of those that it does. None without such a term."""
    found = {} if fit is None else {of.terrain: of.value for of in fit.terms if of.term == "turning"}
    if fit is None or not found:
        return None
    joule_per_rad = np.full(_CLASSES, found.get(_ALL, float(np.mean(list(found.values())))))
    for class_id, name in enumerate(classes.names().tolist()):
        joule_per_rad[class_id] = found.get(name, joule_per_rad[class_id])
    return Turning(joule_per_rad, fit.usual_turn_radpm)


def turns_between(start_xy_m: Floats, end_xy_m: Floats) -> Floats:
    """Return how far each of N pieces of a path turns [rad], shape (N,): half of the change of course at either of its ends.

    The chords' courses are compared, not those of the drawn line, so that the jitter of its points is no turn.

    Parameters
    ----------
    start_xy_m, end_xy_m : of the pieces, in order, shape (N, 2).
    """
    east, north = (end_xy_m - start_xy_m).T
    change = np.abs(wrap_to_pi(np.diff(np.arctan2(north, east))))
    return np.asarray(0.5 * (np.append(change, 0.0) + np.insert(change, 0, 0.0)))
