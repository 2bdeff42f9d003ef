"""The options of ``tcpipe ingest`` and `tcpipe.ingest`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tcpipe.tables.options import CLUSTER, MESSAGE_DEFINITIONS, RECIPE, STORE, Option, jobs, option, required, tags

if TYPE_CHECKING:
    from tcpipe.pipeline.plan import IngestResult
    from tcpipe.recipe import Recipe


@dataclass(frozen=True, slots=True)
class IngestOptions:
    """Which logs are ingested, into which store, and how."""

    logs: Iterable[str | Path] = required(Option(kind="several", metavar="LOG...", repeatable=True, is_argument=True))
    """Files, ROS 2 bag directories, folders searched downward, or URLs of such (``s3://…``), which are read by range or copied."""
    _: KW_ONLY
    store: str | Path = option("tcpipe-store", STORE)
    recipe: Recipe | str | Path | None = option(None, RECIPE)
    robot: str | None = option(
        None,
        Option(
            "Robot profile, built in or from the recipe (default: found by message types and topic names).",
            kind="robot",
            metavar="NAME",
        ),
    )
    tags: Mapping[str, str] | None = tags("Tag for the runs; repeatable.")
    jobs: int = jobs("Logs")
    cluster: str | None = option(None, CLUSTER)
    """Its workers see logs and store under the same absolute paths."""
    as_one: bool = option(False, Option("Treat all logs as parts of one drive (split logs; power in a separate log)."))
    message_definitions: str | Path | None = option(None, MESSAGE_DEFINITIONS)
    shard: tuple[int, int] | None = option(
        None,
        Option("Ingest only the I-th of N shares of the logs: one for each task of an array job.", (), "shard", "I/N"),
    )
    min_age_s: float = option(
        0.0,
        Option(
            "Skip logs that were changed more recently than this (90, 90s, 10m, 2h, 1d).",
            ("--min-age",),
            "duration",
            "T",
            shown="0",
        ),
    )
    retry_failed: bool = option(False, Option("Try logs again that failed before."))
    force: bool = option(False, Option("Ingest all logs again, also those that failed before."))
    on_found: Callable[[Mapping[str, int]], None] | None = None
    """Called once with the size [byte] of every log by its name."""
    on_result: Callable[[IngestResult], None] | None = None
    """Called as each log ends, in the order of ending."""
