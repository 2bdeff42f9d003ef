"""Claims hold by figures alone."""

from dataclasses import replace

import pytest
from made_models import CARD

from tcpipe.learning.claims import checked_claims
from tcpipe.learning.evaluation import EXPECTED, GRASS_ONLY, OURS, PER_CLASS
from tcpipe.learning.evaluation_facts import (
    AblationRow,
    EvaluateConfig,
    EvaluatedDataset,
    EvaluatedModel,
    Evaluation,
    SplitErrors,
)
from tcpipe.learning.metrics import Errors


def _error(mape, rmse=1.0):
    return Errors(10, rmse, mape, 10)


def _run(*, without_h=50.0, without_c=17.0, grass=28.0, own=17.0, ours=12.8, expected=14.0, floor=0.8):
    left = {"OCH": ours, "CH": 14.5, "OH": without_c, "OC": without_h}
    errors, least = {"w": {"all": _error(9.0, 1.0)}}, {"w": {"all": _error(8.0, floor)}}
    return Evaluation(
        tcpipe_version="",
        key="",
        model=EvaluatedModel("", "", CARD.training),
        dataset=EvaluatedDataset("", "", {}),
        config=EvaluateConfig(),
        splits={"unseen": SplitErrors(10, {}, (), errors, {}, least)},
        ablation=tuple(
            AblationRow(tuple(letters), "noise", unseen={"E": _error(value)}) for letters, value in left.items()
        ),
        energy={who: {"unseen": _error(value)} for who, value in ((OURS, ours), (GRASS_ONLY, grass), (PER_CLASS, own))},
        time={OURS: {"unseen": _error(5.0)}, EXPECTED: {"unseen": _error(expected)}},
        repeatability={},
        warnings=(),
        plots={},
    )


def _held(runs):
    return {claim.says: claim.held for claim in checked_claims(runs)}


def test_the_papers_figures_hold_all_of_its_claims():
    claims = checked_claims([_run()])
    assert all(claim.held for claim in claims)
    assert {claim.says: claim.ratio for claim in claims}["height matters most"] == pytest.approx(50.0 / 17.0)
    assert len(claims) == 6


def test_the_papers_own_ratios():
    """By hand, from its tables III to V."""
    said = {claim.says: claim.in_the_paper for claim in checked_claims([_run()])}
    assert said == {
        "height matters most": pytest.approx(52.20 / 17.38),
        "class matters for unseen areas": pytest.approx(17.38 / 12.80),
        "one net beats grass-only by far": pytest.approx(28.37 / 12.80),
        "one net beats per-class nets": pytest.approx(16.96 / 12.80),
        "T is far better than expected time": pytest.approx(13.82 / 5.04),
        "w is as good as can be": None,
    }


@pytest.mark.parametrize(
    ("change", "falls"),
    [
        ({"without_h": 18.0}, "height matters most"),
        ({"without_c": 13.0}, "class matters for unseen areas"),
        ({"grass": 18.0}, "one net beats grass-only by far"),
        ({"own": 12.0}, "one net beats per-class nets"),
        ({"expected": 6.0}, "T is far better than expected time"),
        ({"floor": 0.5}, "w is as good as can be"),
    ],
)
def test_a_figure_that_turns_fells_its_claim_alone(change, falls):
    held = _held([_run(**change)])
    assert [says for says, holds in held.items() if not holds] == [falls]


def test_several_trainings_count_by_their_mean():
    held = _held([_run(own=11.0), _run(own=20.0)])
    assert held["one net beats per-class nets"]


def test_what_was_not_measured_is_not_held():
    run = _run()
    run = replace(run, energy={who: errors for who, errors in run.energy.items() if who != PER_CLASS})
    (claim,) = (claim for claim in checked_claims([run]) if claim.says == "one net beats per-class nets")
    assert not claim.held
    assert str(claim).startswith("not measured: ")
