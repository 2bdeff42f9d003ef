"""Columns of the samples beyond their schema: the tags of their runs, and covariates joined by time."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from tcpipe.errors import DatasetError
from tcpipe.formats.dataset_card import Covariate, RunSource
from tcpipe.recipe import CovariateConfig
from tcpipe.recipe.suggestions import suggest
from tcpipe.robots.profiles import Robot
from tcpipe.tables.columns import to_integers
from tcpipe.tables.findings import Finding, Subject, make_finding
from tcpipe.tables.levels import SAMPLES

if TYPE_CHECKING:
    from tcpipe.formats.covariates import CovariateTable

TAG = "tag_"
"""What the column of a tag is called before the tag's name."""

_NUMBER = re.compile(r"[+-]?(\d++\.?\d*+|\.\d++)([eE][+-]?\d{1,3})?")


@dataclass(frozen=True, slots=True)
class Added:
    """Columns beside those of SAMPLES, a row a segment, and what the card says of them."""

    table: pa.Table
    covariates: tuple[Covariate, ...]
    findings: tuple[Finding, ...]


def read_all_covariates(paths: Sequence[Path], config: CovariateConfig) -> tuple[CovariateTable, ...]:
    """Return the tables of the files; `DatasetError` where one cannot be used or two have one name."""
    if not paths:
        return ()
    from tcpipe.formats.covariates import read_covariates  # noqa: PLC0415  polars only where a table is given

    names = [path.stem for path in paths]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise DatasetError(
            f"--covariates: {twice[0]} is given twice; columns are called by the file's name: give each its own"
        )
    return tuple(read_covariates(path, time_column=config.time_column, time_unit=config.time_unit) for path in paths)


def make_added_columns(
    segments: pa.Table,
    kept: NDArray[np.int64],
    runs: Sequence[RunSource],
    tables: Sequence[CovariateTable],
    config: CovariateConfig,
    *,
    layers: Sequence[str],
) -> Added:
    """Return the added columns of all segments.

    Parameters
    ----------
    segments : with ``run_id`` and ``start_ns``, M rows; a covariate is that of a segment's start.
    kept : rows that are samples, (N,): what is counted.
    runs : for their tags.
    tables, config : covariates, and how they are joined.
    layers : names of the patches' layers, which no column may have.

    Raises
    ------
    DatasetError : two columns would have one name.
    """
    table, findings = _make_tag_columns(segments.column("run_id"), runs)
    told = list[Covariate]()
    for covariates in tables:
        found, reached = covariates.join(to_integers(segments, "start_ns"), max_age_s=config.max_age_s)
        without = {name: int(found.column(name).take(pa.array(kept)).null_count) for name in found.column_names}
        told.append(
            Covariate(
                covariates.name,
                covariates.checksum,
                covariates.rows.height,
                covariates.time_column,
                *covariates.span,
                without,
            )
        )
        findings += (*covariates.findings, *_find_missing(told[-1], int((~reached[kept]).sum()), len(kept)))
        for field in found.schema:
            table = table.append_column(field, found.column(field.name))
    names = [*SAMPLES.names(), *layers, *table.column_names]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise DatasetError(
            f"columns {', '.join(twice)} would be there twice; rename the file of covariates, or its columns"
        )
    return Added(table, tuple(told), tuple(findings))


def _find_missing(told: Covariate, unreached: int, samples: int) -> list[Finding]:
    """Return the finding that no row reaches some samples, and one for each column that lacks values beyond that."""
    missing = {Subject("file", told.name): unreached}
    missing |= {Subject("column", name): count - unreached for name, count in told.samples_without.items()}
    return [
        make_finding("covariates-missing", subject, missing_count=count, sample_count=samples)
        for subject, count in missing.items()
        if count
    ]


def _make_tag_columns(run_ids: pa.ChunkedArray, runs: Sequence[RunSource]) -> tuple[pa.Table, list[Finding]]:
    """Return a column a tag: numbers where every run that carries it has one, else text; null for runs without it."""
    tags = {run.run_id: run.tags or {} for run in runs}
    place = pc.index_in(run_ids, value_set=pa.array(list(tags), pa.string()))
    columns, fields, findings = list[pa.Array](), list[pa.Field](), list[Finding]()
    for key in sorted({key for of in tags.values() for key in of}):
        told = [of.get(key) for of in tags.values()]
        words = sorted({text for text in told if text is not None and not _NUMBER.fullmatch(text.strip())})
        different = len({text for text in told if text is not None})
        if words and len(words) < different:
            finding = make_finding(
                "column-is-text",
                Subject("tag", key),
                names={"example": words[0]},
                odd_count=len(words),
                value_count=different,
            )
            findings.append(finding)
        values = (
            pa.array(told, pa.string())
            if words
            else pa.array([None if text is None else float(text) for text in told], pa.float64())
        )
        columns.append(values.take(place))
        fields.append(pa.field(f"{TAG}{key}", values.type, metadata={"unit": "", "doc": f"tag {key} of the run"}))
    if not fields:
        return pa.table({"run_id": run_ids}).select([]), findings
    return pa.table(columns, schema=pa.schema(fields)), findings


def tag_of_each(run_ids: Sequence[str], runs: Sequence[RunSource], key: str) -> list[str]:
    """Return a tag's value for each run of a list; `DatasetError` that names the runs without it."""
    tags = {run.run_id: (run.tags or {}).get(key) for run in runs}
    missing = [run_id for run_id in run_ids if tags[run_id] is None]
    if missing:
        raise DatasetError(
            f"holdout by tag {key}: {len(missing)} of {len(run_ids)} runs do not carry it ({', '.join(missing[:3])}); "
            f"ingest their logs again with --tag {key}=VALUE"
        )
    return [str(tags[run_id]) for run_id in run_ids]


def find_narrow_patches(robots: Sequence[str], known: Mapping[str, Robot], *, patch_m: float) -> list[Finding]:
    """Return a finding for each robot that is wider than a patch, or of which no width is known."""
    findings = []
    for robot in sorted(set(robots)):
        width_m = known[robot].width_m if robot in known else None
        subject = Subject("robot", robot)
        if width_m is None:
            findings.append(make_finding("robot-width-unknown", subject, patch_m=patch_m))
        elif width_m > patch_m:
            remedies = suggest("wider", {"sample": {"patch_m": width_m}})
            findings.append(
                make_finding("patch-narrower-than-robot", subject, remedies=remedies, width_m=width_m, patch_m=patch_m)
            )
    return findings
