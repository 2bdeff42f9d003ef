"""Options that were renamed are read by their earlier names, which help does not show."""

import pytest

from tcpipe.cli import cli
from tcpipe.cli.options import RenamedOption
from tcpipe.tables.options import EARLIER_CHOICES

EARLIER = [
    ("train", ["--batch", "32"], "batch_size", 32),
    ("train", ["--weights"], "inverse_variance_weights", True),
    ("train", ["--beside"], "extra_features", True),
    ("train", ["--fresh"], "no_resume", True),
    ("train", ["--model", "table"], "model", "boosting"),
    ("train", ["--label", "above_standing"], "label", "net"),
    ("evaluate", ["--draws", "2"], "noise_draws", 2),
    ("predict-path", ["--physics", "."], "physics_from", "."),
    ("plan-path", ["--physics", "."], "physics_from", "."),
    ("plan-path", ["--step", "2"], "cell_size_m", 2.0),
    ("plan-path", ["--allow-unseen"], "allow_extrapolation", True),
    ("cost-map", ["--step", "2"], "cell_size_m", 2.0),
]


@pytest.mark.parametrize(("name", "given", "parameter", "value"), EARLIER)
def test_an_earlier_name_is_read_and_not_shown(name: str, given: list[str], parameter: str, value: object) -> None:
    command = cli.commands[name]
    context = command.make_context(name, [*given], resilient_parsing=True)
    assert context.params[parameter] == value
    assert value in ("boosting", "net") or not {given[0], f"{given[0]},"} & set(command.get_help(context).split())


def test_every_earlier_name_is_tried_above() -> None:
    tried = {(name, given[0]) for name, given, *_ in EARLIER}
    renamed = {
        (name, option.earlier)
        for name, command in cli.commands.items()
        for option in command.params
        if isinstance(option, RenamedOption)
    }
    assert tried - {("train", "--model"), ("train", "--label")} == renamed
    assert {given[1] for _, given, *_ in EARLIER if len(given) == 2} >= EARLIER_CHOICES.keys()


def test_the_earlier_name_of_a_command_is_hidden_and_does_the_same() -> None:
    earlier, command = cli.commands["accept"], cli.commands["acknowledge"]
    assert earlier.hidden
    assert (earlier.callback, earlier.params) == (command.callback, command.params)
