"""What a command says while it works."""

import io
import logging
from itertools import count
from types import SimpleNamespace

import pytest
from installed_command import tcpipe
from rich.console import Console

from tcpipe import __version__
from tcpipe.cli import output
from tcpipe.cli.output import Progress, show_progress, write_debug_log
from tcpipe.progress import Meter, Step, set_task, step

LOGGER = logging.getLogger("tcpipe")
HOSTILE = "/logs/[red]a\x1b]0;owned\x07\x1b[31m\u202e.bag"
MB = 1_000_000


@pytest.mark.parametrize(
    ("quiet", "said"), [(False, ["reading", "tcpipe: the disk is full"]), (True, ["tcpipe: the disk is full"])]
)
def test_an_error_is_told_also_where_progress_is_not_wanted(quiet, said, capsys):
    with show_progress("ingest", quiet=quiet):
        LOGGER.info("reading")
        LOGGER.error("the disk is full")
    assert capsys.readouterr().err.splitlines() == said


def test_without_a_terminal_each_stage_of_a_log_is_one_line(capsys):
    with show_progress("ingest", quiet=False), set_task("a.bag"):
        step("reading")
        meter = Meter("reading", 1000)
        for _ in range(100):
            meter.add(10)
        step("fusing")
    assert capsys.readouterr() == ("", "a.bag: reading\na.bag: fusing\n")


@pytest.mark.parametrize(
    ("as_json", "of_stdout", "drawn"), [(True, True, False), (True, False, True), (False, True, True)]
)
def test_bars_are_drawn_where_no_json_goes_to_the_terminal(as_json, of_stdout, drawn, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(output.sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(output.sys.stdout, "isatty", lambda: of_stdout, raising=False)
    assert (output._open_terminal(as_json=as_json) is not None) is drawn
    monkeypatch.setenv("TERM", "dumb")
    assert output._open_terminal(as_json=as_json) is None


@pytest.mark.parametrize("words", [("--debug", "inspect", "nothing"), ("inspect", "nothing", "--debug")])
def test_debug_stands_before_or_after_the_command_and_ends_with_it(words, tmp_path):
    said = tcpipe(*words, cwd=tmp_path)
    assert said.returncode == 2
    assert "Traceback" in said.stderr
    assert f"tcpipe {__version__}, Python " in said.stderr.splitlines()[0]
    assert not LOGGER.isEnabledFor(logging.DEBUG)
    assert tcpipe("inspect", "nothing", cwd=tmp_path).stderr.startswith("tcpipe: nothing: ")


@pytest.mark.parametrize(
    ("lacking", "said"),
    [
        ("torch.nn", "pip install 'tcpipe[train]'"),
        ("lightgbm", "pip install 'tcpipe[tables]'"),
        ("numpy", "internal error"),
    ],
)
def test_what_an_extra_brings_is_named_with_it(lacking, said, tmp_path, monkeypatch):
    def lacks(*_, **__):
        raise ModuleNotFoundError(name=lacking)

    monkeypatch.setattr("tcpipe.formats.recipe_toml.format_commented_toml", lacks)
    done = tcpipe("init", cwd=tmp_path)
    assert done.returncode == 1
    assert said in done.stderr


def test_the_debug_log_says_when_and_takes_the_place_of_progress(capsys):
    with write_debug_log(), show_progress("ingest", quiet=False), set_task("a.bag"):
        step("reading")
        step("reading", 5, 10)
        LOGGER.debug("which topic is what")
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(" ", 1)[1] for line in lines] == ["a.bag: reading", "which topic is what"]
    assert all(line[2] == line[5] == ":" for line in lines)


@pytest.fixture
def screen(monkeypatch):
    """Bars on a terminal of memory, whose clock goes on by a second each time it is read; and what is on it."""
    ticks = count()
    monkeypatch.setattr(output, "time", SimpleNamespace(monotonic=lambda: float(next(ticks))))
    console = Console(file=io.StringIO(), force_terminal=True, width=140, color_system=None)
    shown = Progress("ingest", quiet=False, console=console)
    return shown, lambda: "\n".join(_drawn(shown))


def _drawn(shown):
    console = Console(file=io.StringIO(), width=140, color_system=None)
    console.print(shown._bars.get_renderable())
    return console.file.getvalue().splitlines()


def test_a_log_under_way_has_its_name_stage_and_bytes_and_all_have_a_count_rate_and_time_left(screen):
    shown, drawn = screen
    shown.expect({"/logs/a.bag": 60 * MB, "/logs/b.bag": 40 * MB})
    shown.step(Step("/logs/a.bag", "reading", 30 * MB, 60 * MB))
    assert "0/2; a.bag: reading 30.0 of 60.0 MB" in drawn()
    shown.end("/logs/a.bag", worked=True)  # 60 of 100 MB, at the third second
    assert "1/2, 30.0 MB/s, 0:01 left" in drawn()
    assert "a.bag" not in drawn()


def test_a_bar_of_parts_fills_and_never_falls(screen):
    shown, drawn = screen
    filled = []
    for part in range(2):
        shown.begin_part(part, 2, "simulating")
        for stage in ("reading", "fusing", "reading"):
            for done in (0, 5, 10):
                shown.step(Step("", stage, done, 10))
                filled.append(drawn().count("\u2501"))
    assert filled == sorted(filled)
    assert 0 < filled[8] < 12 < filled[-1] < 24


def test_a_name_is_shown_as_text(screen):
    shown, drawn = screen
    shown.expect({HOSTILE: MB})
    shown.step(Step(HOSTILE, "fusing", 0, 0))
    assert all(c.isprintable() or c == "\n" for c in drawn())
    assert "[red]a\\x1b" in drawn()
