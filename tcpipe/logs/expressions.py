"""Expressions of columns in a recipe, as ``(velL + velR) / 2`` or ``pvt.lat * 1e-7``, and units in column names."""

import ast
import re
import unicodedata
from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from tcpipe.arrays import Floats

_WORDS = """
latitude: breite breitengrad latitud
longitude: lange laenge langengrad laengengrad longitud
altitude: hohe hoehe altitud hauteur
speed: geschwindigkeit vitesse velocidad fahrgeschwindigkeit
voltage: spannung tension voltaje batteriespannung
current: strom courant corriente batteriestrom
power: leistung puissance potencia
energy: energie energia
accel: beschleunigung aceleracion
gyro: drehrate kreisel gyroskop gyroscope giroscopio giro winkelgeschwindigkeit drehgeschwindigkeit
battery: akku batterie bateria
battery_voltage: ubat ubatt uakku
battery_current: ibat ibatt iakku
left: links gauche izquierda izq
right: rechts droite derecha der
wheel: roue rueda
motor: moteur
time: zeit uhrzeit zeitstempel temps heure horodatage tiempo hora
date: datum fecha
"""
"""English word, then the same in German, French and Spanish, without accents."""
_ENGLISH = {word: english for english, _, words in (line.partition(": ") for line in _WORDS.strip().splitlines())
            for word in words.split()}  # fmt: skip
_FOREIGN = re.compile(rf"(?<![^\W_])(?:{'|'.join(sorted(_ENGLISH, key=len, reverse=True))})(?![^\W_])", re.IGNORECASE)


def translate(name: str) -> str:
    """Return a column's name without accents, with the words of the table above in English; other words are kept."""
    signs = unicodedata.normalize("NFKD", name.replace("µ", "u"))
    plain = "".join(sign for sign in signs if not unicodedata.combining(sign))
    return _FOREIGN.sub(lambda found: _ENGLISH[found[0].lower()], plain)


Read = Callable[[str, int | None], Floats]
"""Returns a column's values, those of one element where it is a list."""

FORM = 'a column, or numbers and columns joined by + - * / ( ), as "(velL + velR) / 2"; other names in backquotes, as "`Power (w)` * 2"'
_LONGEST = 300  # longest expression [characters]: it cannot nest deeper than the parser allows
_QUOTED = re.compile(r"`([^`]*)`")
_MARK = "quoted_column_"
_OPERATORS = {ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide}


class ExpressionError(ValueError):
    """The text is no expression of columns."""


@dataclass(frozen=True, slots=True)
class Expression:
    """Columns joined by arithmetic."""

    tree: ast.expr
    quoted: tuple[str, ...]

    @property
    def column(self) -> str | None:
        """Name of the column, if the expression is one column."""
        is_one = isinstance(self.tree, ast.Name | ast.Attribute | ast.Subscript)
        return self.operands()[0][0] if is_one else None

    def operands(self) -> list[tuple[str, int | None]]:
        """Return the columns that it reads, each with the element of its list, None if it is no list."""
        found: list[tuple[str, int | None]] = []

        def record(name: str, index: int | None) -> Floats:
            found.append((name, index))
            return np.ones(())

        self.evaluate(record)
        return found

    def evaluate(self, read: Read) -> Floats:
        """Return the values, shape (N,), or () of a constant."""
        with np.errstate(all="ignore"):  # users of the values count those that are not finite
            return self._evaluate(self.tree, read)

    def _evaluate(self, node: ast.expr, read: Read) -> Floats:
        match node:
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
                return np.asarray(_OPERATORS[type(op)](self._evaluate(left, read), self._evaluate(right, read)))
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return -self._evaluate(operand, read)
            case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
                return np.asarray(value, float)
            case ast.Subscript(value=value, slice=ast.Constant(value=int(index))):
                return read(self._join_name(value), index)
        return read(self._join_name(node), None)

    def _join_name(self, node: ast.expr) -> str:
        match node:
            case ast.Name(id=name):
                return self.quoted[int(name.removeprefix(_MARK))] if name.startswith(_MARK) else name
            case ast.Attribute(value=value, attr=attribute):
                return f"{self._join_name(value)}.{attribute}"
        raise ExpressionError


def parse_expression(text: str, known: Collection[str] = ()) -> Expression:
    """Return the expression of a text; the name of a ``known`` column is that column. `ExpressionError`: other text."""
    quoted = (text,) if text in known else tuple(_QUOTED.findall(text))
    marks = (f"{_MARK}{number}" for number in range(len(quoted)))
    source = next(marks) if text in known else _QUOTED.sub(lambda _: next(marks), text.strip())
    if len(source) > _LONGEST:
        raise ExpressionError
    try:
        made = Expression(ast.parse(source, mode="eval").body, quoted)
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        raise ExpressionError from None
    made.operands()
    return made


UNITS: dict[str, dict[str, float]] = {
    "deg": {"deg": 1.0, "rad": 180.0 / np.pi, "1e-7 deg": 1e-7},
    "m": {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "ft": 0.3048},
    "m/s": {"m/s": 1.0, "cm/s": 0.01, "mm/s": 0.001, "km/h": 1 / 3.6, "mph": 0.44704, "kn": 1852 / 3600},
    "rad/s": {"rad/s": 1.0, "deg/s": np.pi / 180.0, "rpm": np.pi / 30.0},
    "m/s2": {"m/s2": 1.0, "g": 9.80665, "mg": 0.00980665},
    "V": {"V": 1.0, "mV": 0.001},
    "A": {"A": 1.0, "mA": 0.001},
    "W": {"W": 1.0, "mW": 0.001, "kW": 1000.0},
    "J": {"J": 1.0, "kJ": 1000.0, "mWh": 3.6, "Wh": 3600.0, "kWh": 3.6e6},
    "1": {"1": 1.0},
}
"""Factor from each unit to the unit by which they are grouped."""

_UNIT_NAMES = """
deg degree degrees °; rad radian radians; m meter meters metre metres; cm; mm; km; ft feet;
m/s mps m_s m_per_s meters_per_sec meters_per_second; cm/s cmps; mm/s mmps; km/h kmh kph km_h; mph; kn kt kts knot knots;
rad/s radps rads rad_s; deg/s degps degs dps deg_s °/s grad/s; rpm u/min; m/s2 m/s^2 m/s² m/s/s mps2 ms2; g; mg; V volt volts;
mV millivolt millivolts; A amp amps ampere amperes; mA milliamp milliamps; W watt watts; mW; kW; J joule joules; kJ; Wh; mWh; kWh;
s sec secs second seconds; ms msec milliseconds; us µs μs usec microseconds; ns nsec nanoseconds"""
"""Units, and their other spellings in column names."""
_UNIT_OF = {name.lower(): names[0] for names in map(str.split, _UNIT_NAMES.split(";")) for name in names}
_SUFFIX = re.compile(
    r"(.*?[^_ .\-])[_ .\-]++(" + "|".join(sorted(map(re.escape, _UNIT_OF), key=len, reverse=True)) + ")"
)


def simplify_name(name: str) -> str:
    """Return a column's name in English lower case, without its unit, ``_`` for blanks and hyphens, for recognition."""
    return re.sub(r"[\s-]+", "_", translate(split_unit(name)[0]).strip().lower())


def split_unit(name: str) -> tuple[str, str | None, bool]:
    """Return a column's name without the unit at its end, that unit, and whether it is in brackets.

    ``lat (deg)``, ``Power [w]`` and ``speed_kmh`` state one. A text in brackets that is no known unit is returned as it
    is.
    """
    opening = max(name.rfind("("), name.rfind("["))
    if opening > 0 and name.rstrip().endswith((")", "]")):
        inside = name.rstrip()[opening + 1 : -1].strip()
        return name[:opening].rstrip(), _UNIT_OF.get(inside.lower(), inside or None), True
    found = _SUFFIX.fullmatch(name.lower())
    return (name[: found.end(1)], _UNIT_OF[found[2]], False) if found else (name, None, False)
