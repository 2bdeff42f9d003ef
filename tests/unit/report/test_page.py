"""The frame: what people name their things is text in it, the same page is the same bytes, and nothing is asked of the network."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

from tcpipe.formats.finding_lines import group_findings
from tcpipe.report.page import Link, PageSection, Shaded, render_page, show_verdict
from tcpipe.report.plots import draw_waterfall, make_plot
from tcpipe.tables.findings import Remedy, Subject, judge, make_finding, read_catalogue

EVIL = "</script><script>alert(1)</script>\x1b[31m\u202e$$x$$ \\(y\\) \"'&"
"""Ends a script, colours a terminal, turns its text round, reads as two formulas, leaves an attribute."""


class Seen(HTMLParser):
    """What a browser makes of a page: its tags with attributes, its text outside scripts, its scripts."""

    def __init__(self, html):
        super().__init__()
        self.tags, self.text, self.scripts, self.inside = [], [], [], ""
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.inside = tag if tag in {"script", "style"} else ""

    def handle_endtag(self, _tag):
        self.inside = ""

    def handle_data(self, data):
        (self.scripts if self.inside == "script" else self.text).append(data)


def drawn():
    plot = make_plot("evil", alt=EVIL, axes=("x", EVIL), legend={EVIL: "#000000"})
    plot.figure.scatter([1.0, 2.0], [3.0, 4.0])
    return [plot, draw_waterfall({"kept": 60.0, "stationary": 40.0})]


evil = make_finding("no-segments", Subject("run", EVIL), names={"reason": EVIL}, driven_m=12.0, lost_m=10.0)


def page():
    return render_page(
        title=EVIL,
        lead=EVIL,
        numbers=[(EVIL, EVIL)],
        warnings=[EVIL],
        verdict=show_verdict(judge([evil]), [evil]),
        links=[Link(EVIL, EVIL), Link("plain", "javascript:alert(1)")],
        sections=[
            PageSection(EVIL, EVIL, header=(EVIL,), rows=[(EVIL,), (Link(EVIL, "a/b"),), (Shaded(EVIL, 2.0),)]),
            PageSection("drawn", plots=drawn()),
        ],
        data={EVIL: [EVIL, 1]},
    )


def block(seen, name):
    position = [attrs.get("id") for tag, attrs in seen.tags if tag == "script"].index(name)
    return json.loads(seen.scripts[position])


def test_a_name_is_text_wherever_it_stands():
    html = page()
    seen = Seen(html)
    assert [attrs.get("id") for tag, attrs in seen.tags if tag == "script"] == ["page-data", "page-figures", None, None]
    assert not [name for _, attrs in seen.tags for name in attrs if name.startswith("on")]
    assert {
        attrs["href"] for tag, attrs in seen.tags if tag == "a" and attrs["href"].startswith("javascript:")
    } == set()
    assert "alert(1)" in "".join(seen.text)
    outside = html.replace(seen.scripts[2], "")
    assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u202a-\u202e\u2060]", outside)
    told = json.dumps([block(seen, "page-data"), block(seen, "page-figures")])
    assert "\\\\x1b[31m\\\\u202e" in told
    assert "\\u001b" not in told
    figures = json.dumps(block(seen, "page-figures"))
    assert "$$" not in figures
    assert "\\\\(" not in figures


def test_the_verdict_has_grades_then_reasons_the_worst_first_then_folded_notes():
    empty = make_finding(
        "no-segments", Subject("run", "a"), names={"reason": "gap"}, driven_m=12.0, lost_m=10.0, action="rejected"
    )
    speeds = {"slow_fraction": 0.7, "limit_mps": 0.95, "top_mps": 0.6}
    keep = Remedy("keep", recipe={"mask": {"require_full_speed": False}})
    slow = make_finding("driven-below-limit", Subject("role", "command"), remedies=[keep], **speeds)
    note = make_finding("no-command", Subject("role", "command"))
    others = [replace(slow, code=code, remedies=()) for code in read_catalogue() if code.startswith("power-")][:8]
    findings = [note, slow, *others, replace(slow, numbers={**slow.numbers, "top_mps": 0.2}), empty]
    html = render_page(title="t", lead="", numbers=[], sections=[], verdict=show_verdict(judge(findings), findings))
    box = "".join(html.split('<section class="verdict')[1:3]).rsplit("</section>", 1)[0]
    assert re.findall('<span class="([a-z-]+)">([a-z]+)', box) == [
        ("not-usable", name) for name in ("position", "time", "energy")
    ]
    at_once = re.sub("<details>.*?</details>", "", box, flags=re.DOTALL)
    assert re.findall('<li class="([a-z]+)">', at_once) == ["error", *["warning"] * 7]
    assert "largest loss: gap, 10 m" in at_once
    assert "Most of the drive was commanded below the robot&#39;s maximum speed" in at_once
    assert "the top command was 0.2 m/s <code>[driven-below-limit]</code>" in at_once  # below the first of this code
    assert "To accept any speed:" in at_once
    assert '<pre tabindex="0">[mask]\nrequire_full_speed = false</pre>' in at_once
    assert re.findall("<summary>(.*?)</summary>", box) == ["2 more findings", "1 note"]


def test_a_remedy_is_the_lines_of_a_recipe_and_without_one_the_catalogue_advises():
    source = {"type": "std_msgs/msg/Float32", "topic": "/current", "current": "data", "rail": "a", "sign": "auto"}
    remedy = Remedy("keep", recipe={"power_sources": [source]})
    subject = Subject("role", "command")
    finding = make_finding("max-velocity-unknown", subject, severity="warning", remedies=[remedy])
    (line,) = show_verdict(judge([finding]), [finding]).shown
    ((purpose, (recipe,)),) = line.remedies
    assert purpose == "To accept any speed"
    assert recipe.startswith('[[power_sources]]\ntype = "std_msgs/msg/Float32"\n')
    lost = make_finding("lost-gap", Subject("run", "a"), severity="warning", lost_m=9.0, lost_fraction=0.2)
    groups = group_findings([("a", [lost, lost]), ("b", [lost])], 2)
    (line,) = show_verdict(judge([]), groups=groups).shown
    assert line.title == read_catalogue()["lost-gap"].title
    assert line.observed[0][0].startswith("2 of 2 runs: ")
    assert line.remedies == [(read_catalogue()["lost-gap"].advice, [])]


def test_parts_without_figures_are_folded_and_long_texts_from_the_second_line():
    plot = make_plot("small", alt="small", axes=("x", "y"))
    plot.figure.line([0.0, 1.0], [0.0, 1.0])
    parts = [PageSection("drawn", plots=[plot]), PageSection("listed", header=("a",), rows=[("cell",)])]
    html = render_page(title="t", lead="", numbers=[], sections=[PageSection("s", "short\nlong", parts=parts)])
    body = html.split('<section id="s1">')[1].split("</section>")[0]
    at_once = re.sub("<details.*?</details>", "", body, flags=re.DOTALL)
    assert "short" in at_once
    assert "drawn" in at_once
    assert "long" in body
    assert "<h3>listed</h3>" in body
    assert "long" not in at_once
    assert "cell" not in at_once


def test_nothing_is_asked_of_the_network_and_bokeh_comes_with_figures_alone():
    html = page()
    assert "default-src 'none'" in html
    assert not [attrs for _, attrs in Seen(html).tags if {"src", "srcset", "data", "action"} & set(attrs)]
    html = render_page(title="t", lead="", numbers=[], warnings=[], sections=[PageSection("s", "text")])
    assert len(html) < 24_000
