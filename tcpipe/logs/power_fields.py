"""Find voltage, current and power of the drive among fields of a message, or columns of a table, by their names."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from tcpipe.logs.expressions import UNITS, split_unit, translate

SIDES = frozenset({"left", "right", "front", "rear", "back", "l", "r", "fl", "fr", "rl", "rr", "bl", "br"})

_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_QUANTITIES = {
    "voltage": re.compile(r"volt(age|s)?|voltages|v(bat|batt|in|bus|pack)"),
    "current": re.compile(r"curr?(ent)?s?|amp(ere)?s?|i(bat|batt|in|bus|pack)"),
    "power": re.compile(r"power|watts?"),
}
_LETTERS = {"u": "voltage", "v": "voltage", "i": "current"}
_UNITS = {
    name: (quantity, factor)
    for quantity, unit in (("voltage", "V"), ("current", "A"), ("power", "W"))
    for name, factor in UNITS[unit].items()
}
_SUPPLY = re.compile(
    r"bat|batt|battery|bms|pack|bus|supply|input|in|main|dc|source|vin|iin|[vi](bat|batt|in|bus|pack)|esc"
)
_DRIVES = re.compile(r"drives?|drivers?|motors?|wheels?|traction")
_OTHER = re.compile(
    r"min|max|limit|set|setpoint|target|cmd|command|commanded|desired|ref|nominal|rated|full|capacity|charge|percent(age)?|soc|temp|temperature|"
    r"cells?|status|fault|error|id|iq|vd|vq|per|pred|true|std|cov|variance|health|design|supply_?status|technology|mode|button|acc|lin|ang|vel"
)
_PHASE = re.compile(r"phase|motors?|q|d|rms")


@dataclass(frozen=True, slots=True)
class PowerFields:
    """Fields read together: those of each rail by quantity, with the factor of the unit in the name, and doubts."""

    rails: tuple[Mapping[str, str], ...]
    scales: Mapping[str, float]
    doubt: str = ""


@dataclass(frozen=True, slots=True)
class _Named:
    name: str
    quantity: str
    scale: float
    core: tuple[str, ...]
    """Words that describe neither quantity nor side."""
    side: tuple[str, ...]


def split_words(name: str) -> list[str]:
    """Return the English words of a name in lower case: at capitals, digits and signs."""
    return [word.lower() for word in _WORDS.findall(translate(name))]


def split_sides(name: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return a name's words without sides and numbers, and those."""
    words = split_words(name)
    of_side = tuple(word for word in words if word in SIDES or word.isdigit())
    return tuple(word for word in words if word not in of_side), of_side


def match_power_fields(names: Iterable[str]) -> PowerFields | None:
    """Return the voltage and current, or the power, among fields; None if neither a current nor a power is.

    Fields whose names differ by sides or numbers alone belong together: each at its own voltage where there are as
    many, else added.
    """
    named = [found for name in names if (found := _read_name(name))]
    watt, amp, volt = ([field for field in named if field.quantity == what] for what in ("power", "current", "voltage"))
    drawn, others = _choose(amp or watt)
    if not drawn:
        return None
    quantity = drawn[0].quantity
    volt, _ = _choose([field for field in volt if field.core == drawn[0].core] or volt)
    by_side = {field.side: field.name for field in volt}
    if quantity == "power":
        rails: list[dict[str, str]] = [{"power": " + ".join(field.name for field in drawn)}]
    elif len(drawn) > 1 and all(field.side in by_side for field in drawn):
        rails = [{"voltage": _take_first_element(by_side[field.side]), "current": field.name} for field in drawn]
    else:
        rails = [{"current": " + ".join(field.name for field in drawn)}]
        rails = [{"voltage": _take_first_element(volt[0].name)} | rails[0]] if volt else rails
    used = [*drawn, *(volt if "voltage" in rails[0] else [])]
    scales = {field.quantity: field.scale for field in used if field.scale != 1.0}
    return PowerFields(tuple(rails), scales, _find_doubt(drawn, others))


def match_sided_velocities(names: Iterable[str]) -> dict[str, str]:
    """Return the forward velocity as the mean of both sides, and the turn rate for a track of 0.5 m; {} without sides.

    Turn rates of wheels are velocities of a wheel with a radius of 0.1 m, and give no turn rate.
    """
    words = {name: {*split_words(name)} for name in names}
    units = {name: "rpm" if "rpm" in words[name] else split_unit(name)[1] for name in words}
    speeds = [
        name
        for name, of_name in words.items()
        if {"vel", "velocity", "speed", "spd", "rpm"} & of_name or units[name] in UNITS["m/s"]
    ]
    sided = [name for name in speeds if {"l", "left", "r", "right", "fl", "fr", "rl", "rr"} & words[name]]
    left = [quote(name) for name in sided if {"l", "left", "fl", "rl"} & words[name]]
    cores = {split_sides(name)[0] for name in sided}
    if not left or 2 * len(left) != len(sided) or len(cores) != 1 or len({units[name] for name in sided}) != 1:
        return {}
    right = [name for name in map(quote, sided) if name not in left]
    unit, mean = units[sided[0]] or "m/s", f"({' + '.join([*left, *right])}) / {len(sided)}"
    if unit in UNITS["rad/s"]:
        factor = f" * {UNITS['rad/s'][unit]:.9g}" if unit != "rad/s" else ""
        return {"linear_x": f"{mean}{factor} * 0.1"}
    to_mps = f" * {UNITS['m/s'][unit]:.9g}" if UNITS["m/s"].get(unit, 1.0) != 1.0 else ""
    return {"linear_x": mean, "angular_z": f"({' + '.join(right)} - {' - '.join(left)}) / {len(left)}{to_mps} / 0.5"}


_PLAIN = re.compile(r"[A-Za-z_]\w*")


def quote(name: str) -> str:
    """Return a column's name as an expression names it: in backquotes unless it is a word."""
    return name if _PLAIN.fullmatch(name) else f"`{name}`"


def _read_name(name: str) -> _Named | None:
    bare, unit, in_brackets = split_unit(name.replace("`", "").removesuffix("[]"))
    (core, side), own = split_sides(bare), split_words(bare.rpartition(".")[2])
    quantity = next(
        (what for word in reversed(own) for what, pattern in _QUANTITIES.items() if pattern.fullmatch(word)), None
    )
    if quantity is None and any(_SUPPLY.fullmatch(word) for word in core):  # v_bat
        quantity = next((_LETTERS[word] for word in own if word in _LETTERS), None)
    measured, scale = _UNITS.get(unit or "", (quantity, 1.0))
    of_rail = any(_SUPPLY.fullmatch(word) or _DRIVES.fullmatch(word) for word in core)
    is_stated = in_brackets and (of_rail or {"u", "v", "i", "p"} & set(own))  # as U_bat [V]
    quantity = quantity or (measured if is_stated or (of_rail and scale != 1.0) else None)  # "wheel_v" is a velocity
    if quantity is None or measured != quantity or any(_OTHER.fullmatch(word) for word in own):
        return None
    rest = tuple(word for word in core if not any(pattern.fullmatch(word) for pattern in _QUANTITIES.values()))
    return _Named(name, quantity, scale, rest, side)


def _choose(named: Sequence[_Named]) -> tuple[list[_Named], list[_Named]]:
    """Return the fields that belong together, those of the supply first, and the others that could be meant as well."""
    groups: dict[tuple[str, ...], list[_Named]] = {}
    for field in named:
        groups.setdefault(field.core, []).append(field)
    ranked = sorted(groups.values(), key=_rank)
    return (ranked or [[]])[0], [field for group in ranked[1:] if _rank(group) == _rank(ranked[0]) for field in group]


def _rank(group: Sequence[_Named]) -> tuple[bool, bool, bool]:
    """Return whether fields' names are not a supply's, are a motor's, and are one of several controllers'.

    VESC Tool's ``setup`` is the sum over all controllers.
    """
    supply, phase = (any(pattern.fullmatch(word) for word in group[0].core) for pattern in (_SUPPLY, _PHASE))
    return not supply, phase, "setup" not in group[0].core


def _take_first_element(name: str) -> str:
    """Return the first element of a list: voltages are not summed."""
    return name.replace("[]", "[0]")


def _find_doubt(chosen: Sequence[_Named], others: Sequence[_Named]) -> str:
    if others:
        return f"{', '.join(other.name for other in others)} could be meant as well"
    if _rank(chosen)[:2] == (True, True):
        return "uncomment if these are drawn from the battery; currents of motor phases are larger"
    return ""
