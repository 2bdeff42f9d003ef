"""Cut of a steady path into segments by chord (paper, section IV: straight-line distance d, path nearly as long).

A segment ends where the path is first d away from the segment's start, and the next one starts at exactly that state.
If the path between is too curved, the start moves to the next sample of the track, until a segment from there is
straight enough; the skipped metres are *curved*. Moving by one sample rather than to the end of the rejected piece
recovers the straight metres behind a bend. The remainder at the end, shorter than a chord, is *leftover*.

Also: cutting a planned line by chord.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tcpipe.arrays import Ints
from tcpipe.geometry.polyline import Polyline

_LEAST_M = 1e-3  # A rest shorter than this is the rounding of coordinates, not a piece [m]


@dataclass(frozen=True, slots=True)
class Cut:
    """The segments of one section, and the metres outside segments.

    Attributes
    ----------
    start_ns, end_ns : [ns], shape (M,), int64; in order, never overlapping.
    curved_ns, leftover_ns : [ns], shape (C, 2) and (L, 2), int64: begin and end of every other piece; all three
        together tile the path.
    """

    start_ns: Ints
    end_ns: Ints
    curved_ns: Ints
    leftover_ns: Ints

    def ledger(self, path: Polyline) -> dict[str, tuple[float, float]]:
        """Return horizontal metres and seconds of the three kinds by name; their sums are those of the section."""
        spans = {
            "kept": np.column_stack((self.start_ns, self.end_ns)),
            "curved": self.curved_ns,
            "leftover": self.leftover_ns,
        }
        return {
            name: (float((path.length_at(ns[:, 1]) - path.length_at(ns[:, 0])).sum()), float(np.diff(ns).sum()) * 1e-9)
            for name, ns in spans.items()
        }


def cut_by_chord(path: Polyline, *, chord_m: float, max_arc_to_chord: float) -> Cut:
    """Return the segments of a section, starting at its first sample.

    Parameters
    ----------
    path : the section.
    chord_m : [m], d.
    max_arc_to_chord : [1], a segment whose horizontal arc is longer than this times ``chord_m`` is too curved.
    """
    kept: list[tuple[int, int]] = []
    curved: list[tuple[int, int]] = []
    start, last = int(path.stamp_ns[0]), int(path.stamp_ns[-1])
    while start < last:
        end = path.first_crossing_ns(start, radius_m=chord_m)
        if end is None:
            break
        begin_m, end_m = path.length_at(np.array([start, end]))
        if end_m - begin_m <= max_arc_to_chord * chord_m:
            kept.append((start, end))
            start = end
            continue
        following = int(path.stamp_ns[np.searchsorted(path.stamp_ns, start, side="right")])
        if curved and curved[-1][1] == start:
            curved[-1] = (curved[-1][0], following)
        else:
            curved.append((start, following))
        start = following
    spans = _find_spans(kept)
    return Cut(spans[:, 0], spans[:, 1], _find_spans(curved), _find_spans([(start, last)] if start < last else []))


def _find_spans(pairs: list[tuple[int, int]]) -> Ints:
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def find_cuts(points: list[list[float]], radius: float) -> list[tuple[float, float, float]]:
    """Return x, y and length so far of the path's start, of each cut and, if a rest is left, of its end."""
    (x0, y0), length = points[0], 0.0
    cuts = [(x0, y0, 0.0)]
    for (ax, ay), (bx, by) in pairwise(points):
        side = math.hypot(bx - ax, by - ay)
        ux, uy = (bx - ax) / side, (by - ay) / side
        while True:  # the point at s along this side is `radius` from the last cut
            along, offset = (x0 - ax) * ux + (y0 - ay) * uy, (x0 - ax) * uy - (y0 - ay) * ux
            s = along + math.sqrt(max(radius * radius - offset * offset, 0.0))
            if s > side:
                break
            x0, y0 = ax + s * ux, ay + s * uy
            cuts.append((x0, y0, length + s))
        length += side
    rest = math.hypot(points[-1][0] - x0, points[-1][1] - y0)
    if rest > _LEAST_M and length - cuts[-1][2] > _LEAST_M:
        cuts.append((points[-1][0], points[-1][1], length))
    return cuts
