import numpy as np
import pytest
import shapely

from tcpipe.balance.cells import (
    CLOSED,
    SLOPE_EDGES_DEG,
    SLOPE_NAMES,
    MapGround,
    cells_available,
    choose_speed_edges,
    count_cells,
    find_cell_classes,
    find_slope_ranges,
    find_undersampled_ground,
    fit_cell_gradients,
)
from tcpipe.balance.correlation import Correlation, compute_effective_size

SPLITS = ("train", "test", "unseen")


def test_ranges_of_slope_are_named_after_their_ends():
    assert len(SLOPE_NAMES) == len(SLOPE_EDGES_DEG) + 1
    degrees = np.array([-30.0, -15.0, -12.0, -4.9, 0.0, 1.99, 2.0, 14.9, 15.0, 40.0])
    assert [SLOPE_NAMES[number] for number in find_slope_ranges(np.radians(degrees))] == [
        *("below -15°", "-15° to -10°", "-15° to -10°", "-5° to -2°", "-2° to 2°"),
        *("-2° to 2°", "2° to 5°", "10° to 15°", "above 15°", "above 15°"),
    ]


@pytest.mark.parametrize(
    ("fastest", "edges"),
    [(1.0, (0.2, 0.4, 0.6, 0.8)), (0.9, (0.2, 0.4, 0.6, 0.8)), (4.9, (1, 2, 3, 4)), (0.3, (0.1, 0.2))],
)
def test_borders_of_speed_are_round_and_few(fastest, edges):
    found = choose_speed_edges(np.linspace(0.0, fastest / 0.99, 1000))
    assert found == pytest.approx(edges)


def test_no_speed_has_no_borders():
    assert choose_speed_edges(np.empty(0)) == ()
    assert choose_speed_edges(np.zeros(5)) == ()


def test_cells_count_every_sample_once_and_are_worth_what_the_least_label_says():
    rng = np.random.default_rng(0)
    n = 500
    kind, slope, speed = rng.integers(4, 7, n), rng.integers(0, 9, n), rng.integers(0, 3, n)
    split, xy = rng.choice([*SPLITS, "buffer"], n), rng.uniform(0, 30, (n, 2))
    labels = (Correlation(1.0, 0.5, 9), Correlation(4.0, 0.9, 9))
    for keys in ((kind, slope), (kind, slope, speed)):
        cells = count_cells(keys, {name: split == name for name in SPLITS}, xy, labels)
        assert sum(sum(cell.samples.values()) for cell in cells) == (split != "buffer").sum()
        for cell in cells:
            rows = (kind == cell.terrain_class) & (slope == cell.slope) & (split != "buffer")
            rows &= (speed == cell.speed) if cell.speed is not None else True
            assert cell.samples == {name: int((rows & (split == name)).sum()) for name in SPLITS}
            assert cell.effective == pytest.approx(compute_effective_size(xy[rows], labels[1]))
            assert cell.effective_train == pytest.approx(
                compute_effective_size(xy[rows & (split == "train")], labels[1])
            )
            assert cell.effective <= rows.sum() + 1e-9
            assert cell.is_undersampled


def test_where_likeness_cannot_be_told_the_number_of_samples_decides():
    splits = {"train": np.zeros(59, bool), "test": np.ones(59, bool)}
    cells = count_cells((np.repeat([1, 2], [29, 30]), np.zeros(59, int)), splits, np.zeros((59, 2)), ())
    assert [(cell.effective, cell.is_undersampled) for cell in cells] == [(None, True), (None, False)]
    assert count_cells((np.zeros(3, int),) * 2, {"train": np.zeros(3, bool)}, np.zeros((3, 2)), ()) == []


UP, DOWN, LEVEL = SLOPE_NAMES.index("5° to 10°"), SLOPE_NAMES.index("-10° to -5°"), SLOPE_NAMES.index("-2° to 2°")


def test_gradients_are_those_of_the_plane_and_nan_where_a_height_is_missing():
    y, x = np.mgrid[0:23, 0:31] * 0.5
    heights = 100.0 + 0.2 * x - 0.1 * -y  # rows run south: y here grows southward
    found = fit_cell_gradients(heights, 5, 0.5)
    assert found.shape == (4, 6, 2)
    np.testing.assert_allclose(found, np.broadcast_to([0.2, -0.1], found.shape), atol=1e-12)
    heights[7, 8] = np.nan
    assert np.argwhere(np.isnan(fit_cell_gradients(heights, 5, 0.5)[..., 0])).tolist() == [[1, 1]]


def test_a_cell_has_a_class_if_all_of_it_may_be_driven_and_most_is_of_one():
    terrain = np.full((4, 8), 5, np.uint8)
    terrain[0, 0] = 7  # still mostly 5
    terrain[0, 2] = 1  # an obstacle
    terrain[:2, 4:6] = [[5, 5], [6, 6]]  # half and half
    terrain[2:, 6:] = 0  # no data
    drivable = np.zeros(256, bool)
    drivable[5:8] = True
    assert find_cell_classes(terrain, 2, drivable).tolist() == [[5, CLOSED, CLOSED, 5], [5, 5, 5, CLOSED]]


def slope_of(rows, cols, rise=0.12):
    """MapGround of class 4 that rises to the east, by 7° if nothing is said; 4 m cells."""
    gradient = np.zeros((rows, cols, 2))
    gradient[..., 0] = rise
    return MapGround(np.full((rows, cols), 4, np.int16), gradient, 1000.0, 2000.0, 4.0)


def test_ground_offers_its_fall_line_up_and_down():
    ground = slope_of(3, 5)
    assert cells_available(ground, 4, UP).all()
    assert cells_available(ground, 4, DOWN).all()
    assert not cells_available(ground, 4, LEVEL).any()
    assert not cells_available(ground, 5, UP).any()


def test_what_was_driven_and_what_is_closed_is_left_out_and_patches_are_connected():
    ground = slope_of(3, 7)
    ground.terrain_class[:, 3] = CLOSED
    driven = np.array([[1002.0, 1998.0], [1027.9, 1988.1], [0.0, 0.0]])  # cells (0, 0) and (2, 6), and off the map
    east, west = find_undersampled_ground(ground, 4, UP, driven)
    assert (east.area_m2, west.area_m2) == (8 * 16.0, 8 * 16.0)
    assert west.polygon.bounds == (1016.0, 1988.0, 1028.0, 2000.0) or east.polygon.bounds == (
        1016.0,
        1988.0,
        1028.0,
        2000.0,
    )
    for patch in (east, west):
        assert patch.polygon.geom_type == "Polygon"
        assert patch.polygon.area == pytest.approx(patch.area_m2)
        assert patch.towards == "E"
        assert not shapely.contains(patch.polygon, shapely.points(driven)).any()
    assert [patch.towards for patch in find_undersampled_ground(ground, 4, DOWN, driven[:0])] == ["W", "W"]
    assert list(find_undersampled_ground(ground, 5, UP, driven)) == []


def test_the_largest_patches_come_first_and_level_ground_has_no_direction():
    ground = slope_of(1, 60, rise=0.0)
    ground.terrain_class[0, [1, 4, 9]] = CLOSED
    found = list(find_undersampled_ground(ground, 4, LEVEL, np.empty((0, 2))))
    assert [patch.area_m2 / 16.0 for patch in found] == [50, 4, 2, 1]
    assert {patch.towards for patch in found} == {None}
