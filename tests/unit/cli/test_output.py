"""What a command says while it works."""

import logging

import pytest

from tcpipe.cli.output import progress


@pytest.mark.parametrize(
    ("quiet", "said"), [(False, ["reading", "tcpipe: the disk is full"]), (True, ["tcpipe: the disk is full"])]
)
def test_an_error_is_told_also_where_progress_is_not_wanted(quiet, said, capsys):
    with progress("ingest", 1, quiet=quiet):
        logging.getLogger("tcpipe").info("reading")
        logging.getLogger("tcpipe").error("the disk is full")
    assert capsys.readouterr().err.splitlines() == said
