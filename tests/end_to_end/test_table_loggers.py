"""Tables as people log them reach labels with two commands and at most three edited lines, and labels are what their σ claims."""

import re

import pytest
from click.testing import CliRunner
from table_loggers import LOGGERS, Drive

from tcpipe.cli import cli
from tcpipe.store import Store


def run(*words):
    done = CliRunner().invoke(cli, [str(word) for word in words], standalone_mode=False, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


@pytest.mark.parametrize("name", LOGGERS)
def test_a_logger_needs_two_commands_and_three_lines(tmp_path, name):
    logger, drive, recipe = LOGGERS[name], Drive(seed=7), tmp_path / "tcpipe.toml"
    logger.write(drive, tmp_path / "log")
    assert len(logger.edits) <= 3
    run("init", tmp_path, "--from", tmp_path / "log" / logger.given)
    text = recipe.read_text()
    for key, value in logger.edits.items():
        text, edited = re.subn(rf"^# {re.escape(key)} = .*", f"{key} = {value}", text, count=1, flags=re.MULTILINE)
        assert edited == 1, key
    recipe.write_text(text)
    run("ingest", tmp_path / "log" / logger.given, "--store", tmp_path / "store", "--recipe", recipe)
    (found,) = Store(tmp_path / "store").runs()
    segments, of_duration, of_energy = drive.judge(found.segments())
    assert segments > 60
    assert min(of_duration, of_energy) >= 0.92
