"""A lag of the fixes that only the path tells."""

from tcpipe.stages.fix_lag import with_lag_of_fixes
from tcpipe.tables.facts import ClockFacts, ClockOffset
from tcpipe.tables.findings import StageReport


def test_a_lag_that_only_the_path_tells_is_said_and_costs_what_is_driven_in_it():
    silent = StageReport(("imu: fine",), ClockFacts(0, "imu", (), {}))
    assert with_lag_of_fixes(silent, None) is silent
    found = with_lag_of_fixes(silent, (0.12, 0.02))
    assert found.facts.position_offset_s == 0.12
    assert found.facts.offsets["gnss"].noted
    assert not found.facts.offsets["gnss"].blamed
    assert found.warnings[0] == "imu: fine"
    assert "0.12 s late (± 0.04 s" in found.warnings[1]
    told = ClockOffset(0.1, 0.01, True, None, None, False, "gnss = -0.1")
    by_signals = StageReport((), ClockFacts(0, "imu", (), {"gnss": told}))
    assert with_lag_of_fixes(by_signals, (0.12, 0.02)) is by_signals
