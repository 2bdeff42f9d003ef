"""Options that were renamed are read by their earlier names, which help does not show."""

import pytest

from tcpipe.cli import cli

EARLIER = [
    ("train", ["--batch", "32"], "batch", 32),
    ("train", ["--weights"], "weights", True),
    ("train", ["--beside"], "beside", True),
    ("train", ["--fresh"], "fresh", True),
    ("evaluate", ["--draws", "2"], "draws", 2),
    ("evaluate", ["--retrain"], "retrain", True),
    ("predict-path", ["--physics", "."], "physics", "."),
    ("plan-path", ["--physics", "."], "physics", "."),
    ("plan-path", ["--step", "2"], "step_m", 2.0),
    ("plan-path", ["--allow-unseen"], "allow_unseen", True),
    ("cost-map", ["--step", "2"], "step_m", 2.0),
    ("reproduce", ["--hidden", "2"], "hidden", 2.0),
]


@pytest.mark.parametrize(("name", "given", "parameter", "value"), EARLIER)
def test_an_earlier_name_is_read_and_not_shown(name: str, given: list[str], parameter: str, value: object) -> None:
    command = cli.commands[name]
    context = command.make_context(name, [*given], resilient_parsing=True)
    assert context.params[parameter] == value
    assert not {given[0], f"{given[0]},"} & set(command.get_help(context).split())
