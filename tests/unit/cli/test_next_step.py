"""The groups of ``tcpipe --help``, and the next step that a command names when it ends."""

import string

import pytest
from installed_command import tcpipe
from synthetic_store import small_store

from tcpipe.cli import _COMMANDS, _NEXT_STEPS, cli


@pytest.mark.parametrize("name", _NEXT_STEPS)
def test_a_next_step_is_filled_from_parameters_of_its_command(name):
    words = {word for _, word, _, _ in string.Formatter().parse(_NEXT_STEPS[name]) if word}
    assert name in _COMMANDS
    assert words <= {parameter.name for parameter in cli.commands[name].params}


def test_a_command_names_the_next_step_with_its_own_paths(tmp_path):
    store = small_store(tmp_path).root
    done = tcpipe("prune", "--dry-run", "--store", store, cwd=tmp_path)
    assert done.stderr == f"next: tcpipe status --store {store}\n"
    done = tcpipe("inspect", store, cwd=tmp_path)
    assert done.stderr == f"next: tcpipe build-dataset --store {store}\n"
    done = tcpipe("build-dataset", "a set", "--store", store, "--quiet", cwd=tmp_path)
    assert done.stderr == ""
    done = tcpipe("inspect", "a set", cwd=tmp_path)
    assert done.stderr == "next: tcpipe report 'a set'\n"


def test_no_next_step_follows_a_failure_or_json(tmp_path):
    store = small_store(tmp_path).root
    assert tcpipe("prune", "--dry-run", "--store", store, "--json", cwd=tmp_path).stderr == ""
    failed = tcpipe("prune", "no-such-run", "--store", store, cwd=tmp_path)
    assert failed.returncode == 2
    assert "next:" not in failed.stderr
