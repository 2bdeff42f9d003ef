"""Plans: the ways that physics makes best, and the lines that say why there is none."""

from dataclasses import replace

import numpy as np
import pytest
from physics_model import PhysicsModel, energy_joule, made_residuals, velocity_mps
from planning_worlds import lonlat, plane

from tcpipe.errors import ModelError, PathError
from tcpipe.planning.cost_grid import make_survey
from tcpipe.planning.plan import OBJECTIVES, plan_path
from tcpipe.tables.facts import PhysicsFit, PhysicsTerm
from tcpipe.terrain.layers import ClassTable, TerrainClass

MODEL = PhysicsModel(patch_px=8)


def _plan(source, start, goal, objective, *, model=MODEL, survey=None, **options):
    ends = lonlat(source, start, goal)
    return plan_path(survey or make_survey(model, source, 1.0), ends[0], ends[1], objective, **options)


def _wall(east, north):
    """Trees from the south edge, with a way round in the north."""
    return np.where((np.abs(east - 15.0) < 1.5) & (north < 22.0), 2, 4)


def _road(east, north):
    """Slow ground, and a fast road along the north."""
    return np.where(north > 24.0, 4, 7)


def test_on_open_ground_of_one_kind_every_objective_is_the_straight_line():
    source = plane(30.0)
    for objective in ("energy", "time", "distance"):
        found = _plan(source, (3.2, 4.1), (26.7, 19.9), objective)
        assert len(found.xy_m) == 2
        straight = np.hypot(23.5, 15.8) / 0.9996
        assert found.totals.length_m == pytest.approx(straight, rel=1e-5)
        np.testing.assert_allclose(found.lonlat_deg, lonlat(source, (3.2, 4.1), (26.7, 19.9)), atol=1e-9)


def test_the_way_round_a_wall_keeps_off_it():
    found = _plan(plane(30.0, classes=_wall), (4.0, 4.0), (26.0, 4.0), "distance")
    corner = np.array([(13.5, 22.0), (16.5, 22.0)]) + np.array([500_000.0, 5_200_000.0 - 30.0])
    points = np.concatenate([found.xy_m[:1], corner, found.xy_m[-1:]])
    least = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    assert least <= found.totals.length_m < least + 4.0
    assert found.totals.complete
    assert "obstacle" not in found.totals.reasons


def test_the_fast_road_is_taken_for_time():
    source = plane(36.0, classes=_road)
    survey = make_survey(MODEL, source, 1.0)
    slow, fast = float(velocity_mps(7, 0.0)), float(velocity_mps(4, 0.0))
    found = _plan(source, (3.0, 22.0), (33.0, 22.0), "time", survey=survey)
    assert found.xy_m[:, 1].max() > 5_200_000.0 - 36.0 + 24.0
    x = np.linspace(0.01, 14.99, 2000)
    best = (2.0 * np.hypot(x, 2.0) / slow + (30.0 - 2.0 * x) / fast).min() / 0.9996
    assert best * 0.98 < found.totals.duration_s < best * 1.03
    assert (
        found.totals.duration_s < _plan(source, (3.0, 22.0), (33.0, 22.0), "distance", survey=survey).totals.duration_s
    )


def test_no_other_plan_takes_less_of_what_a_plan_is_the_least_of():
    """Also where the judge sees what the cells do not: borders of classes within a cell, and turns of one path segment."""
    ground = lambda east, north: 4 + (np.sin(east * 0.9) + np.sin(north * 0.7 + 0.2 * east) > 0.5) * 2  # noqa: E731
    source, rng = plane(40.0, classes=ground, rise_north=0.1, pixel_size_m=0.2), np.random.default_rng(1)
    term = PhysicsTerm("turning", "all", 300.0, 5.0, "W s/rad")
    fit = PhysicsFit(500, (term,), {}, 0.4, 8.0, {}, None, 0.05)
    model = replace(MODEL, physics=fit, patch_px=8)
    survey = make_survey(model, source, 2.0)
    survey.predict(np.ones_like(survey.predicted))
    for _ in range(4):
        ends = lonlat(source, (4.0, rng.uniform(4.0, 36.0)), (36.0, rng.uniform(4.0, 36.0)))
        plans = {objective: plan_path(survey, *ends, objective) for objective in OBJECTIVES}
        taken = {name: (of.totals.energy_joule, of.totals.duration_s, of.totals.length_m) for name, of in plans.items()}
        least = [min(column) for column in zip(*taken.values(), strict=True)]
        assert [taken[name][at] for at, name in enumerate(OBJECTIVES)] == least
        assert plans["energy"].totals.finalists >= 4


def test_less_risk_is_taken_on_ground_that_the_model_knows_well():
    """Paved ground (6) needs a little less than grass (4) by prediction, and its held-out samples err by a half."""
    source = plane(30.0, classes=lambda _, north: np.where(north < 14.0, 6, 4), pixel_size_m=0.2)
    residuals = made_residuals(800, 0.02, 0.3)
    residuals["terrain_class"] = np.where(np.arange(800) % 2, 4, 6)
    error = np.where(np.arange(800) % 2, 1.0, 25.0) * (residuals["power_watt"] / 150.0 - 1.0)
    residuals["power_watt"] = 150.0 * (1.0 + error)
    model = replace(FlatModel(), patch_px=8, residuals=residuals)
    survey = make_survey(model, source, 1.0)
    survey.predict(np.ones_like(survey.predicted))
    ends = lonlat(source, (4.0, 12.5), (26.0, 12.5))
    plain, careful = (plan_path(survey, *ends, "energy", risk=risk) for risk in (None, 0.95))
    assert careful.totals.energy_joule > plain.totals.energy_joule
    assert careful.totals.risk_cost < plain.cost.errors["energy"].compute_quantile(0.95)
    assert careful.totals.risk_cost == careful.cost.errors["energy"].compute_quantile(0.95)
    assert careful.xy_m[:, 1].max() > plain.xy_m[:, 1].max() + 1.0
    unsure = make_survey(replace(model, residuals={}), source, 1.0)
    for asked in ({"risk": 0.9}, {"budget_joule": 1e3}):
        with pytest.raises(ModelError, match="too few held-out samples"):
            plan_path(unsure, *ends, "energy", **asked)


class FlatModel(PhysicsModel):
    """Paved ground takes 2 % less than grass."""

    def predict(self, patches, beside=None):
        velocity = super().predict(patches, beside)[:, 1]
        middle = patches[:, patches.shape[1] // 2, patches.shape[2] // 2, self.channels.index("terrain")]
        is_grass = np.rint(middle * (self.classes.count - 1) + 1) == 4
        return np.stack([np.where(is_grass, 150.0, 147.0), np.ones_like(velocity)], axis=1).astype(np.float32)


def test_without_a_cost_map_the_cells_of_short_paths_are_predicted_and_the_plan_is_the_same(caplog):
    """A road beside the straight line is worth the detour; the ellipse of paths up to 1.3 times as long contains it."""
    source = plane(72.0, pixel_size_m=0.2, classes=lambda _, north: np.where(np.abs(north - 36.0) < 2.0, 4, 7))
    model = replace(MODEL, patch_px=8)
    lazy, whole = make_survey(model, source, 1.0), make_survey(model, source, 1.0)
    whole.predict(np.ones_like(whole.predicted))
    with caplog.at_level("INFO", "tcpipe"):
        found = _plan(source, (6.0, 22.0), (66.0, 22.0), "energy", model=model, survey=lazy)
    straight, metres = energy_joule(7, 0.0) * 60.0, 60.0 / 0.9996
    assert found.totals.length_m > 1.03 * metres
    assert found.totals.energy_joule < 0.95 * straight
    assert found.totals.predicted_cells == np.count_nonzero(lazy.predicted) < 0.7 * lazy.predicted.size
    assert [line.partition(" cells")[0] for line in caplog.messages] == [f"predicting {found.totals.predicted_cells}"]
    other = _plan(source, (6.0, 22.0), (66.0, 22.0), "energy", model=model, survey=whole)
    np.testing.assert_array_equal(found.xy_m, other.xy_m)


def test_ends_that_cannot_be_used_are_named_together():
    source = plane(30.0, classes=_wall)
    with pytest.raises(PathError) as error:
        _plan(source, (15.0, 4.0), (45.0, 4.0), "time")
    assert len(error.value.problems) == 1
    assert "--to" in error.value.problems[0]
    with pytest.raises(PathError, match="is on tree, which is not traversable"):
        _plan(source, (15.0, 4.0), (4.0, 4.0), "time")
    with pytest.raises(PathError, match=r"are 0\.\d+ m apart"):
        _plan(source, (4.0, 4.0), (4.3, 4.0), "time")
    with pytest.raises(PathError, match="are in one cell of 5 m; choose a smaller --cell-size"):
        _plan(source, (1.0, 4.0), (4.0, 4.0), "time", survey=make_survey(MODEL, source, 5.0))
    swapped = lonlat(source, (4.0, 4.0), (26.0, 4.0))[:, ::-1]
    with pytest.raises(PathError, match="axes look swapped") as error:
        plan_path(make_survey(MODEL, source, 1.0), swapped[0], swapped[1], "time")
    assert len(error.value.problems) == 2


def test_no_way_says_what_would_open_one():
    source = plane(24.0, classes=lambda east, _: np.where(np.abs(east - 12.0) < 1.5, 2, 4))
    with pytest.raises(PathError, match="is not traversable"):
        _plan(source, (4.0, 4.0), (20.0, 4.0), "distance")
    mud = plane(24.0, classes=lambda east, _: np.where(np.abs(east - 12.0) < 1.5, 5, 4))
    grass_only = replace(MODEL, class_counts={4: 100}, pixel_classes=(4,))
    with pytest.raises(PathError, match="--allow-extrapolation crosses other ground"):
        _plan(mud, (4.0, 4.0), (20.0, 4.0), "distance", model=grass_only)
    found = _plan(mud, (4.0, 4.0), (20.0, 4.0), "time", model=grass_only, allow_extrapolation=True)
    assert found.totals.reasons["class_outside_training"] >= 3


def test_a_model_that_takes_no_classes_keeps_to_what_the_map_s_own_allow():
    source = plane(30.0, classes=_wall)
    model = replace(MODEL, channels=("height",), classes=ClassTable((TerrainClass(1, "all", traversable=True),)))
    found = _plan(source, (4.0, 4.0), (26.0, 4.0), "time", model=model)
    assert found.totals.complete
    assert found.totals.length_m > 40.0
    assert set(found.totals.reasons) <= {"curved"}
