"""What a terminal shows while logs are worked on."""

import io
import re
from itertools import count
from types import SimpleNamespace

import pytest
from rich.console import Console

from tcpipe.cli import bars
from tcpipe.cli.bars import Bars
from tcpipe.progress import Step

HOSTILE = "/logs/[red]a\x1b]0;owned\x07\x1b[31m\u202e.bag"
MB = 1_000_000


@pytest.fixture
def screen(monkeypatch):
    """Bars on a terminal of memory, whose clock goes on by a second each time it is read; and what is on it."""
    ticks = count()
    monkeypatch.setattr(bars, "time", SimpleNamespace(monotonic=lambda: float(next(ticks))))
    console = Console(file=io.StringIO(), force_terminal=True, width=140, color_system=None)
    shown = Bars("ingest", console)
    return shown, lambda: "\n".join(_drawn(shown))


def _drawn(shown):
    console = Console(file=io.StringIO(), width=140, color_system=None)
    console.print(shown._shown.get_renderable())
    return console.file.getvalue().splitlines()


def test_a_log_under_way_has_its_name_stage_and_bytes_and_all_have_a_count_rate_and_time_left(screen):
    shown, drawn = screen
    shown.expect({"/logs/a.bag": 60 * MB, "/logs/b.bag": 40 * MB})
    shown.step(Step("/logs/a.bag", "reading", 30 * MB, 60 * MB))
    assert re.search(r"a\.bag .* reading 30\.0 of 60\.0 MB", drawn())
    shown.end("/logs/a.bag", worked=True)  # 60 of 100 MB, at the second second
    assert "1/2, 30.0 MB/s, 0:01 left" in drawn()
    assert "a.bag" not in drawn()


def test_what_needed_no_work_says_nothing_of_the_rate(screen):
    shown, drawn = screen
    shown.expect({"a": 600 * MB, "b": 40 * MB})
    shown.end("a", worked=False)
    assert "1/2" in drawn()
    assert "MB/s" not in drawn()


def test_more_logs_than_there_is_room_for_are_counted(screen):
    shown, drawn = screen
    shown.expect({f"{n}.bag": MB for n in range(12)})
    for n in range(12):
        shown.step(Step(f"{n}.bag", "fusing", 0, 0))
    assert drawn().count("fusing") == 8
    assert "4 more under way" in drawn()


def test_a_name_is_shown_as_text(screen):
    shown, drawn = screen
    shown.expect({HOSTILE: MB})
    shown.step(Step(HOSTILE, "fusing", 0, 0))
    assert all(c.isprintable() or c == "\n" for c in drawn())
    assert "[red]a\\x1b" in drawn()


@pytest.mark.parametrize("no_color", [True, False])
def test_no_color_is_heeded(monkeypatch, no_color):
    monkeypatch.setenv("TERM", "xterm-256color")
    if no_color:
        monkeypatch.setenv("NO_COLOR", "1")
    else:
        monkeypatch.delenv("NO_COLOR", raising=False)
    console = Console(file=io.StringIO(), force_terminal=True, width=100)
    shown = Bars("ingest", console)
    shown.start()
    shown.expect({"a": MB})
    shown.step(Step("a", "reading", MB // 2, MB))
    shown.stop()
    coloured = re.search(r"\x1b\[[0-9;]*(3[0-9]|9[0-7])[0-9;]*m", console.file.getvalue())
    assert (coloured is None) is no_color
