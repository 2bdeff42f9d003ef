"""Features of patches of analytic ground: what is put in comes out, and nothing changes in a mirror."""

import numpy as np
import pytest

from tcpipe.learning.table_model import patch_features

PX, PATCH_M = 40, 1.0
ALONG, ACROSS = np.meshgrid(*[(np.arange(PX) + 0.5) / PX - 0.5] * 2)


def _of_height(height_m):
    patches = np.asarray(height_m, np.float32)[None, ..., None]
    return patch_features(patches, channels=("height",), class_count=7, patch_m=PATCH_M)[0]


def test_a_paraboloid_has_its_slopes_and_curvatures_and_no_roughness():
    found = _of_height(0.4 + 0.2 * ALONG - 0.1 * ACROSS + 0.15 * ALONG**2 - 0.05 * ACROSS**2)
    assert found[:5] == pytest.approx([np.arctan(0.2), np.arctan(0.1), 0.3, -0.1, 0.0], abs=1e-5)
    assert found[5] == pytest.approx(np.ptp(0.2 * ALONG - 0.1 * ACROSS + 0.15 * ALONG**2 - 0.05 * ACROSS**2), abs=1e-6)


def test_roughness_is_the_deviation_from_the_paraboloid():
    rough = 0.01 * np.where(
        (np.indices((PX, PX)).sum(axis=0)) % 2, 1.0, -1.0
    )  # a chessboard, which no paraboloid resembles
    assert _of_height(0.5 + rough)[4] == pytest.approx(0.01, rel=1e-3)
    assert _of_height(0.5 + 0.1 * ALONG + rough)[4] == pytest.approx(0.01, rel=1e-3)


def test_shares_of_classes_and_the_picture():
    patch = np.zeros((1, PX, PX, 3), np.float32)
    patch[0, :, :10, 1], patch[0, :, 10:, 1] = 3 / 6, 6 / 6
    patch[0, :, ::2, 0] = 0.5
    patch[..., 2] = 0.25
    found = patch_features(patch, channels=("ortho", "terrain", "roots"), class_count=7, patch_m=PATCH_M)[0]
    assert found == pytest.approx([0.25, 0.25, 0.5, 0, 0, 0, 0.25, 0, 0, 0.75, 0.25, 0, 0])


def test_a_mirror_changes_nothing():
    patches = np.random.default_rng(0).random((5, PX, PX, 3), np.float32)
    patches[..., 1] = np.rint(patches[..., 1] * 6) / 6
    rules = {"channels": ("ortho", "terrain", "height"), "class_count": 7, "patch_m": PATCH_M}
    assert patch_features(patches[:, ::-1], **rules) == pytest.approx(patch_features(patches, **rules), abs=1e-5)
    assert patch_features(patches[:0], **rules).shape == (0, 16)
