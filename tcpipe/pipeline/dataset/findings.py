"""What ingest found of the runs that a dataset is made of, grouped by cause, and how many samples carry a doubt."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from tcpipe.formats.dataset_card import Doubtful, RunFinding, RunSource
from tcpipe.tables.bits import Quality, name_of
from tcpipe.tables.facts import by_cause

_MOST_SHOWN = 8


def findings_of_runs(runs: Sequence[RunSource]) -> tuple[RunFinding, ...]:
    """Return what ingest warned of by cause; what most samples are from comes first."""
    samples = {run.run_id: run.samples for run in runs}
    found = (
        RunFinding(next(iter(of.values())), tuple(of), sum(samples[run_id] for run_id in of))
        for of in by_cause((run.run_id, run.warnings) for run in runs)
    )
    return tuple(sorted(found, key=lambda finding: -finding.samples))


def doubtful(quality: pa.ChunkedArray) -> Doubtful:
    """Return how many samples carry any quality bit, and how many each; ``quality`` is their column."""
    bits = quality.to_numpy().astype(np.int64)
    counts = {name_of(bit): int(np.count_nonzero(bits & int(bit))) for bit in Quality}
    count = int(np.count_nonzero(bits))
    return Doubtful(count, count / max(len(bits), 1), {name: of for name, of in counts.items() if of})


def doubt_in_words(found: Doubtful, samples: int) -> str:
    """Return the share of doubtful samples, and of what, the most frequent first, as one line."""
    by_bit = sorted(found.by_bit.items(), key=lambda entry: (-entry[1], entry[0]))
    of_what = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in by_bit)
    return f"doubtful: {found.samples} of {samples} samples ({100 * found.share:.1f} %) carry a quality flag" + (
        f": {of_what}" if of_what else ""
    )


def findings_in_words(findings: Sequence[RunFinding]) -> list[str]:
    """Return a line for each cause, the rarest cut."""
    lines = [f"found at ingest of {_counted(finding)}: {finding.example}" for finding in findings[:_MOST_SHOWN]]
    more = len(findings) - _MOST_SHOWN
    return lines + ([f"found at ingest: {more} more causes, in dataset.json and report.html"] if more > 0 else [])


def _counted(finding: RunFinding) -> str:
    runs = finding.runs[0] if len(finding.runs) == 1 else f"{len(finding.runs)} runs"
    return f"{runs} ({finding.samples} sample{'' if finding.samples == 1 else 's'})"
