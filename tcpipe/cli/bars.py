"""What a terminal shows of work under way: a bar of all, and below it one of each log that is worked on."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from tcpipe.errors import clean_line
from tcpipe.progress import Step

_SHARES = {"hashing": (0.0, 0.03), "reading": (0.03, 0.2), "fusing": (0.2, 0.95), "cutting and labelling": (0.95, 1.0)}
"""Where in the time that a log takes its stages begin and end, as a share; roughly, cameras shift it."""
_MOST_ROWS = 8
_LONGEST_NAME = 40


@dataclass(slots=True)
class _Row:
    """A log that is worked on: its row, None where there are too many, and its share that is done."""

    row: TaskID | None
    share: float = 0.0


class Bars:
    """The bars; they go when the work is done."""

    def __init__(self, what: str, console: Console) -> None:
        texts = (TextColumn(f"{{task.{name}}}", markup=False) for name in ("description", "fields[said]"))
        self._shown = Progress(
            next(texts),
            BarColumn(24),
            *texts,
            console=console,
            transient=True,
            redirect_stdout=False,
            refresh_per_second=4,
        )
        self._all = self._shown.add_task(clean_line(what), total=None, said="")
        self._rows: dict[str, _Row] = {}
        self._sizes: Mapping[str, int] = {}
        self._waiting, self._done, self._begun_s = 0, 0, time.monotonic()

    def start(self) -> None:
        """Show them."""
        self._shown.start()

    def stop(self) -> None:
        """Remove them."""
        self._shown.stop()

    def print(self, text: str) -> None:
        """Print a line above."""
        self._shown.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def expect(self, sizes: Mapping[str, int]) -> None:
        """Begin with logs of these sizes [byte]."""
        self._sizes, self._waiting = sizes, sum(sizes.values())
        self._shown.update(self._all, total=len(sizes), said=f"0/{len(sizes)}")

    def count(self, done: int, total: int, stage: str = "") -> None:
        """Show how many of how many are done."""
        self._shown.update(self._all, total=total, completed=done, said=f"{stage} {100 * done // max(total, 1)} %")

    def step(self, step: Step) -> None:
        """Show how far a log is."""
        if not step.task:
            if step.total:
                self.count(step.done, step.total, step.stage)
            return
        row = self._rows.get(step.task)
        if row is None:
            room = sum(other.row is not None for other in self._rows.values()) < _MOST_ROWS
            name = clean_line(step.task.rsplit("/", 1)[-1])[-_LONGEST_NAME:]
            row = self._rows[step.task] = _Row(self._shown.add_task(f"  {name}", total=1.0, said="") if room else None)
        start, end = _SHARES.get(step.stage, (row.share, row.share))
        row.share = max(row.share, start + (end - start) * step.done / max(step.total, 1))
        if row.row is not None:
            of = f" {_format_megabytes(step.done)} of {_format_megabytes(step.total)} MB" if step.total else ""
            self._shown.update(row.row, completed=row.share, said=step.stage + of)
        self._say_rate()

    def end(self, task: str, *, worked: bool) -> None:
        """Count a log that is done; where nothing had to be ``worked`` on, it tells nothing of the rate."""
        row, size = self._rows.pop(task, None), self._sizes.get(task, 0)
        if row is not None and row.row is not None:
            self._shown.remove_task(row.row)
        self._waiting -= size
        self._done += size if worked else 0
        self._shown.advance(self._all)
        self._say_rate()

    def _say_rate(self) -> None:
        """Say how many logs are done, how fast, and how long the others will take at that."""
        under_way = sum(self._sizes.get(task, 0) * row.share for task, row in self._rows.items())
        done, took_s = self._done + under_way, time.monotonic() - self._begun_s
        finished = round(self._shown.tasks[0].completed)
        said = f"{finished}/{len(self._sizes)}"
        if done and took_s > 0:
            left = divmod(round((self._waiting - under_way) / done * took_s), 60)
            said += f", {_format_megabytes(done / took_s)} MB/s, {left[0]}:{left[1]:02d} left"
        hidden = sum(row.row is None for row in self._rows.values())
        self._shown.update(self._all, said=said + (f", {hidden} more under way" if hidden else ""))


def _format_megabytes(size_bytes: float) -> str:
    return f"{size_bytes / 1e6:.1f}"
