"""Building a dataset from labelled segments and maps: sample, split, audit, write; complete or not at all."""

import shlex
from collections.abc import Collection, Container, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path

from tcpipe.errors import DatasetError, StoreError, TcpipeError, UsageError, clean_lines, list_first
from tcpipe.execution import refuse_import_of_script
from tcpipe.formats.atomic import Location, check_local_output, clear_beside
from tcpipe.formats.dataset_card import DatasetCard, group_dataset_findings
from tcpipe.formats.dataset_files import (
    CARD,
    find_foreign_files,
    keep_foreign_files,
    parse_card,
    read_card,
    read_intact_card,
)
from tcpipe.formats.documents import State, make_key
from tcpipe.formats.finding_lines import format_budget, format_groups, list_verdict
from tcpipe.formats.json_files import to_plain
from tcpipe.formats.object_storage import is_url, make_absolute
from tcpipe.formats.parquet import return_freed_memory
from tcpipe.formats.published_outputs import check_kind, fetch_directory_by_range, find_newest, publish_directory
from tcpipe.formats.runs import Options, Output
from tcpipe.motion.distance_breakdown import KEPT
from tcpipe.pipeline.calls import BUILD, RunningCall, describe_error, record_call
from tcpipe.pipeline.dataset.inputs import ChosenInputs, choose_inputs, find_other_options, plan_inputs, prove_maps
from tcpipe.pipeline.dataset.options import BuildOptions, merge_recipe, read_build_options
from tcpipe.pipeline.dataset.runs import CHOICE_CODES, find_gone_runs
from tcpipe.pipeline.options import BuildDatasetOptions
from tcpipe.progress import logger
from tcpipe.splits.assignment import SPLITS
from tcpipe.store import Store, open_store
from tcpipe.tables.findings import Finding, Findings, is_problem, select_problems
from tcpipe.tables.options import as_function


@dataclass(frozen=True, slots=True)
class BuildResult:
    """Result of a build; the command prints its ``str``."""

    path: str
    """Its directory, or its URL in a bucket."""
    status: str
    """``done``, ``unchanged``, or, of a dry run, ``planned``."""
    findings: Findings
    """Findings of the dataset itself, with excluded runs and empty splits."""
    card: DatasetCard | None = None
    """None for a dry run."""
    exit_code: int = 0
    """3 if a finding is a problem."""
    recipe: str = ""
    """The recipe's source, as a command found it."""
    segments: int | None = None
    """Number of segments in a dry run: an upper bound of the samples."""
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
        return format_groups(groups, more=f"tcpipe inspect {shlex.quote(self.path)}")

    def _facts(self) -> list[str]:
        card = self.card
        if card is None:
            return [f"{self.path}: would have at most {self.segments} samples"]
        counts = ", ".join(f"{card.splits[name]} {name}" for name in SPLITS)
        head = f"{self.path}: {card.samples} samples ({counts})"
        if self.status == "unchanged":
            head += "; nothing to do: it is made from the same runs, map, region and recipe"
        lost = [(-metres, name) for name, metres in card.distance_by_reason_m.items() if metres >= 0.5 and name != KEPT]
        ledger = f"{sum(card.distance_by_reason_m.values()):.0f} m driven: {card.distance_by_reason_m[KEPT]:.0f} m in samples"
        ledger += "".join(f", {-metres:.0f} m {name.replace('_', ' ')}" for metres, name in sorted(lost))
        floor = [] if card.energy_budget is None else [format_budget(card.energy_budget)]
        verdict = (f"verdict: {line}" for line in list_verdict(card.verdict))
        return [head, ledger, *floor, *verdict]

    def _closing(self) -> list[str]:
        names = list_first(self.foreign_files, most=3)
        kept = [f"{self.path}: contains {names}, not of the dataset; kept"] if names else []
        if self.card is None or not self.card.without_coordinates:
            return kept
        return [*kept, f"publish it with: hf upload OWNER/NAME {shlex.quote(self.path)} . --repo-type dataset"]


def run_build_dataset(options: BuildDatasetOptions) -> BuildResult:
    """Sample a rotated patch for every segment, split by region, and write the dataset to ``out``.

    Findings on damaged runs (which are excluded), runs to be ingested again, runs that only the replaced dataset has,
    and empty splits make the exit code 3, unless the call before has reported them. The bytes do not depend on
    ``jobs``.

    Raises `DatasetError`, `RegionError`, `MapError`, `StoreError`, `RecipeError` or `UsageError`; nothing is written
    then.
    """
    refuse_import_of_script(options.jobs)
    out = options.out
    place = str(out).rstrip("/") if is_url(out) else check_local_output(out)
    opened = open_store(options.store)
    if options.dry_run:
        return _plan(opened.scan(), opened, options, place)
    where = make_absolute(place)
    with record_call(opened, BUILD, [where], jobs=options.jobs) as call:
        before = call.state.outputs.get(where) or Output(where=where)
        now = replace(before, options=_describe_options(options), at=call.call.begin)
        try:
            result, inputs = _build(call, options, place, reported=before.reported)
        except Exception as error:
            _record_output(call, replace(now, **describe_error(error)), before)
            raise
        runs = tuple((run.run_id, run.recipe_id) for run in inputs.runs)
        reported = tuple(sorted(map(_name_finding, select_problems(result.findings))))
        made = replace(
            now, inputs=inputs.digest, parts=inputs.made_from.parts, runs=runs, exit_code=result.exit_code, message="",
            reported=reported,
        )  # fmt: skip
        _record_output(call, made, before)
    return result


def _plan(state: State, store: Store, options: BuildDatasetOptions, place: Location) -> BuildResult:
    """Return the plan of a call."""
    job = _read_job(state, store, options, place)
    if job.is_made and job.known is not None:
        return _make_result(place, "unchanged", job.known, job.left_out, ())
    most = sum(run.facts.segments - int(job.inputs.again[run.run_id].sum()) for run in job.inputs.runs)
    code = 3 if select_problems(job.inputs.findings) else 0
    return BuildResult(str(place), "planned", job.inputs.findings, exit_code=code, segments=most)


@dataclass(frozen=True, slots=True)
class _Job:
    """The inputs and planned work of one call."""

    marks: BuildOptions
    inputs: ChosenInputs
    left_out: Findings
    """On excluded runs."""
    known: DatasetCard | None
    """Card of the existing dataset at the output, or None."""
    is_made: bool
    """Whether the existing dataset is up to date."""


def _read_job(state: State, store: Store, options: BuildDatasetOptions, place: Location) -> _Job:
    known, is_intact = _read_card_in_bucket(place) if isinstance(place, str) else _read_card_in_place(place)
    marks = read_build_options(options, merge_recipe(options.recipe, holdout=options.holdout, seed=options.seed))
    inputs = choose_inputs(store, marks, state)
    left_out = _find_left_out(inputs, known, marks, options.min_runs)
    inputs = replace(inputs, findings=(*left_out, *inputs.findings))
    is_made = is_intact and known is not None and known.inputs == inputs.digest
    others = [] if known is None or known.inputs == inputs.digest else find_other_options(known, marks, inputs)
    if others and not options.force:
        what = "it was made with other options and is not changed; give another OUT, or replace it with --force"
        raise UsageError(f"{place}: {what}", *(f"{place}: {line}" for line in others))
    return _Job(marks, inputs, left_out, known, is_made)


def _build(
    call: RunningCall, options: BuildDatasetOptions, place: Location, *, reported: Collection[str]
) -> tuple[BuildResult, ChosenInputs]:
    """Write the dataset unless it exists; return the result and its inputs. ``reported``: findings already printed."""
    if isinstance(place, Path):
        clear_beside(place)
    job = _read_job(call.state, call.store, options, place)
    if job.is_made and job.known is not None:
        result = _make_result(place, "unchanged", job.known, job.left_out, reported)
        result = replace(result, foreign_files=_find_foreign_files(place, job.known))
        call.result |= {"exit_code": result.exit_code, "counts": {"unchanged": 1}}
        return result, job.inputs
    prove_maps(call.store, job.inputs.map_records)
    from tcpipe.pipeline.dataset.writing import write_dataset  # noqa: PLC0415  slow to import, and often nothing is to be built

    return_freed_memory()
    with publish_directory(place, CARD) as directory:
        card = write_dataset(directory, job.inputs, job.marks, options.jobs)
        _refuse_others_since(place, {job.known.inputs if job.known else None, job.inputs.digest})
        foreign = _find_foreign_files(place, job.known)
        if isinstance(place, Path):
            keep_foreign_files(foreign, place, directory)
    result = replace(_make_result(place, "done", card, job.left_out, reported), foreign_files=foreign)
    call.result |= {"exit_code": result.exit_code, "counts": {"runs": len(job.inputs.runs), "samples": card.samples}}
    return result, job.inputs


def _describe_options(options: BuildDatasetOptions) -> Options:
    """Return the options of a call as JSON values, files as absolute paths, so that it can be planned again."""
    found = {entry.name: getattr(options, entry.name) for entry in fields(options) if entry.name not in _NOT_RECORDED}
    for name in ("split", "recipe"):
        value = found[name]
        found[name] = make_absolute(value) if isinstance(value, str | Path) else None if value is None else _IN_PYTHON
    given = [options.covariates] if isinstance(options.covariates, str | Path) else options.covariates
    found["covariates"] = [make_absolute(path) for path in given]
    return {name: value for name, value in found.items() if value is not False and value not in (None, (), [], {})}


_NOT_RECORDED = ("out", "store", "jobs", "dry_run", "force")
"""Options of a call without effect on the content of the dataset."""
_IN_PYTHON = "a recipe in Python"


def find_changed_parts(store: Store, state: State, output: Output) -> str:
    """Return the parts of a dataset that a build would change now, or why it cannot be planned; "" without a change.

    A dataset whose recipe was given in Python is assumed unchanged.
    """
    if not output.inputs or output.options.get("recipe") == _IN_PYTHON:
        return ""
    options = BuildDatasetOptions(output.where, store=store.root, **output.options)  # type: ignore[arg-type]  # as recorded
    try:
        recipe = merge_recipe(options.recipe, holdout=options.holdout, seed=options.seed)
        parts = plan_inputs(store, read_build_options(options, recipe), state).parts
    except TcpipeError as error:
        return error.problems[0]
    except OSError as error:
        return f"{error.filename}: {error.strerror}"
    return ", ".join(name.replace("_", " ") for name, part in parts.items() if output.parts.get(name) != part)


def _record_output(call: RunningCall, output: Output, before: Output) -> None:
    """Write the inputs of an output and the result of its last call, unless they are already written."""
    if to_plain(replace(output, at="")) == to_plain(replace(before, at="")):
        return
    try:
        call.store.put(call.state, "outputs", make_key(output.where), output)
    except StoreError as error:
        logger.warning("%s; so 'tcpipe status' and 'tcpipe prune' do not know this dataset", error.problems[0])


def _name_finding(finding: Finding) -> str:
    return f"{finding.code} {finding.subject.kind} {finding.subject.name}"


build_dataset = as_function(BuildDatasetOptions, run_build_dataset)
"""`tcpipe.build_dataset`: its keywords are the fields of `BuildDatasetOptions`."""


def _refuse_others_since(place: Location, expected: Container[str | None]) -> None:
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


def _find_foreign_files(place: Location, card: DatasetCard | None) -> tuple[str, ...]:
    """Return the files of others in the directory of a dataset; in a bucket each build has its own folder."""
    return tuple(find_foreign_files(place, card.checksums)) if isinstance(place, Path) and card is not None else ()


def _find_left_out(
    inputs: ChosenInputs, known: DatasetCard | None, options: BuildOptions, min_runs: int | None
) -> Findings:
    """Return findings on excluded runs, as notes if ``min_runs`` are enough; `DatasetError` if there are too few."""
    chosen = inputs.chosen
    before = () if known is None or known.without_coordinates else known.runs
    fewer = (*chosen.missing, *find_gone_runs(before, chosen, robot=options.robot, tags=options.tags))
    if min_runs is None:
        return (*chosen.damaged, *fewer)
    if len(inputs.runs) < min_runs:
        count = f"{len(inputs.runs)} runs, expected {min_runs} or more (--min-runs); nothing is written"
        groups = group_dataset_findings((*chosen.damaged, *fewer), {run.run_id: () for run in inputs.runs})
        raise DatasetError(count, *format_groups(groups))
    return (*chosen.damaged, *(replace(finding, severity="note") for finding in fewer))


def _read_card_in_bucket(url: str) -> tuple[DatasetCard | None, bool]:
    """Return the card of the dataset at a URL, if there is one, and whether it is intact."""
    check_kind(url, CARD)
    if (found := find_newest(url, [CARD])) is None:
        return None, False
    with _name_remedy(url):
        card = parse_card(found.data, found.place.where(found.name))
    _, fetched = fetch_directory_by_range(url, by_range=lambda _: True)
    return card, fetched is not None and fetched.is_complete()


def _make_result(
    place: Location, status: str, card: DatasetCard, left_out: Sequence[Finding], reported: Collection[str]
) -> BuildResult:
    """Return the result, with today's findings on excluded runs instead of the card's, without those ``reported``."""
    findings = (*left_out, *(finding for finding in card.findings if finding.code not in CHOICE_CODES))
    is_news = any(_name_finding(finding) not in reported for finding in select_problems(findings))
    return BuildResult(str(place), status, findings, card, 3 if is_news else 0)


def _read_card_in_place(place: Path) -> tuple[DatasetCard | None, bool]:
    """Return the card of a directory's dataset, if any, and whether it is intact; `DatasetError`: other content."""
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
def _name_remedy(place: Location) -> Iterator[None]:
    """Add to a `DatasetError` about a card the state of its dataset, and what to do."""
    try:
        yield
    except DatasetError as error:
        unchanged = f"{place}: is not changed, because its inputs are unknown; move it or give another OUT"
        raise DatasetError(*error.problems, unchanged) from None
