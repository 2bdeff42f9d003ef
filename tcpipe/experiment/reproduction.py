"""``tcpipe reproduce``: the paper's experiment from a simulated site to its claims; every stage resumes."""

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from tcpipe.errors import DatasetError, clean_lines
from tcpipe.experiment.benchmark import BenchmarkRow, list_tables, run_benchmark
from tcpipe.experiment.claims import FEWEST_SEEDS, Claim, check_claims
from tcpipe.experiment.networks import compare_networks
from tcpipe.formats.atomic import Location, check_new, clear, write_text
from tcpipe.formats.json_files import write_json
from tcpipe.learning.evaluation import UNKNOWN_DISTANCE, EvaluateConfig, Evaluation
from tcpipe.learning.fitting import FitConfig
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.maps import add_map
from tcpipe.progress import logger
from tcpipe.recipe import Recipe
from tcpipe.report.page import PageSection, render_page
from tcpipe.simulation import SimulatedSite, find_scenario, simulate

JSON, PAGE = "reproduction.json", "reproduction.html"
SIMULATED = "The data are simulated: compare the pattern with the paper, not the numbers."
SIMULATION_SEED = 1


@dataclass(frozen=True, slots=True)
class Experiment:
    """Size of an experiment."""

    scenario: str
    fitting: FitConfig
    evaluating: EvaluateConfig
    warning: str = ""


FULL = Experiment("paper", FitConfig(epochs=40, patience=8), EvaluateConfig(noise_draws=5))
"""The paper's size: two hours on two cores for each training."""

SMALL = Experiment(
    "paper_quick",
    FitConfig(epochs=40, patience=8, batch_size=32, learning_rate=1e-3, width=16),
    EvaluateConfig(noise_draws=2),
    "This is the small site, with a narrow network: three short drives, some 300 training samples. "
    "Its figures are not the paper's size.",
)
"""Some minutes for each training, for claims on few samples."""

QUICK = Experiment(
    "paper_quick",
    replace(SMALL.fitting, epochs=4, patience=4),
    SMALL.evaluating,
    "This is a quick run: the small site, a narrow network, few epochs. It only shows that all steps run: "
    "do not use its numbers.",
)
"""Two minutes on two cores: tests all steps; its figures have no meaning."""

Size = Literal["full", "small", "quick"]

SIZES: Mapping[Size, Experiment] = {"full": FULL, "small": SMALL, "quick": QUICK}

RECIPE = replace(Recipe(), robot="husky", split=replace(Recipe().split, holdout="sample"))
"""The defaults with the paper's random test samples."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReproductionSummary:
    """All of reproduction.json."""

    kind: str = "tcpipe reproduction"
    simulated: bool = True
    scenario: str
    plan: Experiment
    claims: tuple[Claim, ...]
    benchmark: tuple[BenchmarkRow, ...]


@dataclass(frozen=True, slots=True)
class Reproduction:
    """Result of a reproduction; the command prints its ``str``."""

    directory: Path
    values: ReproductionSummary
    seconds: Mapping[str, float]
    """Duration of each stage in this call [s]."""

    def __str__(self) -> str:
        """Return every claim with its verdict, as plain lines."""
        claims = self.values.claims
        verdicts = ", ".join(f"{count} {name}" for name, count in _count_verdicts(claims).items())
        return clean_lines(
            (
                "the data are simulated: compare the pattern with the paper, not the numbers",
                *map(str, claims),
                f"of {len(claims)} claims: {verdicts}",
                "spent: " + ", ".join(f"{name} {seconds:.0f} s" for name, seconds in self.seconds.items()),
                f"open {self.directory / PAGE}",
            )
        )


def reproduce(
    directory: Location, *, size: Size = "full", seeds: int = 1, jobs: int = 1, baselines: bool = True
) -> Reproduction:
    """Simulate the paper's site, build the dataset, train, evaluate, and compare with the paper's claims.

    Parameters
    ----------
    directory : the output: new, empty, or an earlier reproduction of the same size, which resumes.
    size : the paper's; the small site, for claims over many trainings; or the small site with few epochs, as a test.
    seeds : number of trainings; five or more decide claims.
    jobs : logs read side by side.
    baselines : train the networks of Wei and Isler; without them their claims are not measured.
    """
    place, plan = Path(directory), SIZES[size]
    clear(place)
    check_new(place, "reproduction", "site")
    made, seconds = find_scenario(plan.scenario), Counter[str]()
    with _measure_time(seconds, "simulate"):
        site = simulate(place / "site", scenario=made, seed=SIMULATION_SEED)
    with _measure_time(seconds, "ingest and build"):
        _build(place, site, jobs)
    with _measure_time(seconds, "train and evaluate"):
        benchmark = run_benchmark(
            [place / "dataset"], place, seeds=seeds, config=plan.fitting, evaluating=plan.evaluating
        )
    runs = benchmark.evaluations["dataset", "resnet18"]
    comparisons = [run.baselines for run in runs]
    if baselines:
        with _measure_time(seconds, "networks of each class"):
            for seed, run in enumerate(runs):
                here = place / "dataset" / f"resnet18-{seed}"
                networks = compare_networks(here / "model", place / "dataset", here / "networks", seed=seed)
                comparisons[seed] = (*run.baselines, *networks)
    claims = tuple(check_claims(comparisons))
    values = ReproductionSummary(scenario=plan.scenario, plan=plan, claims=claims, benchmark=benchmark.values.rows)
    write_json(place / JSON, values)
    write_text(place / PAGE, _render_page(values, runs))
    return Reproduction(place, values, dict(seconds))


def _count_verdicts(claims: Sequence[Claim]) -> Counter[str]:
    return Counter(claim.verdict for claim in claims)


@contextmanager
def _measure_time(seconds: Counter[str], stage: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    seconds[stage] += round(time.perf_counter() - began)


def _build(place: Path, site: SimulatedSite, jobs: int) -> None:
    """Read the logs, add the map and build the dataset, as a user would."""
    store = place / "store"
    ingested = ingest(site.logs, store=store, recipe=RECIPE, jobs=jobs)
    if problems := [problem for result in ingested.results for problem in result.problems]:
        raise DatasetError(*problems)
    rasters: dict[str, Any] = site.rasters
    add_map("site", **rasters, store=store)
    built = build_dataset(place / "dataset", store=store, split=site.region, recipe=RECIPE, jobs=jobs, force=True)
    logger.info("%s", str(built).splitlines()[0])


def _render_page(values: ReproductionSummary, runs: Sequence[Evaluation]) -> str:
    """Return the HTML page of all trainings."""
    claims = values.claims
    audits = (f"{split}: {part.leakage or UNKNOWN_DISTANCE}" for split, part in runs[0].splits.items())
    tables = [
        PageSection(title, header=header, rows=rows, folded=True)
        for title, header, rows in list_tables(values.benchmark)
    ]
    return render_page(
        title="The paper's experiment on a simulated site",
        lead="All tables of a training are in dataset/KIND-SEED/evaluation/evaluation.html.",
        numbers=[
            *((f"{count} of {len(claims)}", f"claims {name}") for name, count in _count_verdicts(claims).items()),
            (f"{len(runs)}", "training" if len(runs) == 1 else "trainings"),
        ],
        warnings=[SIMULATED, *([values.plan.warning] if values.plan.warning else [])],
        sections=[_make_claims_section(claims, " ".join(audits)), *tables],
    )


def _make_claims_section(claims: Sequence[Claim], audit: str) -> PageSection:
    rows = [
        (
            claim.says, claim.split, claim.verdict, str(claim.ratio),
            "–" if claim.between_seeds is None else f"{100.0 * claim.between_seeds:.0f} %",
            "–" if claim.in_the_paper is None else f"{claim.in_the_paper:.2f}",
        )
        for claim in claims
    ]  # fmt: skip
    text = (
        "RMSE of E of the network over a baseline's, of the same samples, with its 95 % interval: "
        "below 1 the network is better.\n"
        "Both are centred by class; the mean of all trainings, its interval over trainings and test samples. "
        f"Held if all of it is below 1, NOT held if above, open otherwise, and of fewer than {FEWEST_SEEDS} trainings. "
        f"Height, class and slow ground matter by construction of the site, so they are no claims. {audit}"
    )
    header = ("claim", "split", "", "here", "between trainings (1σ)", "the paper")
    return PageSection("Claims of the paper", text, header=header, rows=rows)
