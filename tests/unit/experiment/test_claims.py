"""Claims hold by figures alone."""

import numpy as np
import pytest
from made_models import made_comparison

from tcpipe.experiment.claims import CLAIMS, FEWEST_SEEDS, check_claims
from tcpipe.experiment.networks import HEIGHTS
from tcpipe.learning.metrics import Ratio

SURE = Ratio(0.8, 0.7, 0.9)


def _run(**ratios):
    return [
        made_comparison(name, ratios.get(name, SURE) if quantity == "E" else Ratio(9.0, 8.0, 10.0), quantity=quantity)
        for name in CLAIMS
        for quantity in ("w", "E")
    ]


def _verdicts(runs):
    return {claim.says: claim.verdict for claim in check_claims(runs)}


def _runs(**ratios):
    return [_run(**ratios)] * FEWEST_SEEDS


def test_intervals_below_one_hold_every_claim_over_enough_trainings():
    assert set(_verdicts(_runs()).values()) == {"held"}
    assert len(check_claims(_runs())) == len(CLAIMS)
    assert set(_verdicts(_runs()[1:]).values()) == {"open"}
    assert set(_verdicts([_run()]).values()) == {"open"}


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
    found = _verdicts(_runs(**{baseline: ratio}))
    assert found.pop(CLAIMS[baseline]) == verdict
    assert set(found.values()) == {"held"}


def test_the_papers_own_ratio():
    """By hand, from its table IV: RMSE of E on the unseen area."""
    told = {claim.says: claim.in_the_paper for claim in check_claims([_run()])}
    assert told.pop("one net beats a net per class, heights alone") == pytest.approx(26.63 / 32.92)
    assert set(told.values()) == {None}


def _spread(*values):
    """Trainings with these ratios, each with an interval of ± 2 % that alone would hold the claim."""
    return [_run(**{HEIGHTS: Ratio(value, value / 1.02, value * 1.02)}) for value in values]


def _claim(runs):
    return next(claim for claim in check_claims(runs) if claim.says == CLAIMS[HEIGHTS])


def test_trainings_that_differ_leave_a_claim_open():
    """By hand: five ratios of mean 0.9 whose logarithms scatter by 0.12, and t of four degrees of freedom is 2.78."""
    claim = _claim(_spread(0.80, 0.95, 0.97, 0.78, 1.03))
    logs = np.log([0.80, 0.95, 0.97, 0.78, 1.03])
    assert claim.ratio.value == pytest.approx(np.exp(logs.mean()))
    assert claim.between_seeds == pytest.approx(logs.std(ddof=1))
    assert np.log(claim.ratio.high / claim.ratio.value) == pytest.approx(
        2.776 * logs.std(ddof=1) / np.sqrt(5), rel=0.05
    )
    assert claim.verdict == "open"
    assert _claim(_spread(0.80, 0.82, 0.81, 0.79, 0.83)).verdict == "held"
    assert _claim(_spread(1.20, 1.22, 1.21, 1.19, 1.23)).verdict == "NOT held"
    assert _claim(_spread(0.80, 0.95, 0.97)).verdict == "open"  # three trainings decide nothing


def test_equal_trainings_leave_the_interval_of_their_samples():
    """The samples are the same for all: more trainings do not make them more."""
    claim = _claim(_runs(**{HEIGHTS: Ratio(0.9, 0.8, 0.9**2 / 0.8)}))
    assert (claim.ratio.low, claim.ratio.high) == pytest.approx((0.8, 0.9**2 / 0.8), rel=1e-3)


def test_what_was_not_measured_in_one_training_is_not_measured():
    claim = _claim([_run(), _run(**{HEIGHTS: Ratio(None, None, None)})])
    assert str(claim) == (
        "not measured: one net beats a net per class, heights alone, unseen: RMSE of E – of its (0.81 in the paper); one training"
    )
