"""The fields of a message type of somebody's own, by its definition, and which of a role they are, by their names."""

from tcpipe.logs.field_mapping import list_number_fields, match_field_names
from tcpipe.logs.topics import Topic


def topic(name: str, definition: str) -> Topic:
    return Topic(name, "driver/msg/Own", 9, 0, 10**9, "ros1", definition)


def test_a_definition_that_is_made_to_hurt_is_not_searched() -> None:
    rule = "=" * 80
    deep = "".join(f"L1 f{n}\n" for n in range(60))
    for level in range(1, 5):
        inner = "int8" if level == 4 else f"L{level + 1}"
        deep += f"{rule}\nMSG: driver/L{level}\n" + "".join(f"{inner} f{n}\n" for n in range(60))
    assert len(deep) < 1 << 16
    assert len(list_number_fields(topic("/deep", deep))) == 1000, "of hundreds of millions"
    assert len(list_number_fields(topic("/wide", "int8 a\n" * 9_000))) == 1000
    assert list_number_fields(topic("/long", "int8 a\n" * 10_000)) == []


def test_columns_are_told_with_their_units_left_off() -> None:
    assert match_field_names("gnss", ["time", "lat_deg", "lon (deg)", "h_m"]) == {
        "latitude": "lat_deg",
        "longitude": "lon (deg)",
        "altitude": "h_m",
    }
