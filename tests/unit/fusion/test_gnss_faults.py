"""When fixes erred together: costs by hand, and a made-up robot that knows."""

import numpy as np
import pytest

from tcpipe.fusion.gnss_faults import (
    FaultHypothesis,
    Innovations,
    Jump,
    compute_unexplained_innovation,
    find_returned_fixes,
    find_wrong_fixes,
)

S = 1_000_000_000
WHOLE = (0, 240 * S)


def innovations(squared, refused, *, step_ns=S):
    stamp_ns = np.arange(len(squared), dtype=np.int64) * step_ns
    return Innovations(
        stamp_ns, np.asarray(squared, float), np.asarray(refused, bool), 16.0, np.full(len(squared), 0.4)
    )


def test_a_cost_is_what_stays_unexplained_capped_and_a_price_for_each_second():
    refused = np.zeros(20, bool)
    refused[[2, 10, 11, 12, 13, 14, 15]] = True  # one alone, and six in a row
    fixes = innovations(np.where(refused, 400.0, 2.0), refused)
    nothing = compute_unexplained_innovation((), fixes, [innovations([1.0, 30.0], [False, True])], usual=3.0)
    # 13 taken, one outlier at the usual, six at the gate, and the odometry's 1 and 16.
    assert nothing.cost == pytest.approx(13 * 2 + 3 + 6 * 16 + 17)
    assert nothing.refused == ((10 * S, 16 * S),)
    assert nothing.size_m == pytest.approx(0.4)
    freed = compute_unexplained_innovation(((10 * S, 16 * S),), fixes, [], usual=3.0)
    assert freed.cost == pytest.approx(13 * 2 + 3 + 6 * 3 + 6 * 2.0)
    assert freed.refused == ()


def robot(spans):
    """Fixes that are wrong from 90 to 150 s, and an odometry that refuses each jump for ten seconds: what is left unexplained."""
    wrong = [at * S for at in range(90, 150)]
    covered = [at for at in wrong if any(first <= at < last for first, last in spans)]
    refused = () if len(covered) == len(wrong) else ((90 * S, 100 * S), (150 * S, 160 * S))
    price = 2.0 * sum((last - first) / S for first, last in spans)
    return FaultHypothesis(spans, 1000.0 * (len(refused) > 0) + price, refused, 0.5)


def test_fixes_that_jump_and_come_back_were_wrong_in_between():
    found = find_wrong_fixes(robot, WHOLE, ())
    (span,) = found.spans
    assert 85 * S <= span[0] <= 90 * S
    assert span[1] == 150 * S
    assert found.doubtful == ()


def test_without_any_refusal_nothing_is_wrong():
    assert find_wrong_fixes(lambda spans: FaultHypothesis(spans, 0.0, (), 0.0), WHOLE, ()) is None


def test_fixes_that_are_off_most_of_the_way_are_no_matter_of_spans():
    tried = lambda spans: FaultHypothesis(spans, 0.0, ((10 * S, 200 * S),), 0.4)  # noqa: E731
    assert find_wrong_fixes(tried, WHOLE, ()) is None


def test_where_before_and_after_explain_a_jump_as_well_both_are_doubted_for_a_minute():
    def tried(spans):
        cost = 600.0 if not spans else 100.0 + 0.05 * sum((b - a) / S for a, b in spans)
        return FaultHypothesis(spans, cost, () if spans else ((120 * S, 126 * S),), 0.5)

    found = find_wrong_fixes(tried, WHOLE, ())
    assert found.spans == ((117 * S, 126 * S),)
    assert found.doubtful == ((60 * S, 180 * S),)
    at_ns = np.array([30, 100, 120, 170, 200]) * S
    doubt_m2 = found.doubt_m2(at_ns)
    np.testing.assert_allclose(doubt_m2[:, 0], [0.0, 0.25, 0.0, 0.25, 0.0])  # the filter knows of 117 to 126 s itself
    np.testing.assert_allclose(doubt_m2[:, 2], 0.0)


def test_after_a_single_jump_the_shorter_span_is_no_better_for_being_short():
    """Before it costs a second's price for two minutes, and explains somewhat more: the minutes beside the jump are doubted."""

    def tried(spans):
        length_s = sum((b - a) / S for a, b in spans)
        cost = 600.0 if not spans else (80.0 if length_s > 60.0 else 100.0) + 2.0 * length_s
        return FaultHypothesis(spans, cost, () if spans else ((120 * S, 126 * S),), 0.5)

    found = find_wrong_fixes(tried, WHOLE, ())
    assert found.spans == ((117 * S, 126 * S),)
    assert found.doubtful == ((60 * S, 180 * S),)


def test_where_each_jump_alone_explains_about_as_much_all_between_them_is_doubted():
    """A filter that nothing holds follows the fixes after each jump: two short spans, against the one that is true."""

    def tried(spans):
        covered = sum((b - a) / S for a, b in spans if a < 100 * S and b > 140 * S)
        cost = 900.0 if not spans else 100.0 + covered
        return FaultHypothesis(spans, cost, () if spans else ((90 * S, 98 * S), (150 * S, 156 * S)), 0.5)

    found = find_wrong_fixes(tried, WHOLE, ())
    assert found.spans == ((87 * S, 98 * S), (147 * S, 156 * S))
    assert any(first <= 87 * S and last >= 150 * S for first, last in found.doubtful)


def test_a_jump_and_its_return_doubt_what_is_between():
    there, aside = np.array([0.4, 0.3]), np.array([-0.3, 0.4])
    found = find_returned_fixes([Jump(90 * S, there), Jump(150 * S, -there)])
    assert found.doubtful == ((87 * S, 150 * S),)
    assert found.size_m == pytest.approx(0.5)
    assert find_returned_fixes([Jump(90 * S, there), Jump(150 * S, aside)]) is None
    assert find_returned_fixes([Jump(0, there), Jump(200 * S, -there)]) is None
    assert find_returned_fixes([]) is None
