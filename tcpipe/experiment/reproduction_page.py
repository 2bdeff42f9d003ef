"""The page of a reproduction: the claims, every training's errors beside the noise floor, and what makes the variance of E."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from tcpipe.experiment.simulation_floor import CLASS_AND_SLOPE, FEWEST_SEEDS, Claim
from tcpipe.learning.evaluation_facts import Evaluation
from tcpipe.learning.evaluation_files import SIMULATED
from tcpipe.learning.evaluation_page import format_leakage
from tcpipe.learning.metrics import ALL, UNITS
from tcpipe.report.page import Section, render_page


def render_reproduction_page(
    runs: Sequence[Evaluation],
    claims: Sequence[Claim],
    *,
    shares: Mapping[str, float],
    hidden_variance: float,
    warnings: Sequence[str],
) -> str:
    """Return the HTML page of the evaluations of all trainings; ``shares`` are of the variance of E, by what makes it."""
    verdicts = Counter(claim.verdict for claim in claims)
    counts = ", ".join(f"{count} {name}" for name, count in verdicts.items())
    audits = (f"{split}: {format_leakage(part.leakage)}" for split, part in runs[0].splits.items())
    return render_page(
        title="The paper's experiment on a simulated site",
        lead=f"Of {len(claims)} claims: {counts}; {len(runs)} training{'s' if len(runs) > 1 else ''}. {' '.join(audits)} "
        "All tables of a training are in seed-N/evaluation/evaluation.html.",
        numbers=[],
        warnings=[SIMULATED, *warnings],
        sections=[
            _make_claims_section(claims),
            _make_errors_section(runs),
            _make_variance_section(shares, hidden_variance),
        ],
    )


def _make_claims_section(claims: Sequence[Claim]) -> Section:
    rows = [
        (
            claim.says, claim.split, claim.verdict, str(claim.ratio),
            "–" if claim.between_seeds is None else f"{100.0 * claim.between_seeds:.0f} %",
            "–" if claim.in_the_paper is None else f"{claim.in_the_paper:.2f}",
        )
        for claim in claims
    ]  # fmt: skip
    text = (
        "RMSE of E of the network over a baseline's, of the same samples, both centred by class: the mean of all trainings, with its 95 % "
        "interval over trainings and test samples. Held if all of it is below 1, NOT held if above, open otherwise, and of fewer than "
        f"{FEWEST_SEEDS} trainings. Height, class and slow ground matter by construction of the site, so they are no claims."
    )
    header = ("claim", "split", "", "here", "between trainings (1σ)", "the paper")
    return Section("Claims of the paper", text, header=header, rows=rows, figures_from=3)


def _make_errors_section(runs: Sequence[Evaluation]) -> Section:
    """Return the errors of each training above those of a predictor that knows the simulator."""
    rows = []
    for split, part in runs[0].splits.items():
        for quantity in ("E", "T"):
            found = [run.splits[split].errors[quantity][ALL] for run in runs]
            floor = [] if part.simulation_floor is None else [part.simulation_floor[quantity][ALL]]
            figures = (
                f"{error.rmse:.3f} {UNITS[quantity]}, {error.mape_percent or float('nan'):.2f} %"
                for error in (*floor, *found)
            )
            rows.append((split, quantity, *figures))
    text = "The floor knows the simulator, map, path and turn without error; hidden variation and the noise of the labels remain."
    header = ("", "", "floor", *(f"seed {number}" for number in range(len(runs))))
    return Section("RMSE and MAPE of every training", text, header=header, rows=rows, figures_from=2)


def _make_variance_section(shares: Mapping[str, float], hidden_variance: float) -> Section:
    """Return the parts of E's variance, and their shares of what class and slope leave."""
    rest = sum(share for name, share in shares.items() if name != CLASS_AND_SLOPE)
    rows = []
    for name, share in shares.items():
        of_rest = "–" if name == CLASS_AND_SLOPE else f"{100.0 * share / rest if rest else float('nan'):.0f} %"
        rows.append((name, f"{100.0 * share:.2f} %", of_rest))
    text = (
        "Of measured E on the unseen area: what a spline over the slope of each class explains; then what such splines leave of what "
        "changes where a part of the simulated world is taken out. They add up to one only as far as they are independent. "
        f"The hidden resistance has {hidden_variance:g} times the variance of the frozen site."
    )
    header = ("source", "of the variance of E", "share of the rest")
    return Section("Variance of E by source", text, header=header, rows=rows, figures_from=1)
