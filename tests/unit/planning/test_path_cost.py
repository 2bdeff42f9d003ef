"""What a path costs, against a model and worlds of closed form."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from physics_model import PhysicsModel, energy_joule, velocity_mps
from planning_worlds import lonlat, plane

from tcpipe.errors import ModelError, PathError
from tcpipe.planning.cost_model import Reason
from tcpipe.planning.path_cost import compute_path_cost, cut_path
from tcpipe.tables.facts import PhysicsFit, PhysicsTerm
from tcpipe.terrain.layers import PAPER_CLASSES, ClassTable

MODEL = PhysicsModel()
TURNS = PhysicsFit(500, (PhysicsTerm("turning", "all", 80.0, 2.0, "J/rad"),), {}, 0.4, 8.0, {}, None, 0.05)
SCALE = 1.0 / 0.9996
"""Ground metres a map metre on the central meridian of a UTM zone."""


def _cost(source, *points, model=MODEL):
    return compute_path_cost(model, source, lonlat(source, *points), where="path")


def test_uphill_and_downhill_on_a_plane():
    source = plane(rise_east=0.2)
    slope = 0.2 / SCALE  # the map's rise a map metre, over ground metres
    up, down = _cost(source, (2.0, 12.0), (22.0, 12.0)), _cost(source, (22.0, 12.0), (2.0, 12.0))
    metres = 20.0 * SCALE
    assert up.totals.length_m == pytest.approx(metres, rel=1e-6)
    assert up.totals.duration_s == pytest.approx(metres / velocity_mps(4, slope), rel=2e-3)
    assert up.totals.energy_joule == pytest.approx(metres * energy_joule(4, slope), rel=2e-3)
    assert down.totals.energy_joule == pytest.approx(metres * energy_joule(4, -slope), rel=1e-2)
    assert down.totals.energy_joule < up.totals.energy_joule


def test_a_model_of_the_velocity_along_the_surface_takes_longer_for_a_metre_of_the_map():
    source = plane(rise_east=0.4)
    along, ground = (
        _cost(source, (2.0, 12.0), (22.0, 12.0), model=replace(MODEL, label_velocity=label))
        for label in ("fused", "ground")
    )
    longer = np.hypot(1.0, 0.4 / SCALE)  # a metre of the map on the slope
    assert along.totals.duration_s == pytest.approx(ground.totals.duration_s * longer, rel=2e-3)
    assert along.totals.energy_joule == pytest.approx(ground.totals.energy_joule * longer, rel=2e-3)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"class_counts": {5: 10}}, Reason.CLASS_OUTSIDE_TRAINING),
        ({"pixel_classes": (5, 6)}, Reason.CLASS_OUTSIDE_TRAINING),
        (
            {"training_range": {"slope_rad": (-0.1, 0.1), "cross_slope_rad": (-1, 1), "relief_m": (0, 1)}},
            Reason.SLOPE_OUTSIDE_TRAINING,
        ),
        (
            {"training_range": {"slope_rad": (-1, 1), "cross_slope_rad": (0.1, 1), "relief_m": (0, 1)}},
            Reason.CROSS_SLOPE_OUTSIDE_TRAINING,
        ),
        (
            {"training_range": {"slope_rad": (-1, 1), "cross_slope_rad": (-1, 1), "relief_m": (0, 0.1)}},
            Reason.RELIEF_OUTSIDE_TRAINING,
        ),
    ],
)
def test_ground_that_training_has_not_seen_is_marked_and_still_costed(changes, reason):
    found = _cost(plane(rise_east=0.2), (4.0, 12.0), (9.0, 12.0), model=replace(MODEL, **changes))
    assert found.totals.reasons == {str(reason.name).lower(): found.path_segments.num_rows}
    assert found.totals.complete


def test_what_cannot_be_driven_has_no_cost_and_the_lane_beside_it_is_marked():
    source = plane(classes=lambda _, north: np.where(np.abs(north - 12.0) < 0.9, 2, 4))
    through = _cost(source, (12.0, 2.0), (12.0, 22.0))
    assert 1 <= through.totals.path_segments_without_cost <= 3
    assert through.totals.path_segments_without_cost == through.totals.reasons["not_traversable"]
    assert not through.totals.complete
    extra_features = _cost(source, (4.0, 13.1), (20.0, 13.1))
    assert extra_features.totals.complete
    assert extra_features.totals.reasons["obstacle"] == extra_features.path_segments.num_rows


def test_holes_and_the_map_s_edge_are_told_apart():
    source = plane()
    source.arrays["height"][100:120, 100:120] = np.nan
    found = _cost(source, (4.0, 13.0), (30.0, 13.0))
    names = found.path_segments.column("reason_names").to_pylist()
    assert found.path_segments.num_rows == len(names) == 27
    assert found.totals.reasons["nodata"] >= 2
    assert found.totals.reasons["outside_map"] >= 6
    assert (
        found.totals.path_segments_without_cost == found.totals.reasons["nodata"] + found.totals.reasons["outside_map"]
    )
    assert np.isnan(found.path_segments.column("energy_joule").to_numpy()[-1])


def test_a_bend_sharper_than_any_segment_is_marked_and_paid_along_its_arc():
    found = _cost(plane(), (4.0, 4.0), (8.5, 4.0), (8.5, 8.0))
    assert found.totals.reasons == {"curved": 1}
    assert found.totals.length_m == pytest.approx(8.5 * SCALE, rel=1e-4)
    bent = _cost(plane(), (4.0, 4.0), (8.5, 4.0), (8.5, 8.0), model=replace(MODEL, max_arc_to_chord=1.5))
    assert bent.totals.reasons == {}, "a model of curved segments knows bends"


class _Stuck(PhysicsModel):
    def predict(self, patches, extra_features):
        said = super().predict(patches, extra_features)
        said[3:5, 1] = 0.0, np.nan
        return said


class _Told(PhysicsModel):
    """Takes 1000 W more for a radian a metre."""

    def predict(self, patches, extra_features):
        return super().predict(patches, extra_features) + np.column_stack(
            [1000.0 * np.nan_to_num(extra_features.turn_radpm), 0.0 * extra_features.slope_rad]
        )


def test_a_model_that_takes_turns_is_told_those_of_the_path_and_none_is_paid_twice():
    bend = (plane(), (4.0, 4.0), (8.0, 4.0), (8.0, 8.0))
    plain = _cost(*bend, model=replace(MODEL, physics=TURNS))
    told = _cost(*bend, model=_Told(takes_turns=True, physics=TURNS))
    assert told.totals.turn_energy_joule is None
    assert plain.totals.turn_energy_joule > 0.0
    turn = told.path_segments.column("turn_rad").to_numpy() / told.path_segments.column("arc_length_m").to_numpy()
    more = told.path_segments.column("power_watt").to_numpy() - plain.path_segments.column("power_watt").to_numpy()
    assert turn.max() > 0.5
    assert more == pytest.approx(np.where(turn > TURNS.mean_turn_radpm, 1000.0 * turn, 0.0), rel=1e-4, abs=1e-3)


class _EnergyAlone(PhysicsModel):
    def predict(self, patches, extra_features):
        return super().predict(patches, extra_features)[:, :1]


def test_where_the_model_says_that_nothing_moves_there_is_no_cost():
    found = _cost(plane(), (4.0, 4.0), (12.0, 4.0), model=_Stuck())
    assert found.totals.reasons == {"no_motion": 2}
    assert np.flatnonzero(np.isnan(found.path_segments.column("energy_joule").to_numpy())).tolist() == [3, 4]


def test_a_model_of_something_else_is_refused():
    with pytest.raises(ModelError, match="gives 1 numbers per patch, expected two"):
        _cost(plane(), (4.0, 4.0), (9.0, 4.0), model=_EnergyAlone())


def test_bad_paths_are_one_line_each():
    source = plane()
    for points, words in [
        (((4.0, 4.0), (4.3, 4.0)), "never 1 m from its start"),
        (((4.0, 4.0), (4.0, 4.0)), "one point"),
        (((400.0, 4.0), (420.0, 4.0)), "is not on map"),
    ]:
        with pytest.raises(PathError, match=words) as error:
            _cost(source, *points)
        assert len(error.value.problems) == 1
    swapped = lonlat(source, (4.0, 4.0), (12.0, 4.0))[:, ::-1]
    with pytest.raises(PathError, match="axes look swapped"):
        compute_path_cost(MODEL, source, swapped, where="path")


def test_a_model_of_other_classes_or_layers_is_refused_at_once():
    other = ClassTable(PAPER_CLASSES.classes[:-1])
    with pytest.raises(ModelError, match="id 7 is paved road"):
        _cost(plane(), (4.0, 4.0), (9.0, 4.0), model=replace(MODEL, classes=other))
    bare = plane()
    del bare.arrays["ortho"]
    with pytest.raises(ModelError, match="has no ortho"):
        _cost(bare, (4.0, 4.0), (9.0, 4.0))


_POINT = st.tuples(st.floats(-20.0, 20.0), st.floats(-20.0, 20.0))


def test_a_metre_is_a_metre_of_ground_where_the_map_is_out_of_scale():
    segments = cut_path(np.array([[0.0, 0.0], [10.0, 0.0]]), chord_m=1.0, scale=0.9996)
    np.testing.assert_allclose(np.diff(segments.start_xy_m[:, 0]), 1.0 / 0.9996)
    assert segments.arc_m.sum() == pytest.approx(9.996)


@given(st.lists(_POINT, min_size=2, max_size=12, unique=True))
def test_segments_join_up_and_add_up_to_the_path(points):
    xy = np.array(points)
    segments = cut_path(xy, chord_m=1.0, scale=1.0)
    length = np.linalg.norm(np.diff(xy, axis=0), axis=1).sum()
    np.testing.assert_array_equal(segments.start_xy_m[1:], segments.end_xy_m[:-1])
    np.testing.assert_allclose(segments.chord_m[:-1], 1.0, atol=1e-9)
    assert (segments.arc_m >= segments.chord_m - 1e-9).all()
    assert segments.arc_m.sum() <= length + 1e-9
    if len(segments.chord_m):
        assert (
            segments.arc_m.sum() == pytest.approx(length, abs=2e-3)
            or np.linalg.norm(xy[-1] - segments.end_xy_m[-1]) <= 1e-3
        )
