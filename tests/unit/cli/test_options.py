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


def test_a_share():
    assert [parse_shard(CONTEXT, PARAMETER, text) for text in (None, "1/1", "3/8")] == [None, (1, 1), (3, 8)]


@pytest.mark.parametrize(
    ("parse", "text", "wanted"),
    [
        *((parse_duration, text, "a time") for text in ("", "-1", "nan", "inf", "1e3", "10 weeks", "9" * 10, "m")),
        *((parse_shard, text, "I/N") for text in ("0/2", "3/2", "1", "a/b", "1/100001", "-1/2", "1/2/3", "")),
    ],
)
def test_what_is_neither(parse, text, wanted):
    with pytest.raises(click.BadParameter, match=f"expected {wanted}"):
        parse(CONTEXT, PARAMETER, text)
