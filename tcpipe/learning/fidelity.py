"""Every known difference of the experiment to the paper's, in one place: printed on the page of a reproduction."""

from __future__ import annotations

from collections.abc import Iterator

from tcpipe.learning.evaluation_facts import Evaluation
from tcpipe.learning.metrics import ALL, LEAST, UNITS

DIFFERENCES = (
    ("data", "a Husky in a field in Austria", "a simulated site; what can be compared is the pattern"),
    ("framework", "Keras", "PyTorch; padding, initial weights, batch normalisation and Adam's ε as Keras has them"),
    ("input", "channels in the order O, C, H", "the same order; class 0 (no data) counts as the tensor has it, 0"),
    ("head", "'adapted for image regression on two variables'", "global mean, one dense layer to both, starting at the labels' mean"),
    ("loss", "equation 4, α = 1 / max w, which has a dimension", "1 / max²; the paper's as printed is --loss paper_eq4"),
    ("optimiser, batch, epochs", "not told", "Adam, 64, until a fold of train gets no better; the rate falls"),
    ("mirrors", "not told", "every other patch is mirrored across its travel"),
    ("who stops the training", "not told; 'validation' is the unseen area", "a fold of train, a fifth, which is not fitted"),
    ("power, velocity", "means of samples at 20 Hz", "w = E / T, v = d / T: E = w d / v holds exactly"),
    ("order of figures", "tables of w, v, T, E; table III of w, v, E, T", "the same tables in the same order, each row beside the paper's"),
    ("ablation", "a layer becomes random noise; distribution and draws not told", "uniform in [0, 1] per pixel, mean of several draws"),
    ("Wei and Isler: architecture", "'the approach from' their paper: heights to E", "our ResNet-18, heights alone, one output"),
    ("Wei and Isler: loss", "not told", "nrmse of one output, which is the mean absolute error"),
    ("Wei and Isler: length of training", "not told", "as many steps as the one net, stopped by as many steps without a better loss"),
    ("Wei and Isler: samples", "all", "table IV has all rows on the samples whose class has a net of its own"),
    ("test samples", "random, 80 / 20", "random, 80 / 20: most lie within a patch of a training sample"),
)  # fmt: skip
"""What, in the paper, here."""


def differences(found: Evaluation) -> Iterator[tuple[str, str, str]]:
    """Yield them, and what every MAPE of an evaluation leaves out, with counts."""
    yield from DIFFERENCES
    for split, part in found.splits.items():
        left = {
            quantity: errors[ALL].count - errors[ALL].mape_count
            for quantity, errors in part.errors.items()
            if ALL in errors
        }
        told = ", ".join(
            f"{quantity} {count} (below {LEAST[quantity]:g} {UNITS[quantity]})" for quantity, count in left.items()
        )
        yield f"MAPE, {split}", "of all samples; labels near nothing not told", f"left out of {part.samples}: {told}"
