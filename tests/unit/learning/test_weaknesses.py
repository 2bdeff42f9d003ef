"""What the figures of an evaluation show of a model, as findings and a verdict."""

from dataclasses import replace

import pytest
from made_models import CARD, made_comparison, made_evaluation

from tcpipe.cost.coverage import Coverage
from tcpipe.learning.evaluation import EvaluatedModel, Leakage, SplitErrors, find_weaknesses
from tcpipe.learning.metrics import Errors, Ratio
from tcpipe.tables.findings import judge

GOOD = Errors(500, 12.0, 6.0, 500, 90.0, 3.0, 6.0)
BETTER = Ratio(0.8, 0.7, 0.9)
CURVES = "class and slope, linear"


SURE = Coverage(0.9, 0.85, 0.93, 12, 500)


def told(
    energy=GOOD,
    ratio=BETTER,
    *,
    split="unseen",
    floor=1.0,
    near=0.0,
    baseline=CURVES,
    kind="resnet18",
    coverage=SURE,
    off=3.0,
):
    """The findings on an evaluation of one split by code, from its own figures and those of the best baseline."""
    floors = {"E": {"all": Errors(500, floor, 1.0, 500)}}
    errors, leakage = {"E": {"all": energy}, "T": {"all": GOOD}}, Leakage("sample", 1.05, near, None)
    stated = {} if coverage is None else {"E": coverage, "T": coverage}
    model = EvaluatedModel("", "", replace(CARD.training, kind=kind))
    evaluation = made_evaluation(
        model=model,
        splits={
            split: SplitErrors(energy.count, {}, (), errors, stated, {"E": off, "T": 3.0}, floors, leakage=leakage)
        },
        baselines=(made_comparison(baseline, ratio, split=split),),
    )
    return {of.code: of for of in find_weaknesses(evaluation)}


def test_a_model_that_is_better_and_calibrated_has_no_findings():
    assert told() == {}


@pytest.mark.parametrize(("off", "grade"), [(9.0, "usable"), (12.0, "usable with care"), (21.0, "not usable")])
@pytest.mark.parametrize("kind", ["linear", "boosting", "resnet18"])
def test_one_scale_judges_every_kind(off, grade, kind):
    """The energy of 30 m: up to 10 % usable, up to 20 % with care."""
    found = told(off=off, kind=kind)
    verdict = judge(found.values())
    assert (verdict.energy, verdict.time) == (grade, "usable")
    if off > 10.0:
        assert found["energy-far-off"].numbers == {"error_fraction": pytest.approx(off / 100.0)}


@pytest.mark.parametrize("ratio", [Ratio(1.01, 0.95, 1.08), Ratio(1.2, 1.1, 1.3)])
def test_a_better_baseline_is_named_and_changes_no_verdict(ratio):
    found = told(ratio=ratio, baseline="physics")
    assert judge(found.values()).energy == "usable"
    best = found["baseline-not-beaten"]
    assert best.numbers["rmse_fraction"] == ratio.value
    commands = [of.command for of in best.remedies]
    assert commands == (["tcpipe train DATASET --model physics"] if ratio.low > 1.0 else [])


@pytest.mark.parametrize(
    ("kind", "baseline"), [("linear", CURVES), ("boosting", "gradient boosting"), ("physics", "physics")]
)
def test_nobody_is_told_to_train_what_was_evaluated(kind, baseline):
    best = told(ratio=Ratio(1.2, 1.1, 1.3), baseline=baseline, kind=kind)["baseline-not-beaten"]
    assert best.names == {"baseline": baseline}
    assert best.remedies == ()


def test_too_few_groups_show_neither():
    assert set(told(ratio=Ratio(1.2, None, None))) == {"baseline-not-beaten"}


@pytest.mark.parametrize(
    ("coverage", "codes", "grades"),
    [
        (Coverage(0.6, 0.5, 0.7, 12, 500), {"energy-overconfident", "time-overconfident"}, {"usable with care"}),
        (Coverage(0.76, 0.3, 0.97, 5, 500), set(), {"usable"}),
        (Coverage(0.76, None, None, 2, 500), set(), {"usable"}),
        (Coverage(0.99, 0.97, 1.0, 12, 500), {"underconfident"}, {"usable"}),
        (None, {"no-intervals"}, {"usable"}),
    ],
)
def test_intervals_are_compared_with_what_they_state(coverage, codes, grades):
    found = told(coverage=coverage)
    assert set(found) == codes
    verdict = judge(found.values())
    assert {verdict.energy, verdict.time} == grades


def test_few_samples_near_training_are_named():
    found = told(replace(GOOD, count=40), split="test", near=98.0, floor=11.0)
    assert set(found) == {"few-samples", "split-leakage", "split-empty"}
    assert found["split-leakage"].numbers == {"overlapping_count": 39.0, "sample_count": 40.0}
    assert found["split-empty"].severity == "note"
