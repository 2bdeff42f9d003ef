"""From labelled segments and a map to a dataset: sample, split, audit, write; whole or not at all."""

from __future__ import annotations

import logging
import shlex
import shutil
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import pyarrow as pa

from tcpipe import __version__
from tcpipe.cost.budget import in_words
from tcpipe.errors import DatasetError, RecipeError, StoreError, UsageError, plain_lines
from tcpipe.formats.atomic import atomic_directory, clear_beside, write_text
from tcpipe.formats.bucket import open_place
from tcpipe.formats.commits import Call, Dataset, Entries
from tcpipe.formats.croissant import croissant
from tcpipe.formats.dataset_card import DatasetCard, Doubtful, Redacted, RunFinding
from tcpipe.formats.dataset_files import (
    CARD,
    CLASSES,
    CROISSANT,
    DRIVE_NEXT,
    HUB_CARD,
    OVERVIEW,
    RELIEF,
    REPORT,
    SAMPLES,
    SHARDS,
    FileFormat,
    read_card,
    read_current_card,
    read_samples,
)
from tcpipe.formats.geojson import read_regions
from tcpipe.formats.hub_card import hub_card
from tcpipe.formats.json_files import digest, write_json
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.parquet import ROWS_PER_GROUP, parquet_rows
from tcpipe.formats.place import DirectoryPlace
from tcpipe.formats.places import local_output
from tcpipe.formats.published import has_card, here_by_range, published, refuse_others, settle
from tcpipe.formats.recipe_toml import recipe_of
from tcpipe.formats.seals import Checksum, file_checksum, file_checksums, sealed_page, write_sealed
from tcpipe.formats.store_mark import SPOOL
from tcpipe.pipeline.begun_calls import OpenCall, begun_call
from tcpipe.pipeline.calls import BUILD, Estimate, estimate, measure_call, started
from tcpipe.pipeline.dataset.added_columns import read_all_covariates
from tcpipe.pipeline.dataset.balance import BALANCE_COLUMNS, measure_balance
from tcpipe.pipeline.dataset.card import CARD_COLUMNS, VELOCITY_COLUMN, dataset_card, is_whole
from tcpipe.pipeline.dataset.content import gather_content
from tcpipe.pipeline.dataset.findings import doubt_in_words, findings_in_words
from tcpipe.pipeline.dataset.inputs import Inputs, choose_inputs, earlier_splits
from tcpipe.pipeline.dataset.physics import PHYSICS_COLUMNS
from tcpipe.pipeline.dataset.redaction import (
    redacted_card,
    redacted_content,
    redacted_features,
    redacted_inputs,
    redaction_of,
)
from tcpipe.pipeline.dataset.replacing import BuildOptions, find_other_options
from tcpipe.pipeline.dataset.runs import gone_runs
from tcpipe.pipeline.dataset.sampling import Workers
from tcpipe.pipeline.dataset.segments import KEPT
from tcpipe.pipeline.dataset.splitting import empty_splits
from tcpipe.pipeline.dataset.writing import write_patches
from tcpipe.pipeline.log_writer import LogWriter, open_log
from tcpipe.recipe import Recipe
from tcpipe.report.dataset_report import dataset_report
from tcpipe.report.overview import class_overview, maps_overview, relief_overview, write_overview
from tcpipe.splits.assignment import SPLITS
from tcpipe.splits.audit import HeldOut, audit_lines
from tcpipe.splits.regions import Regions
from tcpipe.store import Store, open_store
from tcpipe.tables.facts import EnergyBudget
from tcpipe.tables.levels import DATA_MODEL_VERSION, READ_VERSIONS

logger = logging.getLogger("tcpipe")


@dataclass(frozen=True, slots=True)
class BuildResult:
    """What became of a dataset; ``str`` of it is what the command prints."""

    path: str
    """Its directory, or its URL in a bucket."""
    status: str
    """``done``, ``unchanged``, or, of a dry run, ``planned``."""
    samples: int
    splits: Mapping[str, int]
    ledger_m: Mapping[str, float]
    audit: tuple[HeldOut, ...]
    warnings: tuple[str, ...]
    problems: tuple[str, ...] = ()
    """Runs that belong in and are left out, and splits that were asked for and are empty: the dataset is not what it should be."""
    energy_budget: EnergyBudget | None = None
    exit_code: int = 0
    """3 if the dataset is not what it should be."""
    recipe: str = ""
    """Which recipe ruled, as a command found it."""
    doubtful: Doubtful | None = None
    """How many samples carry a quality flag."""
    findings: tuple[RunFinding, ...] = ()
    """What ingest found of the runs, by cause."""
    redacted: bool = False
    """Whether names and places are not told."""
    estimate: Estimate | None = None
    """What a dry run expects of the work: of all segments, as if each became a sample."""

    def __str__(self) -> str:
        """Return counts, the share of doubtful samples, the audit, where the metres went and how wrong a label may be, as plain lines."""
        if self.estimate is not None:
            return plain_lines(
                (f"{self.path}: would be made of at most {self.estimate}", *(f"warning: {w}" for w in self.warnings))
            )
        counts = ", ".join(f"{self.splits[name]} {name}" for name in SPLITS)
        head = f"{self.path}: {self.samples} samples ({counts})"
        if self.status == "unchanged":
            head += "; nothing to do: it is made from the same runs, map, region and recipe"
        lost = [(name, metres) for name, metres in self.ledger_m.items() if metres >= 0.5 and name != KEPT]
        lost.sort(key=lambda entry: (-entry[1], entry[0]))
        ledger = f"{sum(self.ledger_m.values()):.0f} m driven: {self.ledger_m[KEPT]:.0f} m in samples"
        ledger += "".join(f", {metres:.0f} m {name.replace('_', ' ')}" for name, metres in lost)
        floor = [] if self.energy_budget is None else [in_words(self.energy_budget)]
        doubt = [] if self.doubtful is None else [doubt_in_words(self.doubtful, self.samples)]
        said = [f"{kind}: {text}" for kind in ("problem", "warning") for text in getattr(self, f"{kind}s")]
        said += findings_in_words(self.findings)
        publish = f"to publish it: hf upload OWNER/NAME {shlex.quote(self.path)} . --repo-type dataset"
        told = [*Redacted().lines(), publish] if self.redacted else []
        return plain_lines((head, *doubt, *audit_lines(self.audit), ledger, *floor, *said, *told))


def build_dataset(
    out: str | Path = "dataset",
    *,
    store: str | Path = "tcpipe-store",
    split: str | Path | None = None,
    map_name: str | Sequence[str] | None = None,
    robot: str | None = None,
    tags: Mapping[str, str] | None = None,
    recipe: Recipe | str | Path | None = None,
    jobs: int = 1,
    cluster: str | None = None,
    file_format: FileFormat = "zarr",
    holdout: str | None = None,
    seed: int | None = None,
    keep_split: str | Path | None = None,
    covariates: str | Path | Sequence[str | Path] = (),
    min_runs: int | None = None,
    redact: bool = False,
    force: bool = False,
    dry_run: bool = False,
) -> BuildResult:
    """Sample a rotated patch for every segment, split by region, and write the dataset to ``out``.

    Runs that are not as they were written are left out; those, runs that have to be ingested again, runs of the dataset that is replaced
    that are gone, and empty splits are the result's ``problems``.

    Parameters
    ----------
    out
        Directory of the dataset: new, empty, or a dataset of the same options, which is replaced unless it is made from the same inputs;
        or the URL of one in a bucket (``s3://…``), where nothing is replaced.
    store
        Where runs and maps are kept.
    split
        GeoJSON region (WGS84): inside is train and test, outside is unseen. None: everything is train and test.
    map_name
        Map to sample, or several, the first ruling where they overlap; None takes the only one in the store.
    robot
        Only runs of this robot; needed where the store holds several.
    tags
        Only runs that carry all of these tags.
    recipe
        A `Recipe`, a path to one, or None for the one that rules here.
    jobs
        Processes that sample side by side; the bytes do not depend on it.
    cluster
        Address of a Dask scheduler whose workers sample instead; they see the store under the same absolute path or URL.
    file_format
        ``zarr`` or ``parquet``.
    holdout, seed
        Instead of the recipe's; ``block``, ``sample``, ``run``, or ``tag:NAME``, which keeps runs of one value of the tag together.
    keep_split
        An earlier dataset, which may be ``out`` itself: its samples keep their split and fold, only new ones are drawn.
    covariates
        Tables (CSV or Parquet) whose columns are joined to the samples by time, as the recipe's section ``covariates`` says.
    min_runs
        Of fewer runs no dataset is built; that so many are enough also makes runs that are left out or gone mere warnings, damage aside.
    redact
        For the public: everything is moved by one offset that is kept nowhere, and no log, topic, path, host or user is named.
    force
        Replace a dataset that was made with other options: another recipe, region, map, robot, format or other tags.
    dry_run
        Choose the runs, look whether there is something to do, and estimate what it takes; write nothing.

    Raises
    ------
    DatasetError, RegionError, MapError, StoreError, RecipeError, UsageError
        Nothing is written then.
    """
    watch, ruling = started(), _ruling(recipe, holdout=holdout, seed=seed)
    place = str(out).rstrip("/") if is_url(out) else local_output(out)
    opened = open_store(store if cluster is None or is_url(store) else Path(store).absolute())
    if isinstance(place, Path) and not dry_run:
        clear_beside(place)
    known, proved = _card_in_bucket(place) if isinstance(place, str) else _card_in_place(place)
    regions = None if split is None else read_regions(Path(split))
    region = None if split is None else Path(split).read_bytes()
    robot = robot or ruling.robot
    tables = (covariates,) if isinstance(covariates, str | Path) else tuple(covariates)
    earlier = None if keep_split is None else earlier_splits(keep_split)
    inputs = choose_inputs(
        opened,
        ruling,
        map_names=(map_name,) if isinstance(map_name, str) else tuple(map_name or ()),
        robot=robot,
        tags=tags,
        region=region,
        file_format=file_format,
        earlier=earlier,
        covariates=read_all_covariates([Path(path) for path in tables], ruling.covariates),
    )
    inputs = replace(inputs, digest=digest(("redacted", inputs.digest))) if redact else inputs
    keeps_own = keep_split is not None and _absolute(keep_split) == _absolute(place)
    options = BuildOptions(ruling, regions, tags or {}, file_format, redact, keep_split is not None, keeps_own)
    problems, warnings = _left_out(
        inputs,
        None if known is not None and known.redaction else known,
        robot=robot,
        tags=tags or {},
        min_runs=min_runs,
    )
    inputs = replace(inputs, problems=problems, warnings=(*warnings, *inputs.warnings))
    if proved and known is not None and known.inputs == inputs.digest and _is_all_there(place, known):
        card, result = known, _result(place, "unchanged", known, problems)
    elif dry_run:
        _refuse_other_options(place, known, options, inputs, force=force)
        if isinstance(place, str):
            refuse_others(open_place(place), CARD)
        return _planned(place, opened, inputs, jobs=jobs)
    else:
        _refuse_other_options(place, known, options, inputs, force=force)
        whole = published(place, CARD) if isinstance(place, str) else atomic_directory(place.absolute())
        with begun_call(open_log(opened), BUILD, [_absolute(place)]) as call:
            with whole as directory, _workers(directory, opened, inputs.digest, jobs=jobs, cluster=cluster) as workers:
                card = _build(
                    directory,
                    inputs,
                    ruling,
                    regions,
                    earlier,
                    file_format=file_format,
                    workers=workers,
                    redact=redact,
                    tags=options.tags,
                )
                _refuse_others_since(place, {known.inputs if known else None, inputs.digest})
            for entry in workers.waiting.entries():
                workers.waiting.delete(entry.name)
            result = _result(place, "done", card, problems)
            written = sum(of.size_bytes for of in card.checksums.values())
            took = Call(
                BUILD, __version__, result.exit_code, {"runs": len(inputs.runs), "samples": result.samples}, jobs
            )
            _end(call, measure_call(watch, replace(took, written_bytes=written)), _dataset_of(result, inputs), known)
    if result.status == "unchanged":
        _refer(open_log(opened), _dataset_of(result, inputs))
    return result


def _refuse_other_options(
    place: Path | str, known: DatasetCard | None, options: BuildOptions, inputs: Inputs, *, force: bool
) -> None:
    """Raise `UsageError`, a line for each difference, where a dataset of other options would be replaced unasked."""
    if known is None or known.inputs == inputs.digest or (force and isinstance(place, Path)):
        return
    if others := find_other_options(known, options, inputs):
        what = "it was made with other options, and stays; give another OUT, or replace it with --force"
        if isinstance(place, str):
            what = "is there already; what lies in a bucket is not replaced: give another place. It was made with other options"
        raise UsageError(f"{place}: {what}", *(f"{place}: {line}" for line in others))


def _refuse_others_since(place: Path | str, expected: Container[str | None]) -> None:
    """Raise `StoreError` where another call has put a dataset in this place since; in a bucket the first wins anyway."""
    if isinstance(place, Path) and (place / CARD).is_file() and read_card(place, proved=False).inputs not in expected:
        raise StoreError(
            f"{place}: another call has built a dataset here meanwhile, which stays; run the command again"
        )


def _planned(place: Path | str, store: Store, inputs: Inputs, *, jobs: int) -> BuildResult:
    """Return what is to be expected of a build."""
    most = sum(run.facts.segments - int(inputs.again[run.run_id].sum()) for run in inputs.runs)
    expected = estimate(store.state().calls, BUILD, most, jobs=jobs)
    code, told = 3 if inputs.problems else 0, (inputs.warnings, inputs.problems)
    return BuildResult(str(place), "planned", most, {}, {}, (), *told, exit_code=code, estimate=expected)


def _end(opened: OpenCall, call: Call, dataset: Dataset, known: DatasetCard | None) -> None:
    """Let the last commit of the call say which dataset was built, for what it refers to stays, and what the call took."""
    before = () if known is None or known.inputs == dataset.inputs else (Dataset(dataset.out, known.inputs),)
    opened.kind, opened.end = "built", Entries(datasets=(dataset,), forgotten=before, calls=(call,))


def _dataset_of(result: BuildResult, inputs: Inputs) -> Dataset:
    return Dataset(_lasting(result), inputs.digest, tuple((run.run_id, run.recipe_id) for run in inputs.runs))


def _refer(log: LogWriter, dataset: Dataset) -> None:
    """Commit what a dataset refers to that was built before, where the log does not say so."""
    if log.state.datasets.get((dataset.out, dataset.inputs)) != dataset:
        try:
            log.commit("built", Entries(datasets=(dataset,)))
        except StoreError as error:
            logger.warning("%s; so 'tcpipe prune' does not know what this dataset refers to", error.problems[0])


def _lasting(result: BuildResult) -> str:
    """Return where a dataset lies, wherever that is asked from."""
    return _absolute(result.path)


def _absolute(place: Path | str) -> str:
    return str(place).rstrip("/") if is_url(place) else str(Path(place).absolute())


def _left_out(
    inputs: Inputs, known: DatasetCard | None, *, robot: str | None, tags: Mapping[str, str], min_runs: int | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what is wrong with the choice of runs, and what is worth a warning; `DatasetError` where there are too few."""
    chosen = inputs.chosen
    fewer = (*chosen.missing, *(() if known is None else gone_runs(known.runs, chosen, robot=robot, tags=tags)))
    if min_runs is None:
        return (*chosen.damaged, *fewer), ()
    if len(inputs.runs) < min_runs:
        count = f"{len(inputs.runs)} runs, wanted {min_runs} or more (--min-runs); nothing is written"
        raise DatasetError(count, *chosen.damaged, *fewer)
    return chosen.damaged, fewer


def _is_all_there(place: Path | str, card: DatasetCard) -> bool:
    if isinstance(place, Path):
        return is_whole(place, card)
    sizes = {entry.name: entry.size_bytes for entry in open_place(place).entries()}
    return all(sizes.get(name) == entry.size_bytes for name, entry in card.checksums.items())


def _card_in_bucket(url: str) -> tuple[DatasetCard | None, bool]:
    """Return the card of the dataset that lies at a URL, if one does, and whether it is as it was written."""
    open_place(url).check()
    if not has_card(url):
        return None, False
    settle(url)
    card = read_card(here_by_range(url, by_range=lambda _: True)[0])
    return card, card.data_model_version in READ_VERSIONS


def _result(place: Path | str, status: str, card: DatasetCard, problems: Sequence[str]) -> BuildResult:
    said = (*problems, *empty_splits(card))
    return BuildResult(
        path=str(place),
        status=status,
        samples=card.samples,
        splits={name: card.splits[name] for name in SPLITS},
        ledger_m=card.ledger_m,
        audit=card.split.audit,
        warnings=card.warnings,
        problems=said,
        energy_budget=card.energy_budget,
        exit_code=3 if said else 0,
        doubtful=card.doubtful,
        findings=card.findings,
        redacted=card.redaction is not None,
    )


def _ruling(recipe: Recipe | str | Path | None, *, holdout: str | None, seed: int | None) -> Recipe:
    """Return the recipe with the command's own choices in it."""
    recipe = recipe_of(recipe)
    kind, _, tag = (holdout or recipe.split.holdout).partition(":")
    rules = replace(
        recipe.split,
        holdout=kind,  # type: ignore[arg-type]  # the recipe checks it
        holdout_tag=recipe.split.holdout_tag if holdout is None else tag,
        seed=recipe.split.seed if seed is None else seed,
    )
    if rules.holdout == "tag" and not rules.holdout_tag:
        raise RecipeError(
            'recipe: split.holdout is "tag"; wanted split.holdout_tag too, for example "season" (--holdout tag:season)'
        )
    return replace(recipe, split=rules)


def _card_in_place(place: Path) -> tuple[DatasetCard | None, bool]:
    """Return the card of the dataset that is there, if one is, and whether it is as it was written; `DatasetError` for anything else."""
    if not place.exists() or (place.is_dir() and not any(place.iterdir())):
        return None, False
    if not place.is_dir():
        raise UsageError(f"{place}: is a file, wanted a directory for the dataset; give another OUT")
    if not (place / CARD).is_file():
        raise UsageError(f"{place}: exists and is no dataset (it has no {CARD}); it is left alone; give another OUT")
    try:
        card, proved = read_card(place, proved=False), True
    except DatasetError as error:
        left = f"{place}: is left alone, since nobody can tell what it was made of; move it away or give another OUT"
        raise DatasetError(*error.problems, left) from None
    try:
        read_current_card(place)
    except DatasetError as error:
        proved = False
        logger.warning("%s; it is built again", error.problems[0])
    ours = {*card.checksums, CARD, CROISSANT, REPORT}
    others = sorted({path.relative_to(place).as_posix() for path in place.rglob("*") if path.is_file()} - ours)
    if others:
        more = f" and {len(others) - 1} more" if len(others) > 1 else ""
        raise UsageError(f"{place}: holds {others[0]}{more} beside the dataset; move it away or give another OUT")
    return card, proved


@contextmanager
def _workers(directory: Path, store: Store, inputs: str, *, jobs: int, cluster: str | None) -> Iterator[Workers]:
    """Yield who samples and writes; what waits lies in the directory that is made, or in the store, which a cluster's workers see."""
    if cluster is None:
        yield Workers(jobs, None, DirectoryPlace(directory / SPOOL), DirectoryPlace(directory))
        return
    waiting = store.place.below(f"{SPOOL}/{inputs}")
    try:
        yield Workers(1, cluster, waiting, waiting.below("files"))
    except StoreError as error:
        if f"/{SPOOL}/{inputs}/" not in str(error) or "is gone" not in str(error):
            raise
        raise StoreError(
            f"{waiting.where()}: another build of the same was first, and took away what both used; run the same command again"
        ) from None


def _build(
    directory: Path,
    inputs: Inputs,
    recipe: Recipe,
    regions: Regions | None,
    earlier: pa.Table | None,
    *,
    file_format: FileFormat,
    workers: Workers,
    redact: bool,
    tags: Mapping[str, str],
) -> DatasetCard:
    """Write the dataset into ``directory`` and return its card."""
    waiting = directory / SPOOL
    waiting.mkdir()
    content = gather_content(waiting, inputs, recipe, regions, earlier, workers=workers)
    redaction = redaction_of(content, inputs, recipe) if redact else None
    if redaction is not None:
        content, inputs = redacted_content(content, redaction), redacted_inputs(inputs, redaction)
    logger.info("writing %d samples", len(content.samples))
    with parquet_rows(directory / SAMPLES, content.samples.schema) as write:
        for piece in content.samples.pieces(ROWS_PER_GROUP):
            write(piece)
    shards = write_patches(directory, content, file_format, workers, compression=recipe.dataset.compression)
    shutil.rmtree(waiting)
    _write_overviews(directory, content.sources)
    balance, drive_next = measure_balance(
        read_samples(directory, BALANCE_COLUMNS),
        content.samples.centres_xy_m(),
        content.sources,
        velocity_column=VELOCITY_COLUMN[recipe.label.velocity],
        chord_m=recipe.segment.chord_m,
        regions=regions,
        buffer_m=content.drawn.buffer_m,
    )
    write_json(directory / DRIVE_NEXT, drive_next if redaction is None else redacted_features(drive_next, redaction))
    card = dataset_card(
        read_samples(directory, (*CARD_COLUMNS, *PHYSICS_COLUMNS)),
        recipe,
        inputs,
        content,
        file_format=file_format,
        regions=regions,
        balance=balance,
        shards=shards,
        tags=tags,
    )
    card = card if redaction is None else redacted_card(card, redaction)
    spool, schema = content.spool, content.samples.schema
    files = file_checksums(directory)
    write_text(
        directory / HUB_CARD, hub_card(replace(card, checksums=files), schema, samples_file=SAMPLES, picture=OVERVIEW)
    )
    files = {**files, HUB_CARD: file_checksum(directory / HUB_CARD)}
    patches = {name: (spool.patch_px**2, layer.stored.kind) for name, layer in spool.layers.items()} if shards else None
    write_text(directory / CROISSANT, _croissant(files, recipe, inputs.digest, patches, samples=schema))
    card = replace(card, checksums={**files, CROISSANT: file_checksum(directory / CROISSANT)})
    write_sealed(directory / CARD, card)
    write_text(directory / REPORT, sealed_page(dataset_report(directory)))
    return card


def _write_overviews(directory: Path, sources: Sequence[MapFile]) -> None:
    """Write what the page shows of the maps: photograph (or relief), relief and classes, as far as there are any."""
    write_overview(directory / OVERVIEW, maps_overview(sources))
    layers = {layer for source in sources for layer in source.layers}
    if "ortho" in layers:
        write_overview(directory / RELIEF, maps_overview(sources, relief_overview))
    if "terrain" in layers:
        write_overview(directory / CLASSES, maps_overview(sources, class_overview))


def _croissant(
    files: Mapping[str, Checksum],
    recipe: Recipe,
    inputs: str,
    patches: Mapping[str, tuple[int, str]] | None,
    *,
    samples: pa.Schema,
) -> str:
    about = recipe.dataset
    return croissant(
        name=about.name,
        description=about.description,
        licence=about.licence,
        creator=about.creator,
        files=files,
        samples_file=SAMPLES,
        samples=samples,
        version=f"{DATA_MODEL_VERSION}.0+{inputs[:12]}",
        shards=None if patches is None else f"{SHARDS}/*.parquet",
        layers=patches,
    )
