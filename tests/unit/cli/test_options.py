"""Values of options that are more than a number."""

import click
import pytest

from tcpipe.cli.options import parse_duration, parse_shard

CONTEXT, PARAMETER = click.Context(click.Command("tcpipe")), click.Option(["--x"])


@pytest.mark.parametrize(
    ("text", "seconds"), [("0", 0.0), ("90", 90.0), ("1.5 s", 1.5), ("10m", 600.0), ("2h", 7200.0), ("1d", 86400.0)]
)
def test_a_time(text, seconds):
    assert parse_duration(CONTEXT, PARAMETER, text) == seconds


@pytest.mark.parametrize("text", ["", "-1", "nan", "inf", "1e3", "10 weeks", "9" * 10, "m"])
def test_what_is_no_time(text):
    with pytest.raises(click.BadParameter, match="wanted a time"):
        parse_duration(CONTEXT, PARAMETER, text)


def test_a_share():
    assert [parse_shard(CONTEXT, PARAMETER, text) for text in (None, "1/1", "3/8")] == [None, (1, 1), (3, 8)]


@pytest.mark.parametrize("text", ["0/2", "3/2", "1", "a/b", "1/100001", "-1/2", "1/2/3", ""])
def test_what_is_no_share(text):
    with pytest.raises(click.BadParameter, match="wanted I/N"):
        parse_shard(CONTEXT, PARAMETER, text)
