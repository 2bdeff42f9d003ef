"""The shipped recipes parse, and say what their comments claim."""

from pathlib import Path

from tcpipe.formats.recipe_toml import ingest_key, load_recipe
from tcpipe.recipe import Recipe

PIPELINES = Path(__file__).parents[2] / "pipelines"


def test_husky_is_the_default_written_out() -> None:
    husky = load_recipe(PIPELINES / "husky.toml")
    assert husky.robot == "husky"
    assert ingest_key(husky) == ingest_key(Recipe())
    assert (husky.sample, husky.split) == (Recipe().sample, Recipe().split)


def test_husky_paper_is_the_paper() -> None:
    paper = load_recipe(PIPELINES / "husky-paper.toml")
    assert paper.fuse.estimator == "ukf"
    assert (paper.label.velocity, paper.label.integration) == ("fused", "right_endpoint")
    assert paper.split.holdout == "sample"
    assert (paper.sample.patch_m, paper.sample.patch_px, paper.segment.chord_m) == (1.0, 40, 1.0)
