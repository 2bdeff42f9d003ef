"""Claims hold by figures alone."""

from pathlib import Path

import pytest
from made_models import made_comparison, made_evaluation

from tcpipe.experiment.reproduction_page import DIFFERENCES
from tcpipe.experiment.simulation_floor import CLAIMS, check_claims
from tcpipe.learning.baselines import PER_CLASS
from tcpipe.learning.evaluation_facts import SplitErrors
from tcpipe.learning.metrics import Ratio

SURE = Ratio(0.8, 0.7, 0.9)


def _run(**ratios):
    rows = [
        made_comparison(name, ratios.get(name, SURE) if quantity == "E" else Ratio(9.0, 8.0, 10.0), quantity=quantity)
        for name in CLAIMS
        for quantity in ("w", "E")
    ]
    networks = tuple(row for row in rows if row.baseline == PER_CLASS)
    baselines = tuple(row for row in rows if row.baseline != PER_CLASS)
    splits = {"unseen": SplitErrors(10, {}, (), {}, {})}
    return made_evaluation(splits=splits, networks=networks, baselines=baselines)


def _verdicts(runs):
    return {claim.says: claim.verdict for claim in check_claims(runs)}


def test_intervals_below_one_hold_every_claim():
    assert set(_verdicts([_run()]).values()) == {"held"}
    assert len(check_claims([_run()])) == len(CLAIMS)


@pytest.mark.parametrize("baseline", list(CLAIMS))
@pytest.mark.parametrize(
    ("ratio", "verdict"),
    [
        (Ratio(1.2, 1.1, 1.3), "NOT held"),
        (Ratio(0.9, 0.7, 1.1), "open"),
        (Ratio(0.5, None, None), "open"),
        (Ratio(None, None, None), "not measured"),
    ],
)
def test_a_figure_that_turns_fells_its_claim_alone(baseline, ratio, verdict):
    found = _verdicts([_run(**{baseline: ratio})])
    assert found.pop(CLAIMS[baseline]) == verdict
    assert set(found.values()) == {"held"}


def test_the_papers_own_ratio():
    """By hand, from its table IV: RMSE of E on the unseen area."""
    told = {claim.says: claim.in_the_paper for claim in check_claims([_run()])}
    assert told.pop("one net beats a net per class") == pytest.approx(26.63 / 32.92)
    assert set(told.values()) == {None}


def test_several_trainings_have_the_mean_ratio_and_the_widest_interval():
    runs = [_run(**{PER_CLASS: Ratio(0.5, 0.4, 0.6)}), _run(**{PER_CLASS: Ratio(0.98, 0.9, 1.05)})]
    claim = check_claims(runs)[0]
    assert claim.ratio.value == pytest.approx(0.7)
    assert (claim.ratio.low, claim.ratio.high, claim.verdict) == (0.4, 1.05, "open")


def test_what_was_not_measured_in_one_training_is_not_measured():
    claim = check_claims([_run(), _run(**{PER_CLASS: Ratio(None, None, None)})])[0]
    assert str(claim) == "not measured: one net beats a net per class, unseen: RMSE of E – of its (0.81 in the paper)"


PAGE = (Path(__file__).parents[3] / "docs" / "explanation" / "reproduction.md").read_text(encoding="utf-8")


def test_the_documentation_has_every_difference_in_the_same_words():
    assert [row for row in DIFFERENCES if f"| {' | '.join(row)} |" not in PAGE] == []
