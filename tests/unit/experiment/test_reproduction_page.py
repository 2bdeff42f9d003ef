"""Differences to the paper stand on the page of a reproduction and in the documentation alike."""

from pathlib import Path

from tcpipe.experiment.reproduction_page import DIFFERENCES

PAGE = (Path(__file__).parents[3] / "docs" / "explanation" / "reproduction.md").read_text(encoding="utf-8")


def test_the_documentation_has_every_difference_in_the_same_words():
    assert [row for row in DIFFERENCES if f"| {' | '.join(row)} |" not in PAGE] == []
