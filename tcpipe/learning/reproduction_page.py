"""The page of a reproduction: the claims first, then every table of the first seed beside the paper's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tcpipe.learning.claims import Claim
from tcpipe.learning.evaluation_facts import Evaluation
from tcpipe.learning.evaluation_files import SIMULATED
from tcpipe.learning.evaluation_page import evaluation_page
from tcpipe.learning.metrics import ALL, QUANTITIES, UNITS
from tcpipe.report.page import Section
from tcpipe.simulation.paper_site import paper_parameters

_QUICK = "This is a quick run: a small site, a narrow network, few epochs. It shows that everything runs; believe no figure of it."
_PAPER_SHARES = {"grass": 51, "mud": 9, "unpaved road": 20, "paved road": 20}
_PAPER_COUNTS = {"train": 5142, "test": 1286, "unseen": 4458}


def reproduction_page(
    runs: Sequence[Evaluation],
    claims: Sequence[Claim],
    *,
    splits: Mapping[str, int],
    terrain: Mapping[str, Mapping[str, int]],
    quick: bool,
) -> str:
    """Return the HTML page; ``splits`` and ``terrain`` count the samples by split, and by split and class."""
    held = sum(claim.held for claim in claims)
    return evaluation_page(
        runs[0],
        title="The paper's experiment on a simulated site",
        lead=f"{held} of {len(claims)} claims held; {len(runs)} training{'s' if len(runs) > 1 else ''}.",
        before=[_claims(claims), _shares(splits, terrain), *_seeds(runs), _sources()],
        warnings=[SIMULATED, *([_QUICK] if quick else [])],
    )


def _claims(claims: Sequence[Claim]) -> Section:
    rows = [
        (
            claim.says, claim.split, claim.measure, "held" if claim.held else "not measured" if claim.ratio is None else "NOT held",
            "–" if claim.ratio is None else f"{claim.ratio:.2f}", f"{claim.sign} {claim.wanted:.2f}",
            "–" if claim.in_the_paper is None else f"{claim.in_the_paper:.2f}",
        )
        for claim in claims
    ]  # fmt: skip
    text = "Ratios of MAPE unless they say RMSE; margins were set before the first training. What does not hold is printed as it is."
    header = ("claim", "split", "ratio", "", "here", "wanted", "the paper")
    return Section("Does the pattern of the paper hold?", text, header=header, rows=rows, figures_from=4)


def _shares(splits: Mapping[str, int], terrain: Mapping[str, Mapping[str, int]]) -> Section:
    total = sum(splits.values())
    by_class = {name: sum(part.get(name, 0) for part in terrain.values()) for name in _PAPER_SHARES}
    rows = [
        (name, f"{100.0 * by_class[name] / max(total, 1):.1f} %", f"{share} %") for name, share in _PAPER_SHARES.items()
    ]
    rows += [(f"samples of {name}", f"{splits[name]}", f"{told}") for name, told in _PAPER_COUNTS.items()]
    rows.append(("all samples", f"{total}", "10886"))
    return Section("What was driven", header=("", "here", "the paper"), rows=rows, figures_from=1)


def _seeds(runs: Sequence[Evaluation]) -> list[Section]:
    """Return the spread between trainings, where there are several."""
    if len(runs) < 2:
        return []
    rows = []
    for split in runs[0].splits:
        for quantity in QUANTITIES:
            found = [run.splits[split].errors[quantity][ALL] for run in runs]
            figures = (
                f"{error.rmse:.3f} {UNITS[quantity]}, {error.mape_percent or float('nan'):.2f} %" for error in found
            )
            rows.append((split, quantity, *figures))
    header = ("", "", *(f"seed {number}" for number in range(len(runs))))
    return [Section("Every training: RMSE and MAPE of all classes", header=header, rows=rows, figures_from=2)]


def _sources() -> Section:
    """Return where the simulator's numbers come from."""
    tables = {**paper_parameters()}
    grounds = {f"ground, {name.replace('_', ' ')}": table for name, table in tables.pop("ground").items()}
    rows = [(name, table["source"]) for name, table in {**tables, **grounds}.items()]
    text = "Frozen in tcpipe/simulation/paper_site.toml before the first training."
    return Section("Where the simulator's numbers come from", text, header=("what", "source"), rows=rows)
