"""The paper's pictures of predictions (its figures 5 to 8): some patches of every class, measured and predicted, and their error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tcpipe.report.colours import FAINT, INK
from tcpipe.report.figures import Array, figure_svg

MEASURED = "#b3202a"
PREDICTED = "#2a6fb0"
MOST_PERCENT = 50.0
"""Where the axis of errors ends, as the paper's; an arrow stands where one is larger."""


def predictions_by_patch(measured: Array, predicted: Array, classes: Sequence[str], *, label: str) -> str:
    """Draw measured and predicted values over the patch number, and below it the absolute percentage error.

    Parameters
    ----------
    measured, predicted
        Shape (N,), sorted by class.
    classes
        Name of each patch's class, shape (N,).
    label
        Of the values, with unit.

    """
    number = np.arange(1, len(measured) + 1)
    with figure_svg(8.2, 3.9) as (figure, out):
        values, error = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        values.plot(number, measured, color=MEASURED, lw=1.1, label="measured")
        values.plot(number, predicted, color=PREDICTED, lw=1.1, label="predicted")
        values.set_ylabel(label)
        values.legend(loc="lower right", bbox_to_anchor=(1.0, 1.14), ncols=2, frameon=False, borderaxespad=0.0)
        percent = 100.0 * np.abs(predicted - measured) / np.abs(measured)
        error.plot(number, percent, color=INK, lw=1.1)
        error.set_ylabel("absolute error [%]")
        error.set_ylim(0.0, MOST_PERCENT)
        beyond = number[percent > MOST_PERCENT]
        error.plot(beyond, np.full(len(beyond), 0.94 * MOST_PERCENT), "^", color=MEASURED, ms=4)
        error.set_xlabel("patch number")
        for shade, name in enumerate(dict.fromkeys(classes)):
            here = number[[entry == name for entry in classes]]
            first, last = here[0] - 0.5, here[-1] + 0.5
            for axes in (values, error):
                axes.axvspan(first, last, color=FAINT if shade % 2 == 0 else "#ffffff", alpha=0.18, lw=0)
            values.text(
                (first + last) / 2,
                1.02,
                name,
                transform=values.get_xaxis_transform(),
                ha="center",
                va="bottom",
                fontsize=8,
            )
        values.set_xlim(0.5, len(number) + 0.5)
    return out[0]


def sums_along(distance_m: Array, panels: Mapping[str, Array]) -> str:
    """Draw what a drive took so far over the distance driven, measured and predicted, with its interval.

    Parameters
    ----------
    distance_m
        Shape (N,).
    panels
        By label with unit: measured, predicted, and the ends of the interval, shape (4, N).

    """
    with figure_svg(8.2, 2.4 * len(panels)) as (figure, out):
        axes_of = np.atleast_1d(figure.subplots(len(panels), 1, sharex=True))
        for axes, (label, (measured, predicted, low, high)) in zip(axes_of, panels.items(), strict=True):
            axes.fill_between(distance_m, low, high, color=PREDICTED, alpha=0.2, lw=0)
            axes.plot(distance_m, measured, color=MEASURED, lw=1.1, label="measured")
            axes.plot(distance_m, predicted, color=PREDICTED, lw=1.1, label="predicted")
            axes.set_ylabel(label)
        axes_of[0].legend(loc="upper left", ncols=2, frameon=False)
        axes_of[-1].set_xlabel("distance driven in segments [m]")
    return out[0]
