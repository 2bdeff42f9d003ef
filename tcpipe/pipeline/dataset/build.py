"""Building a dataset from labelled segments and maps: sample, split, audit, write; complete or not at all."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Container, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from tcpipe import __version__
from tcpipe.errors import DatasetError, StoreError, UsageError, clean_lines, list_first
from tcpipe.execution import refuse_import_of_script
from tcpipe.formats.atomic import check_local_output, clear_beside, write_atomic_directory
from tcpipe.formats.bucket_directories import fetch_directory_by_range, find_newest
from tcpipe.formats.commits import CallRecord, Dataset, Entries
from tcpipe.formats.dataset_card import DatasetCard, group_dataset_findings
from tcpipe.formats.dataset_files import (
    CARD,
    find_foreign_files,
    keep_foreign_files,
    parse_card,
    read_card,
    read_intact_card,
)
from tcpipe.formats.finding_lines import format_budget, format_mixed_groups, list_verdict
from tcpipe.formats.object_storage import is_url, make_absolute
from tcpipe.formats.parquet import return_freed_memory
from tcpipe.formats.place import open_place
from tcpipe.motion.distance_breakdown import KEPT
from tcpipe.pipeline.calls import (
    BUILD,
    Estimate,
    LogWriter,
    commit_call,
    estimate,
    open_log,
    start_stopwatch,
)
from tcpipe.pipeline.dataset.inputs import Inputs, choose_inputs, find_other_options
from tcpipe.pipeline.dataset.options import BuildOptions, merge_recipe, read_build_options
from tcpipe.pipeline.dataset.runs import CHOICE_CODES, find_gone_runs
from tcpipe.pipeline.generations import read_generations, write_generation
from tcpipe.pipeline.options import BuildDatasetOptions
from tcpipe.splits.assignment import SPLITS
from tcpipe.store import open_store
from tcpipe.tables.findings import Finding, is_problem, select_problems
from tcpipe.tables.options import as_function

logger = logging.getLogger("tcpipe")


@dataclass(frozen=True, slots=True)
class BuildResult:
    """Result of a build; the command prints its ``str``."""

    path: str
    """Its directory, or its URL in a bucket."""
    status: str
    """``done``, ``unchanged``, or, of a dry run, ``planned``."""
    findings: tuple[Finding, ...]
    """Findings of the dataset itself, with excluded runs and empty splits."""
    card: DatasetCard | None = None
    """None for a dry run."""
    exit_code: int = 0
    """3 if a finding is a problem."""
    recipe: str = ""
    """The recipe's source, as a command found it."""
    estimate: Estimate | None = None
    """Estimate of a dry run, as if each segment became a sample."""
    foreign_files: tuple[str, ...] = ()
    """Files in its directory that tcpipe did not write, and keeps."""

    def __str__(self) -> str:
        """Return counts, distance breakdown, noise floor, verdict and findings, as plain lines."""
        return self.format(self.finding_lines(problems=True))

    def format(self, problem_lines: Sequence[str] = ()) -> str:
        """Return the lines of ``str``; a command prints problems as errors instead."""
        return clean_lines((*self._facts(), *problem_lines, *self.finding_lines(problems=False), *self._closing()))

    def finding_lines(self, *, problems: bool) -> list[str]:
        """Return a line for each code that makes the exit code 3, or for each other code."""
        own = [finding for finding in self.findings if is_problem(finding) == problems]
        by_run = self.card.findings_by_run if self.card else {}
        by_map = self.card.findings_by_map if self.card and not problems else {}
        groups = group_dataset_findings(own, dict.fromkeys(by_run, ()) if problems else by_run, by_map)
        return format_mixed_groups(groups, more=f"tcpipe inspect {shlex.quote(self.path)}")

    def _facts(self) -> list[str]:
        card = self.card
        if card is None:
            return [f"{self.path}: would have at most {self.estimate}"]
        counts = ", ".join(f"{card.splits[name]} {name}" for name in SPLITS)
        head = f"{self.path}: {card.samples} samples ({counts})"
        if self.status == "unchanged":
            head += "; nothing to do: it is made from the same runs, map, region and recipe"
        lost = [(-metres, name) for name, metres in card.distance_by_reason_m.items() if metres >= 0.5 and name != KEPT]
        ledger = f"{sum(card.distance_by_reason_m.values()):.0f} m driven: {card.distance_by_reason_m[KEPT]:.0f} m in samples"
        ledger += "".join(f", {-metres:.0f} m {name.replace('_', ' ')}" for metres, name in sorted(lost))
        floor = [] if card.energy_budget is None else [format_budget(card.energy_budget)]
        verdict = (f"verdict: {line}" for line in list_verdict(card.verdict))
        return [head, ledger, *map(str, card.exclusions), *floor, *verdict]

    def _closing(self) -> list[str]:
        names = list_first(self.foreign_files, most=3)
        kept = [f"{self.path}: contains {names}, not of the dataset; kept"] if names else []
        if self.card is None or self.card.redaction is None:
            return kept
        publish = f"publish it with: hf upload OWNER/NAME {shlex.quote(self.path)} . --repo-type dataset"
        return [*kept, *self.card.redaction.lines(), publish]


def run_build_dataset(options: BuildDatasetOptions) -> BuildResult:
    """Sample a rotated patch for every segment, split by region, and write the dataset to ``out``.

    Findings on damaged runs (which are excluded), runs to be ingested again, runs that only the replaced dataset has, and empty splits make
    the exit code 3. The bytes do not depend on ``jobs``.

    Raises `DatasetError`, `RegionError`, `MapError`, `StoreError`, `RecipeError` or `UsageError`; nothing is written then.
    """
    refuse_import_of_script(options.jobs)
    measure, ruling = start_stopwatch(), merge_recipe(options.recipe, holdout=options.holdout, seed=options.seed)
    out, store, dry_run = options.out, options.store, options.dry_run
    place = str(out).rstrip("/") if is_url(out) else check_local_output(out)
    opened = open_store(store)
    log = open_log(opened)
    if isinstance(place, Path) and not dry_run:
        clear_beside(place)
    known, is_intact = _read_card_in_bucket(place) if isinstance(place, str) else _read_card_in_place(place)
    marks = read_build_options(options, ruling, place)
    inputs = choose_inputs(opened, marks, log.state)
    left_out = _find_left_out(inputs, known, marks, options.min_runs)
    inputs = replace(inputs, findings=(*left_out, *inputs.findings))
    if is_intact and known is not None and known.inputs == inputs.digest:
        foreign = _find_foreign_files(place, known)
        result = replace(_make_result(place, "unchanged", known, left_out), foreign_files=foreign)
        _commit_references(log, _describe_dataset(result, inputs))
        return result
    others = [] if known is None or known.inputs == inputs.digest else find_other_options(known, marks, inputs)
    if others and not options.force:
        what = "it was made with other options and is not changed; give another OUT, or replace it with --force"
        raise UsageError(f"{place}: {what}", *(f"{place}: {line}" for line in others))
    if dry_run:
        if isinstance(place, str):
            read_generations(open_place(place), CARD)
        most = sum(run.facts.segments - int(inputs.again[run.run_id].sum()) for run in inputs.runs)
        expected = estimate(log.state.calls, BUILD, most, jobs=options.jobs)
        code = 3 if select_problems(inputs.findings) else 0
        return BuildResult(str(place), "planned", inputs.findings, exit_code=code, estimate=expected)
    from tcpipe.pipeline.dataset.writing import write_dataset  # noqa: PLC0415  slow to import, and often nothing is to be built

    output = write_generation(place, CARD) if isinstance(place, str) else write_atomic_directory(place.absolute())
    return_freed_memory()
    with commit_call(log, BUILD, [make_absolute(place)]) as call:
        with output as directory:
            card = write_dataset(directory, inputs, marks, options.jobs)
            _refuse_others_since(place, {known.inputs if known else None, inputs.digest})
            foreign = _find_foreign_files(place, known)
            if isinstance(place, Path):
                keep_foreign_files(foreign, place, directory)
        result = replace(_make_result(place, "done", card, left_out), foreign_files=foreign)
        counts = {"runs": len(inputs.runs), "samples": card.samples}
        written = sum(checksum.size_bytes for checksum in card.checksums.values())
        took = CallRecord(BUILD, __version__, result.exit_code, counts, options.jobs, written_bytes=written)
        dataset = _describe_dataset(result, inputs)
        replaced = () if known is None or known.inputs == dataset.inputs else (Dataset(dataset.out, known.inputs),)
        call.kind = "built"
        call.end = Entries(datasets=(dataset,), forgotten=replaced, calls=(measure(took),))
    return result


build_dataset = as_function(BuildDatasetOptions, run_build_dataset)
"""`tcpipe.build_dataset`: its keywords are the fields of `BuildDatasetOptions`."""


def _refuse_others_since(place: Path | str, expected: Container[str | None]) -> None:
    """Raise `StoreError` where another call has put a dataset in this place since."""
    known = None
    if isinstance(place, str):
        known = _read_card_in_bucket(place)[0]
    elif (place / CARD).is_file():
        known = read_card(place, proved=False)
    if known is not None and known.inputs not in expected:
        raise StoreError(
            f"{place}: another call has built a dataset here meanwhile and it is kept; run the command again"
        )


def _find_foreign_files(place: Path | str, card: DatasetCard | None) -> tuple[str, ...]:
    """Return the files of others in the directory of a dataset; in a bucket each build has a folder of its own."""
    return tuple(find_foreign_files(place, card.checksums)) if isinstance(place, Path) and card is not None else ()


def _describe_dataset(result: BuildResult, inputs: Inputs) -> Dataset:
    return Dataset(make_absolute(result.path), inputs.digest, tuple((run.run_id, run.recipe_id) for run in inputs.runs))


def _commit_references(log: LogWriter, dataset: Dataset) -> None:
    """Commit the runs of an earlier dataset unless the log has them: ``tcpipe prune`` keeps what a dataset refers to."""
    if log.state.datasets.get((dataset.out, dataset.inputs)) != dataset:
        try:
            log.commit("built", Entries(datasets=(dataset,)))
        except StoreError as error:
            logger.warning("%s; so 'tcpipe prune' does not know the runs of this dataset", error.problems[0])


def _find_left_out(
    inputs: Inputs, known: DatasetCard | None, options: BuildOptions, min_runs: int | None
) -> tuple[Finding, ...]:
    """Return findings on excluded runs, as notes if ``min_runs`` are enough; `DatasetError` if there are too few."""
    chosen = inputs.chosen
    before = () if known is None or known.redaction else known.runs
    fewer = (*chosen.missing, *find_gone_runs(before, chosen, robot=options.robot, tags=options.tags))
    if min_runs is None:
        return (*chosen.damaged, *fewer)
    if len(inputs.runs) < min_runs:
        count = f"{len(inputs.runs)} runs, expected {min_runs} or more (--min-runs); nothing is written"
        groups = group_dataset_findings((*chosen.damaged, *fewer), {run.run_id: () for run in inputs.runs})
        raise DatasetError(count, *format_mixed_groups(groups))
    return (*chosen.damaged, *(replace(finding, severity="note") for finding in fewer))


def _read_card_in_bucket(url: str) -> tuple[DatasetCard | None, bool]:
    """Return the card of the dataset at a URL, if there is one, and whether it is intact."""
    open_place(url).check()
    if (found := find_newest(url, [CARD])) is None:
        return None, False
    with _name_remedy(url):
        card = parse_card(found.data, found.place.where(found.name))
    _, fetched = fetch_directory_by_range(url, by_range=lambda _: True)
    return card, fetched is not None and fetched.is_complete()


def _make_result(place: Path | str, status: str, card: DatasetCard, left_out: Sequence[Finding]) -> BuildResult:
    """Return the result, with today's findings on excluded runs in place of the card's."""
    findings = (*left_out, *(finding for finding in card.findings if finding.code not in CHOICE_CODES))
    return BuildResult(str(place), status, findings, card, 3 if select_problems(findings) else 0)


def _read_card_in_place(place: Path) -> tuple[DatasetCard | None, bool]:
    """Return the card of the dataset in a directory, if there is one, and whether it is intact; `DatasetError` for anything else."""
    if not place.exists() or (place.is_dir() and not any(place.iterdir())):
        return None, False
    if not place.is_dir():
        raise UsageError(f"{place}: is a file, expected a directory for the dataset; give another OUT")
    if not (place / CARD).is_file():
        raise UsageError(f"{place}: exists and is not a dataset (no {CARD}); it is not changed; give another OUT")
    with _name_remedy(place):
        card, proved = read_card(place, proved=False), True
    try:
        read_intact_card(place)
    except DatasetError as error:
        proved = False
        logger.warning("%s; it is built again", error.problems[0])
    files = ((place / name, entry.size_bytes) for name, entry in card.checksums.items())
    is_whole = all(path.is_file() and path.stat().st_size == size_bytes for path, size_bytes in files)
    return card, proved and is_whole


@contextmanager
def _name_remedy(place: Path | str) -> Iterator[None]:
    """Add to a `DatasetError` about the card in a place what becomes of the dataset there, and what to do."""
    try:
        yield
    except DatasetError as error:
        left = f"{place}: is not changed, because its inputs are unknown; move it or give another OUT"
        raise DatasetError(*error.problems, left) from None
