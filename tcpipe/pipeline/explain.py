"""Where a sample came from, down to log, stamps and message ranges."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import pyarrow.compute as pc

from tcpipe import __version__
from tcpipe.errors import DatasetError, StoreError, clean_lines
from tcpipe.formats.atomic import Location
from tcpipe.formats.dataset_card import DatasetCard, MapSource
from tcpipe.formats.dataset_files import SAMPLES, is_shard, read_intact_card, read_samples, sample_columns
from tcpipe.formats.json_files import to_plain
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.parquet import ROWS_PER_GROUP, read_table
from tcpipe.formats.published_outputs import fetch_directory_by_range
from tcpipe.formats.runs import RunFacts
from tcpipe.formats.stored_runs import StoredRun, read_streams
from tcpipe.recipe import Recipe
from tcpipe.store import Store, open_store
from tcpipe.tables.bits import DropReason, Quality, flag_names
from tcpipe.tables.columns import to_integers
from tcpipe.tables.levels import GEOMETRY, Streams

_NEARBY_NS = 5_000_000_000  # rejections this long before and after a segment are printed [ns]

Value: TypeAlias = str | int | float | bool | None
"""Value of a column in one row."""

Row: TypeAlias = Mapping[str, Any]
"""Values of a row of samples.parquet by column."""

Setting: TypeAlias = Value | Sequence[Value | Mapping[str, Value]] | Mapping[str, Value | Sequence[Value]]
"""Value of a key of a recipe."""


@dataclass(frozen=True, slots=True)
class MessageRange:
    """Messages of a role in a segment: from ``first`` to ``last`` of all."""

    topic: str
    type: str
    time: str
    """Stamps that are used: ``header`` or ``log``."""
    placed_by: str
    first: int
    last: int
    """Less than ``first``: no message."""
    of: int
    first_ns: int | None
    last_ns: int | None


@dataclass(frozen=True, slots=True)
class NearbyMask:
    """A span of masked track near a segment: reasons, and the time to its start or end."""

    why: tuple[str, ...]
    where: Literal["before", "after"]
    apart_s: float
    rows: int


@dataclass(frozen=True, slots=True)
class NearbyRefusal:
    """Number of measurements of a role near a segment that the filter rejected, by reason."""

    role: str
    reason: str
    count: int


@dataclass(frozen=True, slots=True)
class Versions:
    """Version of tcpipe that built the dataset, the data model, and the version of tcpipe that runs now."""

    dataset: str
    here: str
    data_model: str


@dataclass(frozen=True, slots=True)
class History:
    """A sample's whole history."""

    sample: Mapping[str, Value]
    """Its row of samples.parquet by column, with the number of the ``row``."""
    quality: tuple[str, ...]
    run: RunFacts
    """The run, and the log that it was read from."""
    messages: Mapping[str, MessageRange]
    """By role."""
    masks: tuple[NearbyMask, ...]
    rejected: tuple[NearbyRefusal, ...]
    map: MapSource | None
    """The map from which its patch was sampled, as the card of the dataset has it; None without patches."""
    recipe_differs_in: Mapping[str, Setting]
    """Keys of the recipe that differ from their default."""
    versions: Versions


@dataclass(frozen=True, slots=True)
class Explained:
    """A sample's whole history; ``str`` of it is the command's output."""

    sample_id: str
    facts: History

    def __str__(self) -> str:
        """Return the history as plain lines."""
        return clean_lines(tuple(_iterate_lines(self.sample_id, self.facts)))


def explain(sample_id: str, *, dataset: Location = "dataset", store: Location = "tcpipe-store") -> Explained:
    """Return where a sample of a dataset came from.

    Raises `DatasetError`, `StoreError`: there is no such dataset, sample or store, the dataset is of another data
    model, or the store no longer contains the sample's run.
    """
    opened = open_store(store)
    directory, _ = fetch_directory_by_range(dataset, by_range=is_shard)
    card = read_intact_card(directory)
    if card.without_coordinates:
        raise DatasetError(
            f"{directory}: has no coordinates, so the source of its samples is unknown; explain the dataset with coordinates"
        )
    sample = _read_sample(directory, sample_id)
    run = _find_run(opened, directory, card, sample)
    span_ns, streams = (sample["start_ns"], sample["end_ns"]), read_streams(run.place, run.facts)
    return Explained(
        sample_id,
        History(
            sample=sample,
            quality=flag_names(sample["quality"], Quality),
            run=run.facts,
            messages={} if streams is None else dict(_find_messages(streams, *span_ns)),
            masks=tuple(_iterate_masks(run, *span_ns)),
            rejected=tuple(_iterate_rejections(run, *span_ns)),
            map=next((source for source in card.maps if source.name == sample["map"]), None),
            recipe_differs_in={
                key: item for key, item in flatten_recipe(card.recipe).items() if item != _DEFAULTS.get(key)
            },
            versions=Versions(card.tcpipe_version, __version__, card.data_model_version),
        ),
    )


def _read_sample(directory: Path, sample_id: str) -> Row:
    """Return the row of a sample by column, with its number as ``row``."""
    ids = read_samples(directory, ["sample_id"]).column("sample_id")
    row = pc.index(ids, sample_id).as_py()
    if row < 0:
        near = [name for name in ids.to_pylist() if sample_id and sample_id in name][:3]
        hint = f"; did you mean {', '.join(near)}?" if near else f"; an example is {ids[0].as_py()}" if len(ids) else ""
        raise DatasetError(f"{directory}: no sample {sample_id!r}{hint}")
    try:
        names = [name for name in sample_columns(directory) if name != GEOMETRY]
        group = read_table(directory / SAMPLES, names, group=row // ROWS_PER_GROUP)
    except StoreError as error:
        raise DatasetError(*error.problems) from None
    return {**group.slice(row % ROWS_PER_GROUP, 1).to_pylist()[0], "row": row}


def _find_run(store: Store, directory: Path, card: DatasetCard, sample: Row) -> StoredRun:
    recipe_id = next((run.recipe_id for run in card.runs if run.run_id == sample["run_id"]), None)
    if recipe_id is None:
        raise DatasetError(
            f"{directory}: its card lists no run {sample['run_id']}; 'tcpipe verify {directory}' lists all problems"
        )
    runs = store.find_runs(f"{sample['run_id']}/{recipe_id}")
    if not runs:
        raise DatasetError(
            f"{store.root}: run {sample['run_id']} of recipe {recipe_id} is not in this store; "
            f"name the store from which {directory} was built with --store"
        )
    return runs[0]


def _find_messages(streams: Streams, start_ns: int, end_ns: int) -> Iterator[tuple[str, MessageRange]]:
    """Yield, for every role, its topic and its messages in the segment."""
    for role, table in streams.tables.items():
        stamps = to_integers(table, "stamp_ns")
        first, last = np.searchsorted(stamps, [start_ns, end_ns], side="left")
        inside = stamps[first:last]
        sensor = streams.sensors[role]
        yield (
            role,
            MessageRange(
                topic=sensor.topic,
                type=sensor.type_name,
                time=sensor.time_source,
                placed_by=sensor.placed_by,
                first=int(first),
                last=int(last) - 1,
                of=len(stamps),
                first_ns=int(inside[0]) if len(inside) else None,
                last_ns=int(inside[-1]) if len(inside) else None,
            ),
        )


def _iterate_masks(run: StoredRun, start_ns: int, end_ns: int) -> Iterator[NearbyMask]:
    """Yield the spans of masked track near a segment, with reasons."""
    table = run.track().table
    stamps, bits = to_integers(table, "stamp_ns"), to_integers(table, "dropped_by")
    near = slice(*np.searchsorted(stamps, [start_ns - _NEARBY_NS, end_ns + _NEARBY_NS]))
    stamps, bits = stamps[near], bits[near]
    for part in np.split(np.arange(len(bits)), np.flatnonzero(np.diff(bits)) + 1):
        if len(part) and bits[part[0]]:
            names = flag_names(int(bits[part[0]]), DropReason)
            before = stamps[part[0]] < start_ns
            offset_ns = start_ns - stamps[part[-1]] if before else stamps[part[0]] - end_ns
            yield NearbyMask(names, "before" if before else "after", float(offset_ns) / 1e9, len(part))


def _iterate_rejections(run: StoredRun, start_ns: int, end_ns: int) -> Iterator[NearbyRefusal]:
    table = run.rejections()
    stamps = to_integers(table, "stamp_ns")
    near = (stamps >= start_ns - _NEARBY_NS) & (stamps <= end_ns + _NEARBY_NS)
    rows = table.filter(near).select(["role", "reason"]).to_pylist()
    for (role, reason), count in sorted(Counter((row["role"], row["reason"]) for row in rows).items()):
        yield NearbyRefusal(role, reason, count)


def flatten_recipe(recipe: Recipe) -> dict[str, Setting]:
    """Return the values of a recipe by dotted key; a table with keys of the user is one value."""
    flat: dict[str, Setting] = {}
    for key, value in to_plain(asdict(recipe)).items():
        flat |= {f"{key}.{name}": item for name, item in value.items()} if isinstance(value, Mapping) else {key: value}
    return flat


_DEFAULTS = flatten_recipe(Recipe())

_SHOWN_LABELS = (
    ("power", "power_watt", "power_std_watt", 1, "W"),
    ("velocity", "velocity_mps", "velocity_std_mps", 3, "m/s"),
    ("duration", "duration_s", "duration_std_s", 3, "s"),
    ("energy", "energy_joule", "energy_std_joule", 1, "J"),
    ("slip", "slip_fraction", "slip_std_fraction", 3, ""),
    ("vibration", "vibration_mps2", "vibration_std_mps2", 2, "m/s²"),
)
"""Label, column, column of its standard deviation, decimals and unit."""


def _iterate_lines(sample_id: str, facts: History) -> Iterator[str]:
    """Yield the history of a sample as lines of text."""
    sample, run, ground = facts.sample, facts.run, facts.map
    fold = "" if sample["fold"] is None else f", fold {sample['fold']}"
    yield f"{sample_id}: row {sample['row']}, split {sample['split']}{fold}"
    labels = [
        f"{name} {sample[column]:.{digits}f} ± {sample[std] or 0.0:.{digits}f} {unit}".rstrip()
        for name, column, std, digits, unit in _SHOWN_LABELS
        if sample[column] is not None
    ]
    yield f"labels   {', '.join(labels)}; quality {', '.join(facts.quality) or 'clean'}"
    paths = [path if is_url(path) or Path(path).exists() else f"{path} (now missing)" for path in run.log.paths]
    yield f"log      {', '.join(paths)} (sha256 {run.log.sha256[:12]}…), run {run.run_id}, robot {run.robot}"
    yield f"stamps   {sample['start_ns']} to {sample['end_ns']} ns"
    for role, messages in facts.messages.items():
        count = messages.last - messages.first + 1
        numbers = f"{messages.first} to {messages.last} ({count})" if count else "none"
        yield f"messages {role}: {messages.topic}, {numbers} of {messages.of} as read, by {messages.time} time"
    for mask in facts.masks:
        yield f"masked   {mask.apart_s:.2f} s {mask.where}: {', '.join(mask.why)}, {mask.rows} rows"
    for rejected in facts.rejected:
        yield f"rejected {rejected.count} of {rejected.role} ({rejected.reason}) within {_NEARBY_NS / 1e9:g} s"
    if ground is not None:
        made_of = ", ".join(f"{layer} {name}" for layer, name in sorted((ground.sources or {}).items()))
        yield f"map      {ground.name} in {ground.crs} from {made_of}"
    changed = (
        ", ".join(f"{key} = {value}" for key, value in facts.recipe_differs_in.items()) or "all keys at their defaults"
    )
    yield f"recipe   {run.recipe_id}: {changed}"
    versions = facts.versions
    yield f"versions dataset {versions.dataset}, run {run.tcpipe_version}, here {versions.here}; data model {versions.data_model}"
