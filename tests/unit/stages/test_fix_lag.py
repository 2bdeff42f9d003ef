"""A lag of the fixes that only the path tells."""

from tcpipe.stages.clock_findings import add_gnss_time_offset
from tcpipe.tables.facts import ClockFacts, ClockOffset
from tcpipe.tables.findings import StageReport, Subject, make_finding


def test_a_lag_that_only_the_path_tells_is_said_and_costs_what_is_driven_in_it():
    before = make_finding(
        "time-offset", Subject("role", "power"), offset_s=0.1, offset_2std_s=0.02, names={"reference": "imu"}
    )
    silent = StageReport((before,), ClockFacts(0, "imu", (), {}))
    assert add_gnss_time_offset(silent, None) is silent
    found = add_gnss_time_offset(silent, (0.12, 0.02))
    assert found.facts.position_offset_s == 0.12
    assert found.facts.offsets["gnss"].noted
    assert not found.facts.offsets["gnss"].blamed
    assert found.findings[0] == before
    assert (found.findings[1].code, found.findings[1].subject.name) == ("clocks-differ", "gnss")
    assert found.findings[1].numbers == {"offset_s": 0.12, "offset_2std_s": 0.04, "apart_s": 0.12}
    told = ClockOffset(0.1, 0.01, True, None, None, False)
    by_signals = StageReport((), ClockFacts(0, "imu", (), {"gnss": told}))
    assert add_gnss_time_offset(by_signals, (0.12, 0.02)) is by_signals
