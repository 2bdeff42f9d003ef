"""The paper's claims (sections V, VI) as ratios of figures: each holds or does not, by a margin set before any training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tcpipe.learning import paper_tables as paper
from tcpipe.learning.evaluation import EXPECTED, GRASS_ONLY, OURS, PER_CLASS
from tcpipe.learning.evaluation_facts import SPLITS, Evaluation
from tcpipe.learning.metrics import ALL, QUANTITIES, Errors

NOTICEABLE, WIDE, FLOOR_FACTOR = 1.1, 1.5, 1.5


@dataclass(frozen=True, slots=True)
class Claim:
    """One comparison on one split: ``ratio`` should be at least, or at most, ``wanted``."""

    says: str
    split: str
    measure: str
    """What the ratio is of."""
    ratio: float | None
    """None: it could not be measured."""
    at_least: bool
    wanted: float
    in_the_paper: float | None
    held: bool
    """Whether it holds here."""

    def __str__(self) -> str:
        """Return the claim, its figure and its verdict as one line."""
        verdict = "held" if self.held else "NOT held" if self.ratio is not None else "not measured"
        figure = "–" if self.ratio is None else f"{self.ratio:.2f}"
        paper = "" if self.in_the_paper is None else f", {self.in_the_paper:.2f} in the paper"
        return f"{verdict}: {self.says}, {self.split}: {self.measure} {figure} (wanted {self.sign} {self.wanted:.2f}{paper})"

    @property
    def sign(self) -> str:
        """Return how the ratio should stand to what is wanted."""
        return "≥" if self.at_least else "≤"


def checked_claims(runs: Sequence[Evaluation]) -> list[Claim]:
    """Return every claim with its ratio, of errors averaged over the runs (one evaluation a seed)."""
    found = []
    for split in runs[0].splits:
        mean, told = _mean_figures([_figures(run, split) for run in runs]), _paper_figures(split)
        for says, measure, numerator, denominator, wanted in _CLAIMS:
            if split == "unseen" or says != _OF_UNSEEN:
                ratio, paper_ratio = (_over(said.get(numerator), said.get(denominator)) for said in (mean, told))
                found.append(
                    _claim(says, split, measure, ratio, at_least=True, wanted=wanted, in_the_paper=paper_ratio)
                )
        floors = [quantity for quantity in QUANTITIES if f"floor {quantity}" in mean and split == "unseen"]
        measure = "RMSE, one net : simulator known"
        for quantity in floors:
            ratio = _over(mean[quantity], mean[f"floor {quantity}"])
            found.append(
                _claim(
                    f"{quantity} is as good as can be",
                    split,
                    measure,
                    ratio,
                    at_least=False,
                    wanted=FLOOR_FACTOR,
                    in_the_paper=None,
                )
            )
    return found


def _claim(
    says: str,
    split: str,
    measure: str,
    ratio: float | None,
    *,
    at_least: bool,
    wanted: float,
    in_the_paper: float | None,
) -> Claim:
    held = ratio is not None and (ratio >= wanted if at_least else ratio <= wanted)
    return Claim(says, split, measure, ratio, at_least, wanted, in_the_paper, held)


_OF_UNSEEN = "class matters for unseen areas"

_CLAIMS = (
    ("height matters most", "E, without H : without O or C", "without H", "without O or C", WIDE),
    (_OF_UNSEEN, "E, without C : all layers", "without C", "all layers", NOTICEABLE),
    ("one net beats grass-only by far", "E, grass only : one net", GRASS_ONLY, OURS, WIDE),
    ("one net beats per-class nets", "E, a net per class : one net", PER_CLASS, OURS, 1.0),
    ("T is far better than expected time", "T, expected : one net", EXPECTED, "T of one net", WIDE),
)
"""What is said, of what, numerator and denominator, the least ratio."""


def _figures(run: Evaluation, split: str) -> dict[str, float | None]:
    """Return what the claims compare, of one evaluation."""
    left = {"".join(row.layers): row.on(split)["E"].mape_percent for row in run.ablation if row.how == "noise"}
    figures = _without_layers(left)
    for who in (OURS, GRASS_ONLY, PER_CLASS):
        figures[who] = _percent(run.energy, who, split)
    figures["T of one net"] = _percent(run.time, OURS, split)
    figures[EXPECTED] = _percent(run.time, EXPECTED, split)
    part = run.splits[split]
    for quantity, by_class in (part.simulation_floor or {}).items():
        figures[quantity] = part.errors[quantity][ALL].rmse
        figures[f"floor {quantity}"] = by_class[ALL].rmse
    return figures


def _percent(table: Mapping[str, Mapping[str, Errors]], who: str, split: str) -> float | None:
    found = table.get(who, {}).get(split)
    return None if found is None else found.mape_percent


def _paper_figures(split: str) -> dict[str, float | None]:
    """Return the same of the paper's tables III to V."""
    at = SPLITS.index(split)
    energy = paper.ABLATION_COLUMNS.index(("E", "mape_percent"))
    figures = _without_layers({"".join(layers): rows[at][energy] for layers, rows in paper.ABLATION.items()})
    figures |= {who: rows[at][1] for who, rows in paper.ENERGY.items()}
    return figures | {EXPECTED: paper.TIME[EXPECTED][at][1], "T of one net": paper.TIME[OURS][at][1]}


def _without_layers(left: Mapping[str, float | None]) -> dict[str, float | None]:
    """Return errors of E without a layer, from those by the layers that are left."""
    others = [error for letters in ("CH", "OH") if (error := left.get(letters)) is not None]
    return {
        "without H": left.get("OC"),
        "without C": left.get("OH"),
        "all layers": left.get("OCH"),
        "without O or C": max(others, default=None),
    }


def _mean_figures(found: Sequence[Mapping[str, float | None]]) -> dict[str, float | None]:
    """Return the means over the runs; None where a run has none."""
    mean: dict[str, float | None] = {}
    for name in found[0]:
        values = [value for figures in found if (value := figures[name]) is not None]
        mean[name] = sum(values) / len(values) if len(values) == len(found) else None
    return mean


def _over(value: float | None, other: float | None) -> float | None:
    return None if value is None or not other else value / other
