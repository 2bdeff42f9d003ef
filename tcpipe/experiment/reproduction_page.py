"""The page of a reproduction: the claims first, then every table of the first seed beside the paper's."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from tcpipe.experiment.simulation_floor import CLASS_AND_SLOPE, Claim
from tcpipe.learning.evaluation_facts import Evaluation
from tcpipe.learning.evaluation_figures import EvaluatedSamples
from tcpipe.learning.evaluation_files import SIMULATED
from tcpipe.learning.evaluation_page import format_audit, render_evaluation_page
from tcpipe.learning.metrics import ALL, LEAST, QUANTITIES, UNITS
from tcpipe.report.page import Section
from tcpipe.simulation.paper_site import read_paper_parameters

_QUICK = "This is a quick run: a small site, a narrow network, few epochs. It only shows that all steps run: do not use its numbers."
_PAPER_SHARES = {"grass": 51, "mud": 9, "unpaved road": 20, "paved road": 20}
_PAPER_COUNTS = {"train": 5142, "test": 1286, "unseen": 4458}


def render_reproduction_page(
    runs: Sequence[Evaluation],
    samples: EvaluatedSamples,
    claims: Sequence[Claim],
    *,
    splits: Mapping[str, int],
    terrain: Mapping[str, Mapping[str, int]],
    shares: Mapping[str, float],
    hidden_variance: float,
    quick: bool,
) -> str:
    """Return the HTML page.

    ``samples`` are those of the first run. ``splits`` and ``terrain`` count the samples by split, and by split and class; ``shares`` are
    of the variance of E, and ``hidden`` is the variance of the hidden resistance over the frozen site's.
    """
    verdicts = Counter(claim.verdict for claim in claims)
    differences = [*DIFFERENCES, *_count_labels_without_mape(runs[0])]
    counts = ", ".join(f"{count} {name}" for name, count in verdicts.items())
    return render_evaluation_page(
        runs[0],
        samples,
        title="The paper's experiment on a simulated site",
        lead=f"Of {len(claims)} claims: {counts}; {len(runs)} training{'s' if len(runs) > 1 else ''}.",
        before=[
            _make_claims_section(claims, format_audit(runs[0])),
            _make_floor_section(runs[0]),
            _make_variance_section(shares, hidden_variance),
            _make_drives_section(splits, terrain),
            *_make_seed_sections(runs),
            Section("Where this differs from the paper", header=("", "the paper", "here"), rows=differences),
            _make_sources_section(quick=quick),
        ],
        warnings=[SIMULATED, *([_QUICK] if quick else [])],
    )


def _make_claims_section(claims: Sequence[Claim], audit: str) -> Section:
    rows = [
        (claim.says, claim.split, claim.verdict, str(claim.ratio), "–" if claim.in_the_paper is None else f"{claim.in_the_paper:.2f}")
        for claim in claims
    ]  # fmt: skip
    text = (
        "RMSE of E of the network over a baseline's, of the same samples, with its 95 % interval: held if all of it lies below 1, NOT held "
        "if above, open if it contains 1. Height, class and slow ground matter by construction of the site, so they are no claims. "
        + audit
    )
    header = ("claim", "split", "", "here", "the paper")
    return Section("Claims of the paper", text, header=header, rows=rows, figures_from=3)


def _make_floor_section(run: Evaluation) -> Section:
    """Return errors above those of a predictor that knows the simulator."""
    rows = []
    for split, part in run.splits.items():
        for quantity, by_class in (part.simulation_floor or {}).items():
            here, least = part.errors[quantity][ALL], by_class[ALL]
            if here.rmse is None or least.rmse is None or here.mape_percent is None or least.mape_percent is None:
                continue
            rmse = (f"{value:.3f} {UNITS[quantity]}" for value in (here.rmse, least.rmse, here.rmse - least.rmse))
            mape = (here.mape_percent, least.mape_percent, here.mape_percent - least.mape_percent)
            rows.append((split, quantity, *rmse, *(f"{value:.2f} %" for value in mape)))
    text = "The floor knows the simulator, map, path and turn without error; hidden variation and the noise of the labels remain. "
    text += format_audit(run)
    header = ("", "", "RMSE", "of the floor", "excess", "MAPE", "of the floor", "excess")
    return Section("Error relative to the noise floor", text, header=header, rows=rows, figures_from=2)


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


def _make_drives_section(splits: Mapping[str, int], terrain: Mapping[str, Mapping[str, int]]) -> Section:
    total = sum(splits.values())
    by_class = {name: sum(part.get(name, 0) for part in terrain.values()) for name in _PAPER_SHARES}
    rows = [
        (name, f"{100.0 * by_class[name] / max(total, 1):.1f} %", f"{share} %") for name, share in _PAPER_SHARES.items()
    ]
    rows += [(f"samples of {name}", f"{splits[name]}", f"{told}") for name, told in _PAPER_COUNTS.items()]
    rows.append(("all samples", f"{total}", "10886"))
    return Section("Driven distance by class", header=("", "here", "the paper"), rows=rows, figures_from=1)


def _make_seed_sections(runs: Sequence[Evaluation]) -> list[Section]:
    """Return the errors of each training, if there are several."""
    if len(runs) < 2:
        return []
    rows = []
    for split in runs[0].splits:
        for quantity in QUANTITIES:
            found = [run.splits[split].errors[quantity][ALL] for run in runs]
            figures = (
                f"{error.rmse:.3f} {UNITS[quantity]}, {error.mape_percent or float('nan'):.2f} % ({error.mape_count})"
                for error in found
            )
            rows.append((split, quantity, *figures))
    header = ("", "", *(f"seed {number}" for number in range(len(runs))))
    title = "Every training: RMSE and MAPE of all classes"
    return [Section(title, format_audit(runs[0]), header=header, rows=rows, figures_from=2)]


def _make_sources_section(*, quick: bool) -> Section:
    """Return where the numbers of the run's own site come from."""
    tables = {
        name: table for name, table in read_paper_parameters().items() if not (quick and name in {"site", "drives"})
    }
    grouped = {
        f"{group}, {name.replace('_', ' ')}": table
        for group in ("look", "ground")
        for name, table in tables.pop(group).items()
    }
    rows = [(name, table["source"]) for name, table in {**tables, **grouped}.items()]
    if quick:
        rows.insert(0, ("site, drives", "made up: the small site of `tcpipe demo`, three short drives"))
    text = "Frozen in tcpipe/simulation/paper_site.toml before the first training."
    return Section("Sources of the simulator's parameters", text, header=("what", "source"), rows=rows)


DIFFERENCES = (
    ("data", "a Husky in a field in Austria", "a simulated site; what can be compared is the pattern"),
    ("framework", "Keras", "PyTorch; padding, initial weights, batch normalisation and Adam's ε as Keras has them"),
    ("input", "channels in the order O, C, H", "the same order; class 0 (no data) counts as the tensor has it, 0"),
    ("head", "'adapted for image regression on two variables'", "global mean, one dense layer to both, starting at the labels' mean"),
    ("loss", "equation 4, α = 1 / max w, which has a dimension", "1 / max²; the paper's as printed is --loss paper_eq4"),
    ("optimiser, batch, epochs", "not told", "Adam, 64, until a fold of train gets no better; the rate falls"),
    ("mirrors", "not told", "every other patch is mirrored across its travel"),
    ("early stopping by", "not stated; 'validation' is the unseen area", "a fold of train, a fifth, which is not fitted"),
    ("power, velocity", "means of samples at 20 Hz", "w = E / T, v = d / T: E = w d / v is exact"),
    ("order of figures", "tables of w, v, T, E; table III of w, v, E, T", "the same tables in the same order, each row beside the paper's"),
    ("ablation", "a layer becomes random noise; distribution and draws not stated", "uniform in [0, 1] per pixel, mean of several draws"),
    ("Wei and Isler: architecture", "'the approach from' their paper: heights to E", "our ResNet-18, heights alone, one output"),
    ("Wei and Isler: loss", "not told", "nrmse of one output, which is the mean absolute error"),
    ("Wei and Isler: length of training", "not told", "as many steps as the one net, stopped by as many steps without a better loss"),
    ("Wei and Isler: samples", "all", "table IV has all rows on the samples whose class has a net of its own"),
    ("test samples", "random, 80 / 20", "random, 80 / 20: most lie within a patch of a training sample"),
)  # fmt: skip
"""Subject, the paper, tcpipe."""


def _count_labels_without_mape(found: Evaluation) -> Iterator[tuple[str, str, str]]:
    for split, part in found.splits.items():
        counts = ", ".join(
            f"{quantity} {errors[ALL].count - errors[ALL].mape_count} (below {LEAST[quantity]:g} {UNITS[quantity]})"
            for quantity, errors in part.errors.items()
            if ALL in errors
        )
        yield f"MAPE, {split}", "of all samples; labels near zero not stated", f"left out of {part.samples}: {counts}"
