"""Pages in Chromium as a person has them: wide and on a phone, by day and by night (``make test-pages``; skipped without its parts)."""

import shutil

import pytest
from synthetic_store import add_run, add_world, lanes, segments

from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.store import open_store

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: make test-pages")
axe = pytest.importorskip("axe_core_python.sync_playwright", reason="axe-core-python is not installed: make test-pages")
CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed: apt-get install chromium")

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
    store = open_store(here / "store", create=True)
    add_world(store, here)
    for number, run in enumerate(("north", "south")):
        start, end = lanes((4.0 * number,), -12.0, 12.0)
        add_run(store, run, segments(run, start, end, start_ns=int((number + 1) * 1e18)))
    build_dataset(here / "dataset", store=store.root)
    return here / "dataset"


@pytest.fixture(scope="module")
def chromium():
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(params=LOOKS, ids=lambda look: f"{look[0]} {look[1]}")
def opened(request, chromium, dataset):
    """The dataset's page, drawn; at the end it must have asked for nothing and complained of nothing."""
    width, scheme = request.param
    context = chromium.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    tab, complaints, asked = context.new_page(), [], []
    tab.on("console", lambda said: complaints.append(said.text) if said.type in {"error", "warning"} else None)
    tab.on("pageerror", lambda error: complaints.append(str(error)))
    tab.on("request", lambda sent: asked.append(sent.url) if not sent.url.startswith(("data:", "blob:")) else None)
    url = (dataset / "report.html").as_uri()
    tab.goto(url)
    tab.wait_for_selector("html[data-ready]")
    yield tab
    assert complaints == []
    assert asked == [url]
    context.close()


def test_it_fits_and_can_be_read_by_everyone(opened):
    assert opened.evaluate("document.documentElement.scrollWidth") <= opened.viewport_size["width"]
    found = axe.Axe().run(opened)["violations"]
    assert [(of["id"], [node["html"][:120] for node in of["nodes"]][:3]) for of in found] == []


def test_a_metre_that_is_clicked_tells_its_label_and_shows_its_patch(opened):
    x, y = opened.evaluate(f"(() => {{ const data = {SOURCE}.data; return [data.x[7], data.y[7]]; }})()")
    opened.locator("#s1 figure").first.scroll_into_view_if_needed()
    opened.mouse.click(*opened.evaluate(PLACE, ["map", x, y]))
    opened.wait_for_function(f"{SOURCE}.selected.indices.length > 0")
    said = opened.locator("#chosen").inner_text()
    assert "±" in said
    assert "tcpipe explain '" in said
    assert "UTC" in said
    assert opened.locator("#chosen .patch").count() == 3


def test_layers_switch_and_a_box_in_the_plot_chooses_on_the_map(opened):
    seen = "Bokeh.documents[0].get_model_by_name('layer classes').visible"
    assert opened.evaluate(seen) is False
    opened.select_option("#ground", "classes")
    assert opened.evaluate(seen) is True
    opened.select_option("#across", "velocity")
    opened.select_option("#colour", "energy")
    figure = opened.locator("#s1 figure").nth(1)
    figure.scroll_into_view_if_needed()
    box = figure.bounding_box()
    opened.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.2 * box["height"])
    opened.mouse.down()
    opened.mouse.move(box["x"] + 0.95 * box["width"], box["y"] + 0.8 * box["height"], steps=4)
    opened.mouse.up()
    opened.wait_for_function(f"{SOURCE}.selected.indices.length > 1")
    assert " chosen" in opened.locator("#chosen").inner_text()


def test_the_gallery_filters_and_leads_to_the_sample(opened):
    every = opened.locator("#gallery button").count()
    opened.select_option("#gallery-split", "test")
    shown = opened.locator("#gallery button")
    assert 0 < shown.count() < every
    assert all("test" in text for text in shown.all_inner_texts())
    shown.first.click()
    assert opened.locator("#chosen dd", has_text="test").count() >= 1


def test_it_is_worked_by_keyboard_and_can_be_printed(opened):
    opened.locator("#after").focus()
    opened.keyboard.press("Enter")
    opened.keyboard.press("Enter")
    assert opened.evaluate(f"{SOURCE}.selected.indices") == [1]
    opened.keyboard.press("Shift+Tab")
    assert opened.evaluate("document.activeElement.id") == "row"
    assert len(opened.pdf()) > 20_000
