"""What the states of the ground do to picture, height and resistance."""

import numpy as np
import pytest

from tcpipe.simulation.paper_site import make_paper_site, make_paper_surface, scale_hidden_variance
from tcpipe.simulation.world import GRASS, MUD, PAVED, UNPAVED, state

RNG = np.random.default_rng(3)
U, V = RNG.uniform(0, 500, 20000), RNG.uniform(0, 300, 20000)


def on(class_id):
    return np.full(U.size, class_id, np.uint8)


def test_wet_ground_is_darker_and_resists_where_its_class_says_so():
    surface = make_paper_surface()
    wet = state(surface.wetness, U, V)
    assert np.corrcoef(wet, surface.shade(on(MUD), U, V))[0, 1] < -0.8
    assert np.corrcoef(wet, surface.resistance(on(MUD), U, V))[0, 1] > 0.99
    assert abs(np.corrcoef(wet, surface.resistance(on(PAVED), U, V))[0, 1]) < 0.05  # dark, and costs nothing


def test_resistance_keeps_within_its_sources_range():
    """Carvill's gravel, 0.01 to 0.04, and wetness: never beyond their sum."""
    found = make_paper_surface().resistance(on(UNPAVED), U, V)
    assert np.abs(found).max() <= 0.7
    assert found.std() == pytest.approx(np.hypot(0.6, 0.1) / np.sqrt(3.0), rel=0.1)


def test_relief_is_as_rough_as_its_class():
    surface = make_paper_surface()
    swings = np.sqrt(1.0 + surface.swing**2 / 3.0)
    wanted = np.hypot(surface.looks[GRASS].bump_m, surface.looks[GRASS].ridge_m) * swings
    assert surface.relief_m(on(GRASS), U, V).std() == pytest.approx(wanted, rel=0.1)
    assert surface.map_noise_m(U, V).std() == pytest.approx(surface.map_noise_std_m, rel=0.1)


def test_the_pose_does_not_feel_what_the_raster_shows():
    world = make_paper_site().world
    x, y = world.site.west_m + U, world.site.south_m + V
    more = world.mapped_height_m(x, y) - world.height_m(x, y)
    assert 0.004 < more.std() < 0.03


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_what_is_hidden_is_asked_for_by_its_variance(factor):
    world = make_paper_site().world
    squares = [
        sum(wave.amplitude**2 for wave in made.resistance) for made in (scale_hidden_variance(world, factor), world)
    ]
    assert squares[0] == pytest.approx(factor * squares[1])
