"""Who sees the first screen of a faulty run's page finds the fault and its remedy, as the command line names them."""

from pathlib import Path

import pytest
from browser_page import quiet_page
from faulty_drives import CODES, write_logs

from tcpipe.formats.finding_lines import describe_finding, list_remedies
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.report import report
from tcpipe.store import open_store
from tcpipe.tables.findings import find_entry, select_findings


@pytest.fixture(scope="module")
def runs(chromium, tmp_path_factory):  # without a browser nothing is ingested
    here, found = tmp_path_factory.mktemp("faulty"), {}
    for log in write_logs(here):  # in a store of its own: of logs that begin in the same way the longest counts
        ingest([log], store=here / log.stem)
        report(here / log.stem)
        found |= {run.run_id.rpartition("-")[0]: run for run in open_store(here / log.stem).runs()}
    return found


def test_there_are_twenty_faults(runs):
    assert runs.keys() == CODES.keys()
    assert len(CODES) == 20


@pytest.mark.parametrize("name", CODES)
def test_the_first_screen_names_the_fault_and_its_remedy(chromium, runs, name):
    run = runs[name]
    found = select_findings(run.manifest.info.report.findings, CODES[name])
    remedies = list_remedies(found)
    with quiet_page(chromium, Path(run.folder.where("report.html")), (1400, "light")) as tab:
        line = tab.locator(".verdict li", has_text=f"[{CODES[name]}]")
        box, said = line.bounding_box(), " ".join(line.inner_text().split())
        assert 0.0 < box["y"] < box["y"] + box["height"] < 900.0
        assert find_entry(found[0].code).title in said
        assert all(" ".join(describe_finding(finding).split()) in said for finding in found)
        assert remedies
        for purpose, changes in remedies:
            assert purpose in said
            assert all(" ".join(change.split()) in said for change in changes)
        tops = {name: tab.locator(name).first.bounding_box()["y"] for name in (".figures figure", "#chosen")}
        assert tops[".figures figure"] < 300.0
        assert tops["#chosen"] < 700.0  # the selected segment, below a short verdict or the map
