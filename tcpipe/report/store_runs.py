"""The runs of a store as its page shows them: a row each, under the recipe that most are of."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import PurePosixPath

from tcpipe.formats.finding_lines import FindingGroup
from tcpipe.formats.index_files import RunFacts
from tcpipe.formats.json_files import Json
from tcpipe.formats.stored_runs import Ingestions
from tcpipe.tables.findings import Finding, Verdict

_PAGE = "report.html"


@dataclass(frozen=True, slots=True)
class StoredDataset:
    """A dataset that was built of the store: where, of which ingestions, whether it is still that one, and its page from the store's."""

    out: str
    runs: tuple[tuple[str, str], ...]
    there: bool
    page: str | None = None


@dataclass(frozen=True, slots=True)
class FailedLog:
    """A log that gave no run: why, and how that stands."""

    log: str
    why: str
    state: str


@dataclass(frozen=True, slots=True)
class StoreFacts:
    """What the page of a store is made of."""

    where: str
    found: Ingestions
    acknowledged: frozenset[str]
    """Runs whose problems a person has acknowledged."""
    pages: frozenset[tuple[str, str]]
    """Ingestions, by run and recipe, that have a page."""
    datasets: tuple[StoredDataset, ...]
    verdict: Verdict
    """On the current runs together."""
    changes: tuple[Finding, ...]
    """What the latest of them have changed."""
    groups: tuple[FindingGroup[str], ...]
    """Findings of the current runs by code, the worst first."""
    failed: tuple[FailedLog, ...]


@dataclass(frozen=True, slots=True)
class StoredRun:
    """A row of the page: what the index has of an ingestion, how it stands, its page, its datasets and codes of findings."""

    run_id: str
    recipe_id: str
    state: str
    facts: RunFacts | None
    href: str
    datasets: tuple[int, ...]
    codes: tuple[int, ...]
    """Places in `StoreFacts.groups`."""
    is_current: bool = False
    """Whether it counts: it is of the ruling recipe, and nothing has taken its place."""

    @property
    def begin_ns(self) -> int:
        """Return when its first segment begins [ns since 1970]; 0 where that is not known."""
        return (self.facts and self.facts.start_ns) or 0

    @property
    def used_share(self) -> float | None:
        """Return the share of the metres driven that are in segments."""
        return self.facts.kept_m / self.facts.driven_m if self.facts and self.facts.driven_m > 0 else None

    @property
    def floor(self) -> float | None:
        """Return the noise floor of E, a share."""
        return self.facts.energy_budget.total if self.facts and self.facts.energy_budget else None

    def row(self, terms: Sequence[str]) -> list[Json]:
        """Return what the page's script is told, in the order of `FIELDS`."""
        of = self.facts
        if of is None:
            return [self.run_id, self.href, None, "", self.state, "", "", *[None] * 4, "", None, [], [], None, []]
        return [
            self.run_id,
            self.href,
            None if of.start_ns is None else of.start_ns // 10**6,
            of.robot,
            self.state,
            of.superseded_by,
            ", ".join(f"{key}={value}" for key, value in of.tags.items()),
            of.segments,
            round(of.driven_m, 1),
            _compute_percent(self.used_share),
            _compute_percent(self.floor),
            of.verdict.worst,
            sum(finding.severity != "note" for finding in of.findings),
            list(self.datasets),
            list(self.codes),
            of.standing_watt,
            [of.physics[term][0] if term in of.physics else None for term in terms],
        ]


FIELDS = (
    *(
        "run",
        "href",
        "start_ms",
        "robot",
        "state",
        "superseded_by",
        "tags",
        "segments",
        "driven",
        "used",
        "floor",
        "verdict",
    ),
    *("findings", "datasets", "codes", "standing", "terms"),
)


def sort_runs(store: StoreFacts) -> list[StoredRun]:
    """Return every ingestion, what began last first; then those without a segment, and those that cannot be read."""
    found, ruling = store.found, find_recipe_key(store.found)
    members, codes = dict[tuple[str, str], list[int]](), dict[str, list[int]]()
    for number, dataset in enumerate(store.datasets):
        for part in dataset.runs if dataset.there else ():
            members.setdefault(part, []).append(number)
    for number, group in enumerate(store.groups):
        for run_id in group.of:
            codes.setdefault(run_id, []).append(number)
    rows = [
        StoredRun(
            run_id,
            recipe_id,
            _state(facts, ruling, acknowledged=run_id in store.acknowledged),
            facts,
            f"runs/{run_id}/{recipe_id}/{_PAGE}" if (run_id, recipe_id) in store.pages else "",
            tuple(members.get((run_id, recipe_id), ())),
            tuple(codes.get(run_id, ())) if facts.ingest_key == ruling else (),
            is_current=facts.ingest_key == ruling and not facts.superseded_by,
        )
        for (run_id, recipe_id), facts in found.rows.items()
    ]
    rows.sort(key=lambda run: (-run.begin_ns, run.run_id, not run.is_current, run.recipe_id))
    rows += [StoredRun(*part, "not as it was written", None, "", (), ()) for part in found.damaged]
    return rows + [
        StoredRun(name, "", f"of data model {head.data_model_version}", None, "", (), ())
        for name, head in found.outdated.items()
    ]


def find_recipe_key(found: Ingestions) -> str | None:
    """Return the key of the recipe that most runs are of; of two that the latest run is of."""
    keys = Counter(run.facts.ingest_key for run in found.finished)
    latest = {run.facts.ingest_key: max(0, run.facts.start_ns or 0) for run in found.finished}
    return max(keys, key=lambda key: (keys[key], latest[key], key), default=None)


def _state(facts: RunFacts, ruling: str | None, *, acknowledged: bool) -> str:
    if facts.superseded_by:
        return "superseded"
    if facts.ingest_key != ruling:
        return "of another recipe"
    wrong = "damaged" if facts.damage else "empty" if facts.is_empty else ""
    return f"{wrong}{', acknowledged' * acknowledged}" if wrong else "current"


def _compute_percent(share: float | None) -> float | None:
    return None if share is None else round(100.0 * share, 2)


def name_datasets(datasets: Sequence[StoredDataset]) -> list[str]:
    """Return what each dataset is called: the last part of its path, all of it where two would be called the same."""
    short = [PurePosixPath(of.out).name for of in datasets]
    return [name if short.count(name) == 1 else of.out for name, of in zip(short, datasets, strict=True)]


def format_day(facts: RunFacts | None) -> str:
    """Return when the first segment of a run begins, to the minute, UTC; "" where that is not known."""
    if facts is None or facts.start_ns is None:
        return ""
    return f"{datetime.fromtimestamp(facts.start_ns // 10**9, UTC):%Y-%m-%d %H:%M}"
