"""What a command says while it works."""

import logging

import pytest
from installed_command import tcpipe

from tcpipe import __version__
from tcpipe.cli import output
from tcpipe.cli.output import show_progress, write_debug_log
from tcpipe.progress import Meter, set_task, step

LOGGER = logging.getLogger("tcpipe")


@pytest.fixture(autouse=True)
def listening(monkeypatch):
    monkeypatch.setattr(LOGGER, "disabled", False)  # the linter of the architecture tests disables it


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


def test_a_stage_is_told_hundredth_by_hundredth_and_never_beyond_its_end(caplog):
    with caplog.at_level(logging.DEBUG, "tcpipe"), set_task("a.bag"):
        meter = Meter("reading", 1000)
        for _ in range(4000):
            meter.add(0.5)
    done = [record.args[2] for record in caplog.records]
    assert len(done) == 200
    assert done[:3] == [10, 20, 30]
    assert max(done) == 1000


@pytest.mark.parametrize(
    ("as_json", "of_stdout", "drawn"), [(True, True, False), (True, False, True), (False, True, True)]
)
def test_bars_are_drawn_where_no_json_goes_to_the_terminal(as_json, of_stdout, drawn, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(output.sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(output.sys.stdout, "isatty", lambda: of_stdout, raising=False)
    assert (output._make_bars("ingest", as_json=as_json) is not None) is drawn
    monkeypatch.setenv("TERM", "dumb")
    assert output._make_bars("ingest", as_json=as_json) is None


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
