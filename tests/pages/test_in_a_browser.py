"""Pages in Chromium as a person has them: wide and on a phone, by day and by night (``make test-pages``; skipped without its parts)."""

from pathlib import Path
from time import monotonic

import pytest
from browser_page import quiet_page
from synthetic_store import add_run, driven, lanes, open_world, segments

import tcpipe
from tcpipe.learning.evaluation import EvaluateConfig
from tcpipe.learning.evaluation_files import run_evaluation
from tcpipe.learning.fitting import FitConfig
from tcpipe.learning.training import train
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.report import report
from tcpipe.tables.findings import Remedy, Subject, make_finding

DRAWS_DATASET_PAGES = True
axe = pytest.importorskip("axe_core_python.sync_playwright", reason="axe-core-python is not installed: make test-pages")
LOOKS = [(1280, "light"), (1280, "dark"), (400, "light"), (400, "dark")]

PLACE = """([name, x, y]) => {
  const view = page.plots.find((one) => one.model.name === name);
  const box = view.canvas_view.el.getBoundingClientRect();
  const at = (value, scale) => scale.compute(value);
  return [box.left + at(x, view.frame.x_scale), box.top + at(y, view.frame.y_scale)];
}"""
"""Where a point of a plot lies in the window."""

SOURCE = "Bokeh.documents[0].get_model_by_name('samples').data_source"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    here = tmp_path_factory.mktemp("pages")
    store = open_world(here)
    for number, run in enumerate(("north", "south")):
        start, end = lanes((4.0 * number, 4.0 * number + 1.5, 4.0 * number - 9.0), -12.0, 12.0)
        table = segments(run, start, end, start_ns=int((number + 1) * 1e18))
        add_run(store, run, table, findings=[make_finding("no-command", Subject("role", "command"))])
    build_dataset(here / "dataset", store=store.root)
    return here / "dataset"


def until(tab, holds):
    """Ask again until it holds: the page's own policy forbids ``wait_for_function``, which compiles text inside the page."""
    give_up = monotonic() + 60.0
    while not tab.evaluate(holds):
        assert monotonic() < give_up, f"never held: {holds}"
        tab.wait_for_timeout(50)


def by_look(look):
    return f"{look[0]} {look[1]}"


@pytest.fixture(params=LOOKS, ids=by_look)
def opened(request, chromium, dataset):
    with quiet_page(chromium, dataset / "report.html", request.param) as tab:
        yield tab


@pytest.fixture(scope="module")
def evaluation(dataset, tmp_path_factory):
    here = tmp_path_factory.mktemp("evaluated")
    train(dataset, here / "physics", config=FitConfig(model="physics"))
    run_evaluation(here / "physics", dataset, here / "evaluation", config=EvaluateConfig(noise_draws=1))
    return here / "evaluation/evaluation.html"


@pytest.fixture(params=[LOOKS[0], LOOKS[3]], ids=by_look)
def judged(request, chromium, evaluation):
    with quiet_page(chromium, evaluation, request.param) as tab:
        yield tab


def fits_and_can_be_read_by_everyone(tab):
    assert tab.evaluate("document.documentElement.scrollWidth") <= tab.viewport_size["width"]
    found = axe.Axe().run(tab)
    assert "color-contrast" in {of["id"] for of in found["passes"]}
    assert [(of["id"], [node["html"][:120] for node in of["nodes"]][:3]) for of in found["violations"]] == []


def test_it_fits_and_can_be_read_by_everyone(opened):
    fits_and_can_be_read_by_everyone(opened)


SELECTED = f"[...{SOURCE}.selected.indices]"


def click(tab, plot, x, y):
    tab.locator(f"figure:has(#{tab.evaluate(f'page.model({plot!r}).id')})").scroll_into_view_if_needed()
    tab.mouse.click(*tab.evaluate(PLACE, [plot, x, y]))
    tab.wait_for_timeout(400)  # a second click that comes earlier is a double click


def drag(tab, plot, start, end):
    """Drag from one place in a plot to another, given as shares of its frame, from the lower left."""
    tab.locator(f"#{tab.evaluate(f'page.model({plot!r}).id')}").scroll_into_view_if_needed()
    corners = tab.evaluate(
        "(name) => { const { frame } = page.plots.find((one) => one.model.name === name);"
        "return [frame.x_range, frame.y_range].map((range) => [range.start, range.end]); }",
        plot,
    )
    points = [
        [low + share * (high - low) for share, (low, high) in zip(of, corners, strict=True)] for of in (start, end)
    ]
    tab.mouse.move(*tab.evaluate(PLACE, [plot, *points[0]]))
    tab.mouse.down()
    tab.mouse.move(*tab.evaluate(PLACE, [plot, *points[1]]), steps=4)
    tab.mouse.up()


def column(tab, name):
    """A column of the page, by sample."""
    return tab.evaluate(f"page.unpack(page.data.samples.packed).then((c) => Array.from(c[{name!r}]))")


def table_ids(tab):
    return tab.locator("#rows td:first-child").all_inner_texts()


def test_a_click_takes_the_nearest_sample_alone_and_tells_what_it_is(opened):
    xs, ys = column(opened, "x"), column(opened, "y")
    row = min(range(len(xs)), key=lambda i: (abs(ys[i] - max(ys)) > 0.1, abs(xs[i] - min(xs) - 5)))
    click(
        opened, "map", xs[row] + 0.4, ys[row]
    )  # its neighbour is a metre away: less than the width of a point on a phone
    until(opened, f"{SELECTED}.length > 0")
    assert opened.evaluate(SELECTED) == [row]
    assert opened.evaluate("page.model('here').data_source.data.x[0]") == xs[row]
    said = opened.locator("#chosen").inner_text()
    for words in ("±", "tcpipe explain ", "UTC"):
        assert words in said
    assert opened.locator("#chosen .patch").count() == 3
    assert opened.locator("#gallery button").count() == 1
    assert table_ids(opened)[0] in said
    far = max(range(len(xs)), key=lambda i: abs(xs[i] - xs[row]))
    opened.keyboard.down("Shift")
    click(opened, "map", xs[far], ys[far])
    opened.keyboard.up("Shift")
    until(opened, f"{SELECTED}.length === 2")
    assert set(opened.evaluate(SELECTED)) == {row, far}
    assert opened.locator("#gallery button").count() == 2
    data = opened.evaluate(f"(({{ across, up }}) => [across[{row}], up[{row}]])({SOURCE}.data)")
    click(opened, "brush", *data)
    until(opened, f"{SELECTED}.length === 1")
    found = opened.evaluate(SELECTED)[0]
    assert opened.evaluate(f"[{SOURCE}.data.across[{found}], {SOURCE}.data.up[{found}]]") == pytest.approx(
        data, rel=0.02
    )


def test_a_box_and_filters_make_one_selection_that_every_view_shows(opened):
    seen = "Bokeh.documents[0].get_model_by_name('layer classes').visible"
    assert opened.evaluate(seen) is False
    opened.select_option("#ground", "classes")
    assert opened.evaluate(seen) is True
    opened.select_option("#across", "velocity")
    opened.select_option("#colour", "energy")
    every = opened.locator("#gallery button").count()
    drag(opened, "brush", (0.02, 0.05), (0.98, 0.6))
    until(opened, f"{SELECTED}.length > 1")
    boxed = opened.evaluate(SELECTED)
    run, split = column(opened, "run"), column(opened, "split")
    opened.select_option("#run", label="north")
    opened.select_option("#split", label="train")
    both = [i for i in boxed if run[i] == 0 and split[i] == 0]
    assert 1 < len(both) < len(boxed)
    assert opened.evaluate(SELECTED) == both
    assert f"{len(both)} of {len(run)} samples are selected." in opened.locator("#selection-count").inner_text()
    assert f"{len(both)} selected" in opened.locator("#chosen").inner_text()
    assert opened.locator("#gallery button").count() == min(len(both), 24)
    assert all(name.startswith("north-") for name in table_ids(opened))
    assert opened.evaluate("page.model('bars').data_source.data.chosen.reduce((a, b) => a + b)") == len(both)
    opened.locator("#after").click()
    assert opened.evaluate(SELECTED) == both  # it goes through the selection
    assert "Number 2 of them" in opened.locator("#chosen").inner_text()
    opened.select_option("#flag", "0")
    assert opened.evaluate(SELECTED) == [
        i for i, bits in enumerate(column(opened, "quality")) if i in both and not bits
    ]
    opened.locator("#clear").click()
    assert opened.evaluate(SELECTED) == []
    assert opened.locator("#run").input_value() == ""
    assert opened.locator("#gallery button").count() == every
    assert not opened.locator("#selected").is_visible()


@pytest.mark.parametrize("look", [LOOKS[0], LOOKS[3]], ids=by_look)
def test_ids_of_a_selection_open_these_samples(chromium, dataset, tmp_path, look):
    with quiet_page(chromium, dataset / "report.html", look) as tab:
        tab.select_option("#split", label="test")
        fits_and_can_be_read_by_everyone(tab)
        with tab.expect_download() as started:
            tab.locator("#download").click()
        started.value.save_as(tmp_path / "sample_ids.csv")
        tab.locator("#copy-ids").click()
        assert tab.locator("#copy-ids").inner_text() == "Copied"
        tab.evaluate("document.body.prepend(document.createElement('textarea'))")
        tab.locator("textarea").focus()
        tab.keyboard.press("Control+V")
        copied = tab.locator("textarea").input_value().split()
        line = tab.locator("#python").inner_text()
        tab.locator("textarea").evaluate("(area) => area.remove()")
        shown = len(tab.evaluate(SELECTED))
    _, line = line.splitlines()
    chosen = eval(line.replace("sample_ids.csv", f"{tmp_path}/sample_ids.csv"), {"tcpipe": tcpipe})  # noqa: S307  the line itself is tested
    assert chosen.column("sample_id").tolist() == copied
    assert set(chosen.column("split")) == {"test"}
    assert len(copied) == shown


def test_a_selection_is_a_part_of_the_address(chromium, dataset):
    context = chromium.new_context(viewport={"width": 1280, "height": 900})
    tab = context.new_page()
    tab.goto((dataset / "report.html").as_uri())
    tab.wait_for_selector("html[data-ready]")
    tab.select_option("#split", label="test")
    tab.locator("#gallery button").nth(2).click()
    address, chosen = tab.url, tab.evaluate(SELECTED)
    tab.locator("#clear").click()
    assert tab.url == (dataset / "report.html").as_uri()
    again = context.new_page()
    again.goto(address)
    again.wait_for_selector("html[data-ready]")
    assert again.evaluate(SELECTED) == chosen
    assert again.url == address
    context.close()


def test_an_evaluation_is_read_by_everyone_and_names_the_worst(judged):
    fits_and_can_be_read_by_everyone(judged)
    assert "predicted less measured" in judged.content()


@pytest.fixture(params=[LOOKS[0], LOOKS[3]], ids=by_look)
def store_page(request, chromium, dataset):
    """The page of the store, which leads to two runs and the dataset."""
    report(dataset.parent / "store")
    with quiet_page(chromium, dataset.parent / "store/report.html", request.param) as tab:
        yield tab


def test_the_store_s_page_fits_sorts_filters_and_leads_to_runs(store_page):
    fits_and_can_be_read_by_everyone(store_page)
    first = store_page.locator("#s2 td a").first
    assert first.inner_text() == "south"
    store_page.locator("#s2 th button").first.focus()
    store_page.keyboard.press("Enter")
    assert first.inner_text() == "north"
    store_page.fill("#find", "sou")
    assert store_page.locator("#s2 td a").all_inner_texts() == ["south"]
    chosen = "Bokeh.documents[0].get_model_by_name('used').data_source.selected"
    assert store_page.evaluate(f"{chosen}.indices") == [0]
    store_page.click("#clear")
    store_page.evaluate(f"{chosen}.indices = [1]")
    assert store_page.locator("#s2 td a").all_inner_texts() == ["north"]
    assert first.get_attribute("href").endswith("/report.html")


def list_findings():
    """A warning from the twelfth to the fourteenth second, and one with a remedy."""
    step = make_finding(
        "clock-step", Subject("log", "clock"), span_s=(12.0, 14.0), names={"topics": "/imu"}, step_s=2.0, at_s=12.0
    )
    remedy = Remedy("keep", recipe={"mask": {"require_full_speed": False}})
    speeds = {"slow_fraction": 0.7, "limit_mps": 0.95, "top_mps": 0.6}
    return [step, make_finding("driven-below-limit", Subject("role", "command"), remedies=[remedy], **speeds)]


@pytest.fixture(scope="module")
def run_page(tmp_path_factory):
    here = tmp_path_factory.mktemp("driven")
    store = open_world(here)
    start, end = lanes((0.0,), -12.0, 12.0)
    table = segments("driven", start, end, start_ns=10**18)
    add_run(
        store,
        "driven",
        table,
        track=driven(table),
        tags={"site": "<b>\x1b[31m'\"&"},
        findings=list_findings(),
    )
    return Path(report("driven", store=store.root)[0].path)


@pytest.fixture(params=[LOOKS[0], LOOKS[3]], ids=by_look)
def driving(request, chromium, run_page):
    with quiet_page(chromium, run_page, request.param) as tab:
        yield tab


RANGE = "(({ start, end }) => [start, end])(page.model('NAME').x_range)"


def test_one_cursor_runs_through_map_and_plots_of_a_run(driving):
    fits_and_can_be_read_by_everyone(driving)
    assert "5.60 s" in driving.locator("#chosen").inner_text()  # the middle of the first segment
    assert "tcpipe explain driven-1000000000000000000" in driving.locator("#chosen").inner_text()
    driving.locator("figure", has=driving.locator(".plot")).nth(2).scroll_into_view_if_needed()
    driving.mouse.click(*driving.evaluate(PLACE, ["power", 2.0, 150.0]))
    until(driving, "page.model('cursor height').location < 3")
    said = driving.locator("#chosen").inner_text()
    assert "Not used" in said
    assert "it stands" in said
    driving.locator("figure").first.scroll_into_view_if_needed()
    x, y = driving.evaluate("(({ x1, y1 }) => [x1[9], y1[9]])(page.model('segments').data_source.data)")
    driving.mouse.click(*driving.evaluate(PLACE, ["map", x, y]))
    until(driving, "document.getElementById('chosen').innerText.startsWith('Segment 1')")
    assert "±" in driving.locator("#chosen").inner_text()
    assert driving.evaluate("page.model('layer classes').visible") is False
    driving.select_option("#ground", "classes")
    assert driving.evaluate("page.model('layer classes').visible") is True


def test_a_run_is_worked_by_keyboard_and_all_its_plots_zoom_as_one(driving):
    driving.locator("#after").focus()
    driving.keyboard.press("Enter")
    assert "Segment 2 of 24" in driving.locator("#chosen").inner_text()
    driving.locator("#in").focus()
    driving.keyboard.press("Enter")
    zoomed = driving.evaluate(RANGE.replace("NAME", "gates"))
    assert zoomed[1] - zoomed[0] == pytest.approx(0.5 * (5.0 + 24 * 1.2), rel=0.01)
    assert driving.evaluate(RANGE.replace("NAME", "label plot")) == zoomed
    until(driving, f"page.model('line 0').data_source.data.t.every((t) => t > {zoomed[0] - 0.1})")
    driving.select_option("#label", "E")
    assert driving.evaluate("page.model('label plot').left[0].axis_label") == "E [J], ± σ"


MAP_COLOURS = """() => Object.fromEntries(["track", "segments", "findings"].map((name) => {
  const { colour } = page.model(name).data_source.data;
  return [name, [colour.length, [...new Set(colour)].sort()]];
}))"""
"""How many lines of the map there are, and their colours."""


def test_the_map_of_a_run_is_coloured_by_what_is_chosen(driving):
    use = driving.evaluate(MAP_COLOURS)
    seen = {}
    for key in ("severity", "sigma", "v", "w", "E"):
        driving.select_option("#colour", key)
        seen[key] = driving.evaluate(MAP_COLOURS)
    assert use["segments"][0] == 24
    assert len(seen["severity"]["segments"][1]) == 2  # the spans of one finding lie over some segments, not over others
    for key, unit in (("sigma", "m"), ("v", "m/s"), ("w", "W")):
        assert seen[key]["segments"][0] == 0  # the whole track has the colour, standing robots too
        assert seen[key]["track"][0] > use["track"][0]
        driving.select_option("#colour", key)
        assert f"\u00a0{unit}" in driving.locator("#scale").inner_text()
    assert len(seen["w"]["track"][1]) >= 2
    assert len(seen["E"]["segments"][1]) > 2
    assert driving.evaluate("page.fixed(-0.04, 1)") == "0.0"


def test_a_finding_of_a_run_is_shown_on_map_and_time_axis_and_its_remedy_is_copied(driving):
    assert driving.evaluate(MAP_COLOURS)["findings"][0] > 0
    assert "clock-step" in driving.evaluate("page.model('gates').y_range.factors")
    driving.locator(".show").focus()
    driving.keyboard.press("Enter")
    start, end = driving.evaluate(RANGE.replace("NAME", "gates"))
    assert start == pytest.approx(10.0)
    assert end == pytest.approx(16.0)
    assert driving.evaluate("page.model('cursor gates').location") == pytest.approx(12.0)
    driving.context.grant_permissions(["clipboard-read", "clipboard-write"])
    driving.locator(".copy").focus()
    driving.keyboard.press("Enter")
    until(driving, "document.querySelector('.copy').textContent === 'Copied'")
    assert driving.evaluate("navigator.clipboard.readText()") == "[mask]\nrequire_full_speed = false"


def find_page(kind, request, dataset):
    if kind == "store":
        report(dataset.parent / "store")
    return {
        "run": lambda: request.getfixturevalue("run_page"),
        "dataset": lambda: dataset / "report.html",
        "evaluation": lambda: request.getfixturevalue("evaluation"),
        "store": lambda: dataset.parent / "store/report.html",
    }[kind]()


FIRST_PLOT = """() => {
  const boxes = [...document.querySelectorAll(".plot")].map((one) => one.getBoundingClientRect());
  const { top, height } = boxes.sort((a, b) => a.top - b.top)[0];
  return [top, (innerHeight - top) / height];
}"""


def test_a_value_has_as_many_decimals_as_its_uncertainty(chromium, dataset):
    with quiet_page(chromium, dataset / "report.html", LOOKS[0]) as tab:
        for call, text in {
            "190.84, 'W', 1, 6.51": "190.8 ± 6.5\u00a0W",
            "190.84, 'W', 1, 23.4": "191 ± 23\u00a0W",
            "0.75529, 'm/s', 4, 0.0274": "0.755 ± 0.027\u00a0m/s",
            "0.75529, 'm/s', 4, 0.00027": "0.7553 ± 0.00027\u00a0m/s",
            "-0.04, '°', 1": "0.0°",
            "-0.004, '°', 2, 0.31": "0.00 ± 0.31°",
            "NaN, 'J', 1, 2": "none",
        }.items():
            assert tab.evaluate(f"page.quantity({call})") == text


@pytest.mark.parametrize("kind", ["run", "dataset", "evaluation", "store"])
def test_the_verdict_and_a_plot_stand_on_the_first_screen(request, chromium, dataset, kind):
    with quiet_page(chromium, find_page(kind, request, dataset), (1400, "light")) as tab:
        top, share = tab.evaluate(FIRST_PLOT)
        assert 0 < top < 300
        assert share >= 0.6
        grades = tab.locator(".verdict .grades").bounding_box()
        assert grades["y"] + grades["height"] < 300
        assert tab.locator("main h2").count() <= 8


ON_PAPER = """() => matchMedia("print").addEventListener("change", () => {
  const every = (selector) => [...document.querySelectorAll(selector)].filter((one) => one.checkVisibility());
  const missing = every("figure").filter((figure) => {
    const room = figure.querySelector(".plot");
    if (!room) return false;
    const live = page.plots.find((one) => one.model.id === room.id)?.canvas_view.primary.canvas;
    const drawn = figure.querySelector(":scope > canvas") ?? live;
    if (!drawn?.checkVisibility()) return true;
    const { data } = drawn.getContext("2d").getImageData(0, 0, drawn.width, drawn.height);
    let dark = 0;  // pixels of axes and their texts, which are dark on paper
    for (let i = 0; i < data.length; i += 4) dark += data[i + 3] > 200 && Math.max(data[i], data[i + 1], data[i + 2]) < 100;
    return dark < 100;
  });
  const colours = every(".legend i, .ramp, .patch"), wide = document.documentElement.clientWidth;
  window.onPaper = {
    missing: missing.map((figure) => figure.ariaLabel),
    pale: colours.filter((one) => getComputedStyle(one).printColorAdjust !== "exact").length,
    swatches: every(".legend i, .ramp").length,
    patches: every(".patch").filter((one) => getComputedStyle(one).backgroundImage.includes("blob:")).length,
    beyond: every("table, figure, figure > canvas").filter((one) => one.getBoundingClientRect().right > wide + 1).length,
    torn: every("figure, tr, .gallery button").filter((one) => getComputedStyle(one).breakInside !== "avoid").length,
    folded: [...document.querySelectorAll("details > *")].filter((one) => !one.offsetHeight).length,
  };
}, { once: true })"""
"""What stands on paper when the browser has laid it out."""


@pytest.mark.parametrize("look", [LOOKS[0], LOOKS[3]], ids=by_look)
@pytest.mark.parametrize("kind", ["run", "dataset", "evaluation", "store"])
def test_a_page_prints_whole_as_soon_as_it_answers(request, chromium, dataset, kind, look):
    path = find_page(kind, request, dataset)
    with quiet_page(chromium, path, look) as tab:
        tab.evaluate(ON_PAPER)
        tab.pdf()
        seen = tab.evaluate("onPaper")
        patches, swatches = seen.pop("patches"), seen.pop("swatches")
        assert seen == {"missing": [], "pale": 0, "beyond": 0, "torn": 0, "folded": 0}
        assert swatches > 0
        assert (patches > 0) == (kind == "dataset")
        until(tab, "document.documentElement.dataset.whole === 'yes'")
        assert tab.locator("figure > canvas").count() == 0
