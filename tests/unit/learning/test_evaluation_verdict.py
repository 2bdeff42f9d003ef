"""What an evaluation's page says first: by figures alone, good or of no use."""

from dataclasses import replace

import pytest
from made_models import CARD, made_comparison, made_evaluation

from tcpipe.learning.evaluation_facts import EvaluatedModel, Leakage, SplitErrors
from tcpipe.learning.evaluation_verdict import is_of_no_use, verdict
from tcpipe.learning.fitting import FitConfig
from tcpipe.learning.metrics import Errors
from tcpipe.learning.ratios import Ratio

GOOD = Errors(500, 12.0, 6.0, 500, 90.0, 3.0, 6.0)
BETTER = Ratio(0.8, 0.7, 0.9)
SPLINE = "class and slope, spline"


def told(energy=GOOD, ratio=BETTER, *, split="unseen", floor=1.0, near=0.0, baseline=SPLINE, kind="resnet18"):
    """The sentences of an evaluation on one split, by kind; its own figures and those beside the best baseline."""
    errors, floors = {"E": {"all": energy}, "T": {"all": GOOD}}, {"E": {"all": Errors(500, floor, 1.0, 500)}}
    part = SplitErrors(energy.count, {}, (), errors, floors, leakage=Leakage("sample", 1.05, near, None))
    training = replace(CARD.training, config=FitConfig(model=kind))
    found = made_evaluation(
        model=EvaluatedModel("", "", training),
        splits={split: part},
        baselines=(made_comparison(baseline, ratio, split=split, groups=20),),
    )
    lines = {
        kind: [line.text for line in verdict(found) if line.kind == kind] for kind in ("good", "thin", "doubtful", "do")
    }
    return found, {kind: " ".join(texts) for kind, texts in lines.items()}


def test_a_model_that_is_better_and_knows_its_errors_is_good():
    found, said = told()
    assert not is_of_no_use(found)
    assert "better than every baseline" in said["good"]
    assert "hold 90 % of E on the unseen area" in said["good"]
    assert said["thin"] == said["doubtful"] == said["do"] == ""


def test_half_off_and_more_is_of_no_use():
    found, said = told(replace(GOOD, mape_percent=95.2))
    assert is_of_no_use(found)
    assert "Of no use: on the unseen area energy is off by 95 % on average" in said["doubtful"]
    assert "worst metres" in said["do"]
    assert verdict(found)[0].kind == "doubtful"


@pytest.mark.parametrize("ratio", [Ratio(1.01, 0.95, 1.08), Ratio(1.2, 1.1, 1.3)])
def test_what_does_not_beat_class_and_slope_says_so(ratio):
    _, said = told(ratio=ratio)
    assert said["doubtful"].startswith("It does not beat a curve over class and slope on the unseen area, energy:")
    assert ("tcpipe train DATASET --model table" in said["do"]) == (ratio.low > 1.0)


@pytest.mark.parametrize(
    ("kind", "baseline"), [("table", "class and slope, spline"), ("table", "gradient boosting"), ("physics", "physics")]
)
def test_nobody_is_told_to_train_what_was_evaluated(kind, baseline):
    _, said = told(ratio=Ratio(1.2, 1.1, 1.3), baseline=baseline, kind=kind)
    assert "tcpipe train" not in said["do"]
    assert f"Drive more of this ground: '{baseline}' is better" in said["do"]


def test_too_few_groups_say_neither():
    _, said = told(ratio=Ratio(1.2, None, None))
    assert "too few to say" in said["thin"]
    assert said["doubtful"] == ""


@pytest.mark.parametrize(
    ("held", "kind", "words"),
    [(60.0, "doubtful", "too sure"), (99.0, "thin", "less sure"), (None, "thin", "no errors")],
)
def test_intervals_are_held_to_their_claim(held, kind, words):
    assert words in told(replace(GOOD, held_percent=held))[1][kind]


def test_what_else_a_reader_has_to_know():
    _, said = told(replace(GOOD, count=40), split="test", near=98.0, floor=11.0)
    assert "Only 40 samples of test" in said["thin"]
    assert "98 % of test lie within 1.05 m" in said["thin"]
    assert "errs hardly more than the labels" in said["good"]
    assert "--split REGION" in said["do"]
