"""Columns of the samples beyond their schema: the tags of their runs, and covariates joined by time."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
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
from tcpipe.robots import Robot
from tcpipe.tables.columns import to_integers
from tcpipe.tables.findings import Finding, Subject, make_finding
from tcpipe.tables.levels import SAMPLES

if TYPE_CHECKING:
    from tcpipe.formats.covariates import CovariateTable

TAG = "tag_"
"""Prefix of a tag's column."""

_NUMBER = re.compile(r"[+-]?(\d++\.?\d*+|\.\d++)([eE][+-]?\d{1,3})?")


def read_all_covariates(paths: Sequence[Path], config: CovariateConfig) -> tuple[CovariateTable, ...]:
    """Return the tables of the files; `DatasetError` where one cannot be used or two have one name."""
    if not paths:
        return ()
    from tcpipe.formats.covariates import read_covariates  # noqa: PLC0415  polars only where a table is given

    names = [path.stem for path in paths]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise DatasetError(
            f"--covariates: {twice[0]} is given twice; columns are named after the file: give each its own name"
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
) -> tuple[pa.Table, tuple[Covariate, ...], list[Finding]]:
    """Return the added columns of all segments, M rows, the covariates for the card, and findings.

    A covariate is that of a segment's start; ``kept`` are the rows that are samples, (N,). `DatasetError` if a column has the name of
    another one or of one of ``layers``.
    """
    table, findings = _make_tag_columns(segments.column("run_id"), runs)
    covariates = list[Covariate]()
    for source in tables:
        joined, reached = source.join(to_integers(segments, "start_ns"), max_age_s=config.max_age_s)
        without = {name: int(joined.column(name).take(pa.array(kept)).null_count) for name in joined.column_names}
        covariate = Covariate(
            source.name, source.checksum, source.rows.height, source.time_column, *source.span, without
        )
        covariates.append(covariate)
        findings += (*source.findings, *_find_missing(covariate, int((~reached[kept]).sum()), len(kept)))
        for field in joined.schema:
            table = table.append_column(field, joined.column(field.name))
    names = [*SAMPLES.names(), *layers, *table.column_names]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise DatasetError(
            f"columns {', '.join(twice)} would occur twice; rename the file of covariates, or its columns"
        )
    return table, tuple(covariates), findings


def _find_missing(covariate: Covariate, unreached: int, samples: int) -> list[Finding]:
    """Return the finding that no row is near some samples, and one for each column with more missing values."""
    missing = {Subject("file", covariate.name): unreached}
    missing |= {Subject("column", name): count - unreached for name, count in covariate.samples_without.items()}
    return [
        make_finding("covariates-missing", subject, missing_count=count, sample_count=samples)
        for subject, count in missing.items()
        if count
    ]


def _make_tag_columns(run_ids: pa.ChunkedArray, runs: Sequence[RunSource]) -> tuple[pa.Table, list[Finding]]:
    """Return a column for each tag: numbers if all its values are, else text; null for runs without the tag."""
    tags = {run.run_id: run.tags or {} for run in runs}
    place = pc.index_in(run_ids, value_set=pa.array(list(tags), pa.string()))
    columns, fields, findings = list[pa.Array](), list[pa.Field](), list[Finding]()
    for key in sorted({key for of in tags.values() for key in of}):
        texts = [of.get(key) for of in tags.values()]
        different = {text for text in texts if text is not None}
        words = sorted(text for text in different if not _NUMBER.fullmatch(text.strip()))
        if words and len(words) < len(different):
            subject, names, count = Subject("tag", key), {"example": words[0]}, len(different)
            findings.append(
                make_finding("column-is-text", subject, names=names, odd_count=len(words), value_count=count)
            )
        numbers = None if words else [None if text is None else float(text) for text in texts]
        values = pa.array(texts, pa.string()) if numbers is None else pa.array(numbers, pa.float64())
        columns.append(values.take(place))
        fields.append(pa.field(f"{TAG}{key}", values.type, metadata={"unit": "", "doc": f"tag {key} of the run"}))
    if not fields:
        return pa.table({"run_id": run_ids}).select([]), findings
    return pa.table(columns, schema=pa.schema(fields)), findings


def read_tags(run_ids: Sequence[str], runs: Sequence[RunSource], key: str) -> list[str]:
    """Return a tag's value for each run of a list; `DatasetError` that names the runs without it."""
    tags = {run.run_id: (run.tags or {}).get(key) for run in runs}
    missing = [run_id for run_id in run_ids if tags[run_id] is None]
    if missing:
        raise DatasetError(
            f"holdout by tag {key}: {len(missing)} of {len(run_ids)} runs do not have it ({', '.join(missing[:3])}); "
            f"ingest their logs again with --tag {key}=VALUE"
        )
    return [str(tags[run_id]) for run_id in run_ids]


def find_narrow_patches(robots: Sequence[str], known: Mapping[str, Robot], *, patch_m: float) -> list[Finding]:
    """Return a finding for each robot that is wider than a patch, or of unknown width."""
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
