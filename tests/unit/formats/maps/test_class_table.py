"""Class tables as CSV and TOML."""

import numpy as np
import pytest

from tcpipe.errors import MapError
from tcpipe.formats.maps.building import read_class_scheme
from tcpipe.terrain.classes import PAPER_CLASSES, PAPER_SCHEME

CSV = "value,id,name,traversable\n11,1,water,no\n40,2,grass,yes\n41,2,grass,true\n"
TOML = """
[[class]]
value = 11
id = 1
name = "water"
traversable = false

[[class]]
value = [40, 41]
id = 2
name = "grass"
traversable = true
"""


def write(tmp_path, text, name="c.csv"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_csv_and_toml_say_the_same(tmp_path):
    csv = read_class_scheme(write(tmp_path, CSV))
    assert read_class_scheme(write(tmp_path, TOML, "c.toml")) == csv
    assert read_class_scheme(write(tmp_path, "\ufeff" + CSV.replace(",", ", "), "bom.csv")) == csv
    assert csv.id_by_value == {11: 1, 40: 2, 41: 2}
    assert [(c.id, c.name, c.traversable) for c in csv.table.classes] == [(1, "water", False), (2, "grass", True)]


def test_every_wrong_line_is_named(tmp_path):
    text = "value,id,name,traversable\nx,1,a,yes\n2,0,b,yes\n3,3,c,maybe\n4,4,,yes\n5,5,e,yes\n5,6,f,yes\n7,5,g,yes\n"
    with pytest.raises(MapError) as caught:
        read_class_scheme(write(tmp_path, text))
    lines = caught.value.problems
    assert [line.split("line ")[1].split(":")[0] for line in lines] == ["2", "3", "4", "5", "7", "8"]
    assert "value 'x' is not an integer" in lines[0]
    assert "from 1 to 255" in lines[1]
    assert "neither true nor false" in lines[2]
    assert "name is missing" in lines[3]
    assert "value 5 stands for id 5 already" in lines[4]
    assert "id 5 was" in lines[5]


@pytest.mark.parametrize(
    ("name", "text", "wanted"),
    [
        ("c.csv", "value;id;name;traversable\n1;1;a;yes\n", "columns value,id,name,traversable are missing"),
        ("c.csv", "value,id,name,traversable\n", "no classes"),
        ("c.csv", "", "missing"),
        ("c.toml", "[[class", "cannot be read"),
        ("c.toml", "a = 1", "no classes"),
        (
            "c.toml",
            "[[class]]\nvalue = 1\nid = 1\nname = 'a'\ntraversable = true\ncolour = 3",
            "'colour' is not a column",
        ),
    ],
)
def test_what_is_no_class_table(tmp_path, name, text, wanted):
    with pytest.raises(MapError, match=wanted):
        read_class_scheme(write(tmp_path, text, name))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(MapError, match=r"c\.csv: the class table cannot be read"):
        read_class_scheme(tmp_path / "c.csv")


def test_the_papers_classes():
    assert PAPER_CLASSES.count == 7
    assert PAPER_CLASSES.traversable().nonzero()[0].tolist() == [4, 5, 6, 7]
    assert PAPER_CLASSES.names()[[0, 4, 5, 6, 7, 8]].tolist() == ["", "grass", "mud", "unpaved road", "paved road", ""]
    values = np.array([[-3, 0, 1, 7], [8, 255, 4, 4]], np.int16)
    valid = np.array([[True, True, True, True], [True, True, True, False]])
    assert PAPER_SCHEME.ids(values, valid).tolist() == [[0, 0, 1, 7], [0, 0, 4, 0]]


def test_toml_that_would_take_for_ever_is_refused(tmp_path):
    for name, text, told in (
        ("dots", "a" + ".a" * 900_000, "dots, at most 1000"),
        ("deep", "a = " + "[" * 100_000, "nested too deep"),
    ):
        path = tmp_path / f"{name}.toml"
        path.write_text(text)
        with pytest.raises(MapError, match=told):
            read_class_scheme(path)
