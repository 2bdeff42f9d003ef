"""Expressions of columns in a recipe, as ``(velL + velR) / 2`` or ``pvt.lat * 1e-7``, and the unit that a column's name states."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FORM = 'a column, or numbers and columns joined by + - * / ( ), as "(velL + velR) / 2"; other names in backquotes, as "`Power (w)` * 2"'
_LONGEST = 300
"""Characters: nothing that is nested deeper than the parser goes."""
_QUOTED = re.compile(r"`([^`]*)`")
_OPERATORS = {ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide}


class ExpressionError(ValueError):
    """The text is no expression of columns."""


@dataclass(frozen=True, slots=True)
class Expression:
    """Columns joined by arithmetic; ``column`` is its name where it is one column as it stands."""

    tree: ast.expr | None
    quoted: tuple[str, ...] = ()
    column: str | None = None

    def operands(self) -> list[tuple[str, int | None]]:
        """Return the columns that it reads, each with the element of its list, None where it is no list."""
        return [(self.column, None)] if self.tree is None and self.column else [*self._walk(self.tree)]

    def evaluate(self, read: Callable[[str, int | None], Floats]) -> Floats:
        """Return the values, shape (N,) or () of a constant; ``read`` returns those of a column."""
        if self.column is not None:
            ((name, index),) = self.operands()
            return read(name, index)
        with np.errstate(all="ignore"):  # what is not finite is counted where the values are used
            return self._evaluate(self.tree, read)

    def _walk(self, node: ast.expr | None) -> Iterator[tuple[str, int | None]]:
        match node:
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
                yield from self._walk(left)
                yield from self._walk(right)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                yield from self._walk(operand)
            case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
                return
            case ast.Subscript(value=value, slice=ast.Constant(value=int(index))):
                yield self._name(value), index
            case _:
                yield self._name(node), None

    def _name(self, node: ast.expr | None) -> str:
        match node:
            case ast.Name(id=name):
                number = name.removeprefix(_MARK)
                return name if number == name else self.quoted[int(number)]
            case ast.Attribute(value=value, attr=attribute):
                return f"{self._name(value)}.{attribute}"
        raise ExpressionError

    def _evaluate(self, node: ast.expr | None, read: Callable[[str, int | None], Floats]) -> Floats:
        match node:
            case ast.BinOp(left=left, op=op, right=right):
                joined: Floats = _OPERATORS[type(op)](self._evaluate(left, read), self._evaluate(right, read))
                return joined
            case ast.UnaryOp(operand=operand):
                return -self._evaluate(operand, read)
            case ast.Constant(value=int() | float() as value):
                return np.asarray(value, np.float64)
        ((name, index),) = self._walk(node)
        return read(name, index)


_MARK = "quoted_column_"


def parse_expression(text: str, known: Collection[str] = ()) -> Expression:
    """Return the expression of a text; one that is a ``known`` column's name is that column. `ExpressionError`: it is none."""
    if text in known:
        return Expression(None, column=text)
    quoted: list[str] = []

    def mark(found: re.Match[str]) -> str:
        quoted.append(found[1])
        return f"{_MARK}{len(quoted) - 1}"

    try:
        tree = ast.parse(_QUOTED.sub(mark, text.strip()[: _LONGEST + 1]), mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        raise ExpressionError from None
    if len(text) > _LONGEST:
        raise ExpressionError
    made = Expression(tree, tuple(quoted))
    operands = made.operands()
    is_column = len(operands) == 1 and isinstance(tree, ast.Name | ast.Attribute | ast.Subscript)
    return Expression(tree, tuple(quoted), operands[0][0]) if is_column else made


_ALIASES = {
    "deg": ("degree", "degrees", "°", "dd"),
    "rad": ("radian", "radians"),
    "m": ("meter", "meters", "metre", "metres"),
    "cm": (),
    "mm": (),
    "km": (),
    "ft": ("feet",),
    "m/s": ("mps", "ms-1", "m_s"),
    "cm/s": ("cmps", "cm_s"),
    "mm/s": ("mmps", "mm_s"),
    "km/h": ("kmh", "kph", "kmph", "km_h"),
    "mph": (),
    "kn": ("kt", "kts", "knot", "knots"),
    "rad/s": ("radps", "rads", "rad_s"),
    "deg/s": ("degps", "degs", "dps", "deg_s", "°/s"),
    "rpm": (),
    "m/s2": ("m/s^2", "m/s²", "m/s/s", "mps2", "m_s2"),
    "g": (),
    "mg": (),
    "V": ("volt", "volts"),
    "mV": ("millivolt", "millivolts"),
    "A": ("amp", "amps", "ampere", "amperes"),
    "mA": ("milliamp", "milliamps"),
    "W": ("watt", "watts"),
    "mW": (),
    "kW": (),
    "J": ("joule", "joules"),
    "kJ": (),
    "Wh": (),
    "mWh": (),
    "kWh": (),
    "s": ("sec", "secs", "second", "seconds"),
    "ms": ("msec", "millis", "milliseconds"),
    "us": ("µs", "μs", "usec", "micros", "microseconds"),
    "ns": ("nsec", "nanos", "nanoseconds"),
}
"""Units, and what else they are called in the name of a column, in lower case."""
_UNIT_OF = {alias.lower(): unit for unit, aliases in _ALIASES.items() for alias in (unit, *aliases)}
_BRACKETED = re.compile(r".+[(\[]\s*+([^()\[\]]*?)\s*+[)\]]\s*+")
_SUFFIX = re.compile(r".*?[^_ .\-][_ .\-]++(" + "|".join(sorted(map(re.escape, _UNIT_OF), key=len, reverse=True)) + ")")


def find_named_unit(name: str) -> tuple[str | None, bool]:
    """Return the unit that a column's name ends with, and whether it stands in brackets, where nothing else is meant.

    ``lat (deg)``, ``Power [w]`` and ``speed_kmh`` state one. In brackets it is what stands there where that is no unit that is known.
    """
    if found := _BRACKETED.fullmatch(name):
        return _UNIT_OF.get(found[1].lower(), found[1] or None), True
    found = _SUFFIX.fullmatch(name.lower())
    return (_UNIT_OF[found[1]], False) if found else (None, False)


def strip_unit(name: str) -> str:
    """Return a column's name in lower case without the unit that it ends with."""
    name = name.lower()
    if found := _BRACKETED.fullmatch(name):
        return re.sub(r"\s*+[(\[][^()\[\]]*[)\]]\s*+$", "", name)
    found = _SUFFIX.fullmatch(name)
    return name[: found.start(1)].rstrip("_ .-") if found else name
