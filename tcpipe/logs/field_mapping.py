"""Mapping of columns and of fields of custom message types to the fields of the message that a role usually has.

One mapping serves tables (`[tables.<role>]`) and custom messages (`[read.fields]`): the fields by their short names,
each in its unit. Names of columns and fields propose the mapping.
"""

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice

import numpy as np

from tcpipe.arrays import AnyArray, Columns, Floats, Ints
from tcpipe.logs import roles
from tcpipe.logs.expressions import (
    FORM,
    UNITS,
    Expression,
    ExpressionError,
    parse_expression,
    simplify_name,
    split_unit,
)
from tcpipe.logs.fix_quality import CODES, CODES_OF_NAMES, classify_fixes, find_status, split_codes
from tcpipe.logs.power_fields import match_sided_velocities
from tcpipe.logs.topics import Topic
from tcpipe.logs.wire_types import BASE_TYPES, FieldTypes, MsgTextError, parse_msg
from tcpipe.power.sources import BATTERY_STATE, FLOAT_TYPES, find_quantity


@dataclass(frozen=True, slots=True)
class MappedField:
    """A field of a role's usual message: its dotted name and unit; ``std_of`` is its row of a covariance if it is σ."""

    message: str
    unit: str
    needed: bool = False
    std_of: int | None = None


def _map_vector(name: str, message: str, unit: str, *, needed: str = "") -> dict[str, MappedField]:
    return {f"{name}_{axis}": MappedField(f"{message}.{axis}", unit, axis in needed) for axis in "xyz"}


def _map_std(message: str, names: Sequence[str], size: int, unit: str = "m") -> dict[str, MappedField]:
    """Return the standard deviations of a vector, the first three of the diagonal of a covariance matrix."""
    return {f"{name}_std": MappedField(message, unit, std_of=row * (size + 1)) for row, name in enumerate(names)}


def _map_orientation(message: str) -> dict[str, MappedField]:
    return {f"orientation_{c}": MappedField(f"{message}.{c}", "1") for c in "xyzw"}


def _map_pose(*, needed: str = "") -> dict[str, MappedField]:
    place = {axis: MappedField(f"pose.pose.position.{axis}", "m", axis in needed) for axis in "xyz"}
    return place | _map_orientation("pose.pose.orientation")


_ODOMETRY = {
    **_map_vector("linear", "twist.twist.linear", "m/s", needed="x"),
    **_map_vector("angular", "twist.twist.angular", "rad/s"),
    **_map_pose(),
}

MAPPED: dict[str, dict[str, MappedField]] = {
    "gnss": {
        "latitude": MappedField("latitude", "deg", needed=True),
        "longitude": MappedField("longitude", "deg", needed=True),
        "altitude": MappedField("altitude", "m"),
        **_map_std("position_covariance", ("east", "north", "up"), 3),
        "status": MappedField("status.status", "1"),
        "quality": MappedField("fix_quality", "1"),
    },
    "gnss_velocity": {
        **{
            name: MappedField(f"twist.twist.linear.{axis}", "m/s", needed=axis != "z")
            for name, axis in zip(("east", "north", "up"), "xyz", strict=True)
        },
        **_map_std("twist.covariance", ("east", "north", "up"), 6, "m/s"),
    },
    "imu": {
        **_map_vector("angular_velocity", "angular_velocity", "rad/s", needed="xyz"),
        **_map_vector("linear_acceleration", "linear_acceleration", "m/s2", needed="xyz"),
        **_map_orientation("orientation"),
    },
    "wheel_odometry": _ODOMETRY,
    "visual_odometry": _ODOMETRY,
    "power": {
        "voltage": MappedField("voltage", "V"),
        "current": MappedField("current", "A"),
        "power": MappedField("power", "W"),
        "energy": MappedField("energy", "J"),
    },
    "command": {
        **_map_vector("linear", "twist.linear", "m/s", needed="x"),
        **_map_vector("angular", "twist.angular", "rad/s"),
    },
    "pose": {**_map_pose(needed="xy"), **_map_std("pose.covariance", ("x", "y", "z"), 6)},
}
"""Fields that can be mapped, by role and short name."""

MAPPED_TYPES = {
    "gnss": roles.NAV_SAT_FIX,
    "gnss_velocity": roles.TWIST_WITH_COVARIANCE_STAMPED,
    "imu": roles.IMU,
    "wheel_odometry": roles.ODOMETRY,
    "visual_odometry": roles.ODOMETRY,
    "power": BATTERY_STATE,
    "command": roles.TWIST_STAMPED,
    "pose": roles.POSE_WITH_COVARIANCE_STAMPED,
}
"""The message as which a role's fields are read."""

STAMP_UNITS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}
"""Nanoseconds of one unit of stamps [ns]."""
YEARS_S = (3e8, 1e10)
"""Seconds since 1970 from 1979 to 2286: they identify the unit of a stamp."""
_LEAPS = ((1_341_100_800, 16), (1_435_708_800, 17), (1_483_228_800, 18))
"""From when [s since 1970] GPS time is how far ahead of UTC [s] (IERS Bulletin C)."""


def find_mapping_problems(
    where: str, role: str | None, columns: Mapping[str, str], units: Mapping[str, str]
) -> Iterator[str]:
    """Yield the problems of a mapping that do not depend on its role."""
    if role not in MAPPED:
        yield f"{where}: role is {role!r}; expected one of {', '.join(MAPPED)}"
        return
    known = MAPPED[role]
    if unknown := [name for name in columns if name not in known]:
        yield f"{where}.columns: {role} has no {', '.join(unknown)}; it has {', '.join(known)}"
    if missing := [name for name, field in known.items() if field.needed and name not in columns]:
        yield f"{where}.columns: {role} needs {', '.join(missing)}"
    if role == "power" and len({"current", "power", "energy"} & set(columns)) != 1 and set(columns) != {"voltage"}:
        yield f"{where}.columns: power needs one of current, power and energy, or a voltage, or one with a voltage"
    for name, unit in units.items():
        if name not in columns:
            yield f"{where}.units: {name} is not in columns"
        elif name in known and unit not in UNITS[known[name].unit]:
            yield f"{where}.units: {name} is in {unit!r}; expected one of {', '.join(UNITS[known[name].unit])}"


@dataclass(frozen=True, slots=True)
class FieldSource:
    """Source of a field: an expression, times a factor to its unit; of a fix quality the kind of its codes."""

    expression: Expression
    factor: float
    codes: str | None

    def evaluate(self, read: Callable[[str, int | None], AnyArray], rows: int) -> Floats:
        """Return the values, shape (rows,); ``read`` as in `Expression.evaluate`."""
        values = np.broadcast_to(self.expression.evaluate(read), rows)
        return self.factor * values if self.codes is None else classify_fixes(values, self.codes)


def read_fields(
    where: str, role: str, columns: Mapping[str, str], units: Mapping[str, str] | None, known: Collection[str]
) -> dict[str, FieldSource] | list[str]:
    """Return the source of each field by the recipe, or all problems.

    ``known`` are the existing columns. The unit of a column alone is what its name ends with, where ``units``
    states none; that of an expression has to be stated where its columns have another one than the field. Where a
    recipe cannot state units (None), an expression converts.
    """
    found: dict[str, FieldSource] = {}
    problems: list[str] = []
    for name, text in columns.items():
        place, codes = f"{where}.{name}", None
        if name == "quality":
            codes, text = split_codes(text)  # noqa: PLW2901
            if codes is None:
                problems.append(
                    f'{place}: state what the codes of {text} are, one of {", ".join(CODES)}: "gga: {text}"'
                )
                continue
        try:
            expression = parse_expression(text, known)
        except ExpressionError:
            held = ", ".join(known)
            problems.append(f'{place} is "{text}", and there is no such column; expected {FORM}; there are {held}')
            continue
        if lacking := dict.fromkeys(column for column, _ in expression.operands() if column not in known):
            problems.append(f"{place}: there is no column {', '.join(lacking)}; there are {', '.join(known)}")
        elif name == "voltage" and not expression.operands():
            problems.append(f"{place} is the constant {text}; state nominal_voltage_volt, which has an uncertainty")
        else:
            factor = _choose_factor(MAPPED[role][name].unit, expression, name, units)
            if isinstance(factor, str):
                problems.append(f"{place}: {factor}")
            else:
                found[name] = FieldSource(expression, factor, codes)
    return problems or found


def find_other_unit(expression: Expression, unit: str) -> str | None:
    """Return the unit in an expression's column names if it differs from the field's but has its quantity, or None."""
    others = UNITS[unit] | (UNITS["m/s"] if unit == "rad/s" else {})
    named = [split_unit(column)[1] for column, _ in expression.operands()]
    return next((stated for stated in named if stated and others.get(stated, 1.0) != 1.0), None)


def _choose_factor(unit: str, expression: Expression, name: str, units: Mapping[str, str] | None) -> float | str:
    """Return the factor from a column's unit to a field's, or the reason why it is unclear."""
    column, stated = expression.column, units.get(name) if units else None
    if units is not None and stated is None and column is None and (other := find_other_unit(expression, unit)):
        return f"its columns are in {other}; state the unit of the expression under units: {', '.join(UNITS[unit])}"
    _, named, in_brackets = split_unit("" if stated or column is None else column)
    if unit == "1" or (stated or named) is None:
        return 1.0
    factor = UNITS[unit].get(stated or named or "")
    if factor is None and (in_brackets or len(named or "") > _CLEARLY_A_UNIT):
        advice = (
            f"state its unit under units: {', '.join(UNITS[unit])}"
            if units is not None
            else f"convert it, as {column} * 0.001"
        )
        return f"the column is called {column}, and {unit} are expected; {advice}"
    return 1.0 if factor is None else factor


_CLEARLY_A_UNIT = 2  # shortest unit at the end of a name [characters]: shorter ones may have another meaning


def make_message_fields(role: str, values: Mapping[str, Floats], rows: int) -> dict[str, AnyArray]:
    """Return the fields of the message that a role usually has, by dotted name, from those that are mapped.

    Fields that are not mapped have the message's value for unknown: no orientation, no covariance, no altitude (NaN), a
    fix, zero elsewhere. ``values`` are by short name, in the units of `MAPPED`, shape (rows,).
    """
    zero = np.zeros(rows)
    made: dict[str, AnyArray] = {}
    for name, field in MAPPED[role].items():
        if field.std_of is not None:
            if name in values:
                made.setdefault(field.message, np.zeros((rows, 9 if role == "gnss" else 36)))
                made[field.message][:, field.std_of] = values[name] ** 2
        elif name == "quality":
            made |= {"fix_quality": values[name], "status.status": find_status(values[name])} if name in values else {}
        elif name in values:
            made[field.message] = values[name]
        elif (role, name) in {("gnss", "altitude"), ("gnss_velocity", "up")}:
            made[field.message] = np.full(rows, np.nan)
        elif name.startswith("orientation_"):
            made[field.message] = zero if name[-1] != "w" else np.ones(rows)
        elif role != "power":
            made[field.message] = zero
    return made | _collect_other_fields(role, values, made, rows)


def _collect_other_fields(role: str, values: Mapping[str, Floats], made: Columns, rows: int) -> dict[str, AnyArray]:
    """Return the fields of a role's message that no mapping names."""
    if role == "gnss":
        status = made["status.status"]
        return {
            "status.status": np.where(np.isfinite(status), status, -1).astype(np.int8),
            "position_covariance_type": np.full(rows, 2 if "position_covariance" in made else 0, np.uint8),
        }
    if role == "gnss_velocity":
        return {f"twist.twist.angular.{axis}": np.zeros(rows) for axis in "xyz"}
    unoriented = role == "imu" and "orientation_w" not in values
    return {"orientation_covariance": np.full((rows, 9), -1.0)} if unoriented else {}


def find_topic(name: str, role: str, columns: Collection[str], power_type: str | None) -> tuple[str, str]:
    """Return topic and message type of a table; a voltage or a current alone is a bare number, known by its name.

    ``power_type`` is that of a source that the recipe makes of the table.
    """
    if power_type is not None:
        return f"/{name}", power_type
    if role != "power" or len(columns) != 1:
        return f"/{name}", MAPPED_TYPES[role]
    (alone,) = columns
    return f"/{name}" if find_quantity(name) == alone else f"/{name}/{alone}", FLOAT_TYPES[1]


def parse_stamps_ns(values: AnyArray, unit: str) -> Ints | str:
    """Return finite numbers, shape (N,), as [ns], or why they are no stamps.

    ``unit`` is s, ms, us or ns; auto infers it from their size, since 1979.
    """
    if unit == "auto":
        middle = float(np.median(values)) if values.size else 0.0
        fitting = [name for name, ns in STAMP_UNITS.items() if YEARS_S[0] < middle * ns / 1e9 < YEARS_S[1]]
        if not fitting:
            return f"its stamps ({middle:.12g}) do not count from 1970; set their unit, one of {', '.join(STAMP_UNITS)}"
        unit = fitting[0]
    factor = STAMP_UNITS[unit]
    if np.issubdtype(values.dtype, np.integer):
        return np.asarray(values, np.int64) * factor
    whole: Floats = np.floor(values)
    return whole.astype(np.int64) * factor + np.round((values - whole) * factor).astype(np.int64)


def utc_from_gps_ns(stamp_ns: Ints) -> Ints:
    """Return GPS time written as a date [ns since 1970] as UTC [ns]; from July 2012 on."""
    since = np.array([(start + leap) * 1_000_000_000 for start, leap in _LEAPS])
    leap_s = np.array([leap for _, leap in _LEAPS], np.int64)[np.searchsorted(since, stamp_ns, side="right") - 1]
    return stamp_ns - leap_s * 1_000_000_000


def make_mapped_message(role: str, columns: Columns, fields: Mapping[str, str]) -> dict[str, AnyArray] | list[str]:
    """Return a custom message's columns as those of the role's usual message, or the problems of the mapping.

    ``fields`` are the sources by short name: ``pvt.lat``, ``accel[0]``, ``lat * 1e-7``.
    """
    where = f"recipe read.fields.{role}"
    problems = list(find_mapping_problems(where, role, fields, {}))
    known = [field for field in columns if not field.endswith("time_ns")]
    mapped = {name: text for name, text in fields.items() if name in MAPPED[role]}
    found = read_fields(where, role, mapped, None, known)
    if isinstance(found, list):
        return problems + found
    rows = len(columns["log_time_ns"])
    values: dict[str, Floats] = {}
    for name, of_field in found.items():
        parts = of_field.expression.operands()
        unfit = [why for part in parts if (why := _find_misfit(columns[part[0]], *part, may_be_text=name == "quality"))]
        problems += [f"{where}.{name}: {why}" for why in unfit]
        if not unfit:
            values[name] = of_field.evaluate(partial(_read_column, columns), rows)
    if problems:
        return problems
    stamps = {
        name: columns.get(name, np.zeros(rows, np.int64)) for name in ("header.stamp.sec", "header.stamp.nanosec")
    }
    own = {name: columns[name] for name in ("log_time_ns", "header.frame_id", "child_frame_id") if name in columns}
    return own | stamps | make_message_fields(role, values, rows)


def _find_misfit(values: AnyArray, name: str, index: int | None, *, may_be_text: bool) -> str | None:
    """Return why a field of a message is no number a message."""
    if not may_be_text and not np.issubdtype(values.dtype, np.number):
        return f"{name} is text; expected numbers"
    if values.ndim == 2 and (index is None or index >= values.shape[1]):
        return f"{name} is a list of {values.shape[1]} elements; expected one of them, as {name}[0]"
    return f"{name} is no list" if values.ndim == 1 and index is not None else None


def _read_column(columns: Columns, name: str, index: int | None) -> Floats:
    values = columns[name] if index is None else columns[name][:, index]
    return values.astype(float) if np.issubdtype(values.dtype, np.number) else values


def _match_axes(before: str, name: str) -> dict[str, str]:
    return {f"{name}_{axis}": rf"(.*[_.])?({before})[_.]?{axis}" for axis in "xyz"}


_HORIZONTAL_STD = r"(.*[_.])?h(or(izontal)?)?_?acc(uracy)?"
_MOVER = r"wheels?|odom(etry)?|motors?|encoders?|esc|robot|vehicle|forward"
_VELOCITY = {
    "linear_x": r"(?!.*(ang|gyr|omega|rot|acc))(.*[_.])?(t?l(in(ear)?)?|v(el(ocity)?)?)[_.]?x|"
    rf"(({_MOVER})_)?(speed|velocity|vel|v)(_({_MOVER}))?"
}
_TURN = {"angular_z": r"(.*[_.])?(t?a(ng(ular)?)?|w|omega)[_.]?z|yaw_?rate|omega"}
CALLED: Mapping[str, Mapping[str, str]] = {
    "gnss": {
        "latitude": r"(.*[_.])?lat(itude)?",
        "longitude": r"(.*[_.])?(lon(gitude)?|lng|long)",
        "altitude": r"(.*[_.])?(alt(itude)?|height|h)(_?(msl|hae|ellipsoid(al)?))?",
        "east_std": rf"sde|{_HORIZONTAL_STD}",
        "north_std": rf"sdn|{_HORIZONTAL_STD}",
        "up_std": r"sdu|(.*[_.])?v(er(tical)?)?_?acc(uracy)?",
        "quality": "|".join(CODES_OF_NAMES.values()),
    },
    "imu": {
        **_match_axes("w|g|gyro?|ang(ular)?_?vel(ocity)?|angular_velocity|omega", "angular_velocity"),
        **_match_axes("a|acc(el)?|lin(ear)?_?acc(el(eration)?)?", "linear_acceleration"),
    },
    "command": {**_VELOCITY, **_TURN},
    "wheel_odometry": {**_VELOCITY, **_TURN},
    "pose": {
        "x": r"[tp]?x|pos(ition)?[_.]?x|east(ing)?",
        "y": r"[tp]?y|pos(ition)?[_.]?y|north(ing)?",
        "z": r"[tp]?z|pos(ition)?[_.]?z|up|height",
    },
}
"""Patterns of names of each field, in lower case without a unit; the likelier role first."""

_DEEPEST = 4
_LONGEST_BYTES, _MOST_NAMES = 1 << 16, 1000
"""No receiver's message is longer or has more numbers; one that is made to hurt does not cost minutes."""


def match_field_names(role: str, names: Sequence[str]) -> dict[str, str]:
    """Return the name of each field of a role; {} if one is missing that the role needs."""
    found = match_known_fields(role, names)
    return found if all(field in found for field, definition in MAPPED[role].items() if definition.needed) else {}


def match_known_fields(role: str, names: Sequence[str]) -> dict[str, str]:
    """Return the name of each field of a role that has one."""
    found: dict[str, str] = {}
    for field, pattern in CALLED.get(role, {}).items():
        match = next((name for name in names if re.fullmatch(pattern, simplify_name(name))), None)
        if match is not None and (match not in found.values() or field == "north_std"):
            found[field] = match
    return found


_COMMAND = re.compile(r"cmd|command|joy|setpoint|target")
_OF_GNSS = re.compile(r"gps|gnss|gvel|sog|over_?ground")


def match_table_roles(file: str, names: Sequence[str]) -> dict[str, tuple[dict[str, str], str]]:
    """Return by role the column or expression of each field in a table, and the points that its names leave open.

    A speed or a position beside fixes was probably computed from them, unless another column is the receiver's speed.
    """
    is_command = _COMMAND.search(file.lower())
    commands = [name for name in names if is_command or _COMMAND.search(name.lower())]
    measured = [name for name in names if name not in commands]
    found = {"gnss": match_field_names("gnss", measured), "imu": match_field_names("imu", measured)}
    taken = {name for fields in found.values() for name in fields.values()}
    rest = [name for name in measured if name not in taken]
    own = [name for name in rest if not _OF_GNSS.search(simplify_name(name))]
    speed = match_field_names("wheel_odometry", own)
    sided = match_sided_velocities(own)
    found |= {"command": match_field_names("command", commands), "wheel_odometry": sided or speed}
    found["pose"] = {} if found["gnss"] or speed or sided else match_field_names("pose", rest)
    has_other = any(_OF_GNSS.search(simplify_name(name)) and re.search("vel|speed|sog", name.lower()) for name in rest)
    is_wheels = re.search(_MOVER, simplify_name(speed.get("linear_x", ""))) is not None
    doubt = "" if sided or is_wheels or has_other or not found["gnss"] else _COMPUTED_SPEED
    return {role: (fields, doubt if role == "wheel_odometry" else "") for role, fields in found.items() if fields}


_COMPUTED_SPEED = "if wheels measure it: the speed of a receiver is no second sensor"


def list_number_fields(topic: Topic) -> list[str]:
    """Return the dotted names of a message's first numbers, ``[]`` behind a list; none without a definition."""
    if len(topic.definition) > _LONGEST_BYTES:
        return []
    try:
        return list(islice(_iterate_below(parse_msg(topic.definition, topic.type_name), topic.type_name), _MOST_NAMES))
    except MsgTextError:
        return []


def _iterate_below(messages: Mapping[str, FieldTypes], type_name: str, prefix: str = "") -> Iterator[str]:
    for name, field_type in messages.get(type_name, ()):
        dotted = f"{prefix}{name}{'' if field_type.length is None else '[]'}"
        if dotted.count("[]") > 1:
            continue
        if field_type.name in BASE_TYPES - {"string", "wstring"}:
            yield dotted
        elif dotted.count(".") < _DEEPEST:
            yield from _iterate_below(messages, field_type.name, f"{dotted}.")
