import numpy as np
import pytest

from tcpipe.balance.cells import SLOPE_EDGES_DEG, SLOPE_NAMES, choose_speed_edges, count_cells, find_slope_ranges
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
        cells = count_cells(keys, split, xy, labels, splits=SPLITS)
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
    cells = count_cells(
        (np.repeat([1, 2], [29, 30]), np.zeros(59, int)), np.full(59, "test"), np.zeros((59, 2)), (), splits=SPLITS
    )
    assert [(cell.effective, cell.is_undersampled) for cell in cells] == [(None, True), (None, False)]
    assert count_cells((np.zeros(3, int),) * 2, np.full(3, "buffer"), np.zeros((3, 2)), (), splits=SPLITS) == []
