"""README.md of a dataset: what its YAML head promises is there, and no name in it is markup."""

import json
import re
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from synthetic_store import box, region_file, small_store

from tcpipe.formats.dataset_files import read_card
from tcpipe.formats.hub_card import format_hub_card
from tcpipe.pipeline.dataset.build import build_dataset


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    here = tmp_path_factory.mktemp("hub")
    small_store(here)
    region = region_file(here / "region.geojson", box(-18, -18, 18, 0))
    build_dataset(here / "dataset", store=here / "store", split=region, file_format="parquet")
    return here / "dataset"


def head_of(text):
    """YAML's own subset that JSON is: a key a line."""
    head = re.fullmatch(r"---\n(.*?)---\n.*", text, re.DOTALL)[1]
    return {key: json.loads(value) for key, value in (line.split(": ", 1) for line in head.splitlines())}


def test_each_config_has_the_files_that_the_head_says(built):
    head = head_of((built / "README.md").read_text())
    rows = {
        (config["config_name"], files["split"]): sum(
            pq.read_metadata(built / path).num_rows for path in np.atleast_1d(files["path"])
        )
        for config in head["configs"]
        for files in config["data_files"]
    }
    card = read_card(built)
    splits = {("patches", split): count for split, count in card.splits.items() if count}
    assert rows == {**splits, ("samples", "full"): card.samples}
    assert head["size_categories"] == ["n<1K"]


def test_names_are_text(built):
    card = read_card(built)
    hostile = '<script>a</script>](x)\n---\n"b: [c]\x1b[31m'
    card = replace(card, name=hostile, description=hostile, licence=hostile, creator=hostile + "}")
    text = format_hub_card(card)
    head = head_of(text)
    assert (head["pretty_name"], head["license"], head["license_name"]) == (hostile, "other", hostile)
    body, citation = text.split("---\n", 2)[2].split("```bibtex")
    assert citation.count("```") == 1
    assert citation.count("{") == citation.count("}")
    assert "<script>" not in body
    assert "](x)" not in body.replace("\\](x)", "")
    assert all(c.isprintable() or c == "\n" for c in body)


def test_a_known_licence_is_told_by_the_name_the_hub_has_for_it(built):
    card = read_card(built)
    for given, told in (("CC-BY-4.0", "cc-by-4.0"), ("", "unknown")):
        text = format_hub_card(replace(card, licence=given))
        assert head_of(text)["license"] == told
        assert "license_name" not in head_of(text)
