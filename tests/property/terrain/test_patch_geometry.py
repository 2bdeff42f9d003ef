"""Patch geometry for any place, course, scale and size."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tcpipe.terrain.sampling import compute_footprints, make_patch_frames, map_px_from_patch, sample_chord_px
from tcpipe.terrain.target_grid import MapGrid

PLACES = st.tuples(st.floats(-4e5, 4e5), st.floats(-4e5, 4e5))


@given(
    start=PLACES,
    angle=st.floats(-np.pi, np.pi),
    scale=st.floats(0.999, 1.001),
    chord_m=st.floats(0.5, 3.0),
    factor=st.floats(1.0, 2.0),
    patch_px=st.integers(2, 64),
    pixel_size_m=st.floats(0.01, 1.0),
)
def test_pixels_lie_where_the_ruling_says(*, start, angle, scale, chord_m, factor, patch_px, pixel_size_m):
    grid = MapGrid("EPSG:32633", 12.5, 7.25, pixel_size_m, 10, 10)
    patch_m = chord_m * factor
    p0 = np.array([start])
    direction = np.array([(np.cos(angle), np.sin(angle))])
    pn = p0 + scale * chord_m * direction
    frames = make_patch_frames(p0, pn, np.array([chord_m]))

    corners = compute_footprints(frames, patch_m)[0]
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    np.testing.assert_allclose(sides, patch_m * scale, rtol=1e-8)
    area = 0.5 * np.sum(
        (corners - corners[0])[:, 0] * np.roll(corners - corners[0], -1, axis=0)[:, 1]
        - np.roll(corners - corners[0], -1, axis=0)[:, 0] * (corners - corners[0])[:, 1]
    )
    assert area > 0.0  # counter-clockwise
    rear, front = corners[[0, 3]].mean(axis=0), corners[[1, 2]].mean(axis=0)
    overhang = (patch_m - chord_m) / 2.0 * scale * direction[0]
    np.testing.assert_allclose(rear, p0[0] - overhang, atol=1e-8)
    np.testing.assert_allclose(front, pn[0] + overhang, atol=1e-8)

    px = map_px_from_patch(frames, grid, patch_m=patch_m, patch_px=patch_px)[0]
    first = grid.xy_from_px(px[:2])
    last = grid.xy_from_px(px[:2] + (patch_px - 1) * (px[2:4] + px[4:6]))
    rear_left, front_right = corners[3], corners[1]
    inset = (front_right - rear_left) / (2.0 * patch_px)
    np.testing.assert_allclose(first, rear_left + inset, atol=1e-7)
    np.testing.assert_allclose(last, front_right - inset, atol=1e-7)

    line = sample_chord_px(frames, grid, chord_m=np.array([chord_m]), points=7)[0]
    np.testing.assert_allclose(grid.xy_from_px(line[:2] + 3 * line[2:]), (p0[0] + pn[0]) / 2.0, atol=1e-7)
    np.testing.assert_allclose(grid.xy_from_px(line[:2] - 0.5 * line[2:]), p0[0], atol=1e-7)
