"""Colours that stand for something differ for every reader: simulated by the matrices of Machado, Oliveira and Fernandes (2009)."""

import colorsys
import itertools

import numpy as np
import pytest

from tcpipe.report.colours import CLASS_COLOURS, DROPPED, KEPT, SEVERITY_COLOURS, SPLIT_COLOURS, choose_class_colours
from tcpipe.terrain.layers import PAPER_CLASSES, TerrainClass

SEEN = {
    "trichromat": np.eye(3),
    "protanope": np.array([[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]),
    "deuteranope": np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]),
    "tritanope": np.array([[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]),
}  # fmt: skip
TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)


def linear(colour):
    part = np.array([int(colour[n : n + 2], 16) for n in (1, 3, 5)]) / 255
    return np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    xyz = TO_XYZ @ np.clip(rgb, 0, 1) / np.array([0.95047, 1.0, 1.08883])
    f = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("eyes", SEEN)
@pytest.mark.parametrize(
    ("colours", "least"),
    [
        (SPLIT_COLOURS.values(), 24.0),
        (CLASS_COLOURS, 13.0),
        ((KEPT, DROPPED), 24.0),
        ((KEPT, *SEVERITY_COLOURS.values()), 13.0),
    ],
    ids=["splits", "classes", "kept", "severities"],
)
def test_colours_differ_for_every_reader(eyes, colours, least):
    seen = [lab(SEEN[eyes] @ linear(colour)) for colour in colours]
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)) > least


def hue_of(colour):
    return colorsys.rgb_to_hsv(*linear(colour))[0] * 360


def test_ground_has_the_colour_of_its_name_of_the_table_or_of_its_number():
    names = ("wet grass", "Mud", "water", "gravel", "asphalt", "unpaved road", "class 7", "dry grass")
    classes = [TerrainClass(number, name, traversable=True) for number, name in enumerate(names, 1)]
    grass, mud, water, gravel, asphalt, track, unnamed, other_grass = choose_class_colours(classes).values()
    assert 80 < hue_of(grass) < 150
    assert 10 < hue_of(mud) < 40
    assert 200 < hue_of(water) < 250
    assert len(set(linear(gravel))) == 1
    assert max(linear(asphalt)) < 0.15 < min(linear(gravel))
    assert track != asphalt
    assert unnamed == CLASS_COLOURS[6]
    assert other_grass not in {grass, mud, water, gravel, asphalt, track}
    given = TerrainClass(1, "grass", traversable=True, color="#123456")
    assert choose_class_colours([given]) == {1: "#123456"}
    assert len(set(choose_class_colours(PAPER_CLASSES.classes).values())) == 7
