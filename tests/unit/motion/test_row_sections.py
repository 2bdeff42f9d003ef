"""Runs, windows and slopes, on rows short enough to count by eye."""

import numpy as np
import pytest
from made_tracks import stamps

from tcpipe.motion.row_sections import (
    compute_window_mean,
    dilate_mask,
    drop_short_runs,
    find_piece_spans,
    find_runs,
    fit_slope,
    make_mask,
    number_pieces,
)


def mask(text):
    return np.array([c == "x" for c in text], dtype=bool)


def text(mask):
    return "".join("x" if m else "." for m in mask)


def test_pieces_end_at_holes_and_at_epochs():
    stamp_ns = stamps(8)
    stamp_ns[3:] += 50_000_000  # one row is missing
    stamp_ns[5:] += 3  # jitter of nanoseconds is no hole
    epoch = np.array([0, 0, 0, 0, 0, 0, 1, 1], dtype=np.int16)
    assert number_pieces(stamp_ns, epoch, period_ns=5e7).tolist() == [0, 0, 0, 1, 1, 1, 2, 2]


def test_a_clock_that_goes_back_opens_a_piece():
    stamp_ns = np.concatenate((stamps(3), stamps(3)))
    assert number_pieces(stamp_ns, np.zeros(6, dtype=np.int16), period_ns=5e7).tolist() == [0, 0, 0, 1, 1, 1]


def test_no_rows_make_no_pieces():
    nothing = number_pieces(stamps(0), np.zeros(0, dtype=np.int16), period_ns=5e7)
    assert len(nothing) == 0
    assert find_piece_spans(nothing).shape == (0, 2)
    assert len(dilate_mask(mask(""), nothing, before=1, after=1)) == 0


def test_runs_stay_inside_pieces():
    piece = np.array([0, 0, 0, 1, 1, 1])
    assert find_runs(mask("xxxx.x"), piece).tolist() == [[0, 2], [3, 3], [5, 5]]


def test_lasting_and_dilated():
    piece = np.array([0] * 6 + [1] * 6)
    assert text(drop_short_runs(mask("xx.xxxxx..x."), piece, min_rows=3)) == "...xxx......"
    assert text(dilate_mask(mask("....x...x..."), piece, before=2, after=1)) == "..xxxxxxxx.."
    assert text(dilate_mask(mask(".....x......"), piece, before=0, after=3)) == ".....x......"


def test_mask_of_overlapping_spans():
    assert text(make_mask(np.array([[0, 2], [1, 1], [4, 5]]), 6)) == "xxx.xx"


def test_window_mean_is_clipped_to_its_piece():
    value, piece = np.array([1.0, 2, 3, 10, 20, 30]), np.array([0, 0, 0, 1, 1, 1])
    before = compute_window_mean(value, piece, before=2, after=-1)
    assert np.isnan(before[[0, 3]]).all()
    assert before[[1, 2, 4, 5]] == pytest.approx([1, 1.5, 10, 15])
    assert compute_window_mean(value, piece, before=1, after=1) == pytest.approx([1.5, 2, 2.5, 15, 20, 25])


def test_slope_is_that_of_polyfit():
    rng = np.random.default_rng(0)
    value = rng.normal(0, 1, 40)
    piece = np.array([0] * 25 + [1] * 14 + [2])
    got = fit_slope(value, piece, half_window=4, period_s=0.05)
    for k in (0, 2, 12, 24, 25, 30, 38):
        inside = [j for j in range(k - 4, k + 5) if 0 <= j < 40 and piece[j] == piece[k]]
        assert got[k] == pytest.approx(np.polyfit(np.array(inside) * 0.05, value[inside], 1)[0], abs=1e-10)
    assert got[39] == 0


def test_a_step_that_is_off_by_half_a_period_is_a_hole_and_any_other_epoch_a_piece():
    stamp_ns = np.array([0, 50, 125, 174, 224]) * 1_000_000
    assert number_pieces(stamp_ns, np.zeros(5, np.int16), period_ns=5e7).tolist() == [0, 0, 1, 1, 1]
    assert number_pieces(stamps(3), np.array([1, 0, 0], np.int16), period_ns=5e7).tolist() == [0, 1, 1]
