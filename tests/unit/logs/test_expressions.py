"""Expressions of columns: what Python computes of the same text, and nothing but arithmetic."""

import random

import numpy as np
import pytest

from tcpipe.logs.expressions import ExpressionError, parse_expression

VALUES = {"velL": np.array([1.0, 2.0, 4.0]), "velR": np.array([3.0, 5.0, 0.0]), "a.b": np.array([1.0, 0.5, 0.25])}
LISTS = {"acc": np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])}


def read(name, index):
    return VALUES[name] if index is None else LISTS[name][:, index]


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("velL", [1, 2, 4]),
        ("(velL + velR) / 2", [2, 3.5, 2]),
        ("(velR - velL) / 0.5", [4, 6, -8]),
        ("-`velL` * 1e-1", [-0.1, -0.2, -0.4]),
        ("acc[1] * a.b + 3", [5, 5, 4.5]),
        ("1 / velR", [1 / 3, 0.2, np.inf]),
        ("acc[0]", [1, 3, 5]),
    ],
)
def test_arithmetic_of_columns(text, wanted):
    assert parse_expression(text).evaluate(read).tolist() == pytest.approx(wanted)


def test_a_column_s_own_name_comes_before_its_meaning_as_an_expression():
    name = "velL - velR"
    found = parse_expression(name, [name])
    assert (found.column, found.operands()) == (name, [(name, None)])
    assert parse_expression("`Power (w)` / 2").operands() == [("Power (w)", None)]


@pytest.mark.parametrize(
    "text",
    ["", "lat (deg)", "__import__('os')", "velL ** 9", "velL if velR else 1", "[velL]", "'text'", "True", "1j", "velL[velR]", "("
     * 400, "-" * 5000 + "velL", "velL +", "a\0b", "(lambda: 1)()", "velL.real()"],
)  # fmt: skip
def test_nothing_else_is_an_expression(text):
    with pytest.raises(ExpressionError):
        parse_expression(text)


def test_random_expressions_are_what_python_computes():
    rng = random.Random(7)  # noqa: S311

    def grow(depth):
        if depth == 0:
            return rng.choice(["velL", "velR", f"{rng.uniform(0.5, 3):.3f}"])
        return f"({grow(depth - 1)} {rng.choice('+-*')} {grow(depth - 1)})"

    for _ in range(50):
        text = grow(rng.randint(1, 4))
        wanted = [eval(text, {}, {name: float(VALUES[name][row]) for name in ("velL", "velR")}) for row in range(3)]  # noqa: S307
        assert np.broadcast_to(parse_expression(text).evaluate(read), 3).tolist() == pytest.approx(wanted, rel=1e-12)
