"""The recorded tour of the demo's pages: what one does on them, with a pointer, and a caption above the page (`make pictures`)."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont

SCREEN_PX = {"width": 1200, "height": 740}
_CAPTION_PX = 52
_INK, _PAPER = "#14191e", "#ffffff"
_ARROW = ((0, 0), (0, 22), (5, 17), (9, 26), (13, 24), (9, 16), (16, 16))
"""Outline of the pointer [px]."""
_STEPS = 6
"""Frames of a movement of the pointer."""
_PLACE = """([name, x, y]) => {
  const view = page.plots.find((one) => one.model.name === name), box = view.canvas_view.el.getBoundingClientRect();
  return [box.left + view.frame.x_scale.compute(x), box.top + view.frame.y_scale.compute(y)];
}"""
"""Position of a point of a plot in the window [px]."""


class Recorder:
    """Frames of a tab, each with its duration; what changes nothing makes the last frame longer."""

    def __init__(self, tab: Any) -> None:
        self.tab, self.caption = tab, ""
        self.x, self.y = 700.0, 640.0
        self.frames: list[Image.Image] = []
        self.durations_ms: list[int] = []

    def open(self, page: Path, caption: str) -> None:
        """Open a page, and wait until it is drawn."""
        self.tab.goto(page.as_uri())
        self.settle(caption)

    def settle(self, caption: str) -> None:
        """Wait until the page is drawn, under another caption."""
        self.tab.wait_for_selector("html[data-whole], img")
        self.tab.wait_for_timeout(1500)
        self.caption = caption

    def hold(self, duration_ms: int, *, presses: bool = False) -> None:
        """Record what the tab shows for a while; ``presses`` is whether the mouse is down."""
        frame = Image.new("RGB", (SCREEN_PX["width"], SCREEN_PX["height"] + _CAPTION_PX), _INK)
        frame.paste(Image.open(BytesIO(self.tab.screenshot())), (0, _CAPTION_PX))
        pen = ImageDraw.Draw(frame)
        pen.text((20, _CAPTION_PX // 2), self.caption, fill=_PAPER, font=ImageFont.load_default(25), anchor="lm")
        frame.paste(*_draw_pointer(frame, self.x, self.y + _CAPTION_PX, presses=presses))
        if self.frames and frame == self.frames[-1]:
            self.durations_ms[-1] += duration_ms
        else:
            self.frames.append(frame)
            self.durations_ms.append(duration_ms)

    def move(self, x: float, y: float, *, presses: bool = False) -> None:
        """Move the mouse to a place in the window."""
        start_x, start_y = self.x, self.y
        for step in range(1, _STEPS + 1):
            share = step / _STEPS
            share = share * share * (3.0 - 2.0 * share)  # slow at both ends
            self.x, self.y = start_x + share * (x - start_x), start_y + share * (y - start_y)
            self.tab.mouse.move(self.x, self.y)
            self.tab.wait_for_timeout(100)
            self.hold(60, presses=presses)

    def click(self, place: Any) -> None:
        """Click on the middle of an element, or on a place in the window."""
        self.move(*(place if isinstance(place, tuple) else _find_middle(place)))
        self.hold(200, presses=True)
        self.tab.mouse.click(self.x, self.y)  # at once: a picture takes so long that it would be a long press
        self.tab.wait_for_timeout(800)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Draw a box."""
        self.move(*start)
        self.tab.mouse.down()
        self.move(*end, presses=True)
        self.tab.mouse.up()
        self.tab.wait_for_timeout(800)

    def choose(self, name: str, option: str) -> None:
        """Choose an option of a list: the browser does not draw the open list into pictures."""
        self.move(*_find_middle(self.tab.locator(name)))
        self.hold(300, presses=True)
        self.tab.select_option(name, label=option)
        self.tab.wait_for_timeout(800)

    def scroll(self, name: str) -> None:
        """Scroll until an element is at the top of the window."""
        top = self.tab.locator(name).bounding_box()["y"] - 10.0
        for share in (0.2, 0.6, 0.2):
            self.tab.mouse.wheel(0, round(share * top))
            self.tab.wait_for_timeout(300)
            self.hold(90)

    def find_place(self, plot: str, x: float, y: float) -> tuple[float, float]:
        """Return the position of a point of a plot in the window [px]."""
        return tuple(self.tab.evaluate(_PLACE, [plot, x, y]))

    def save(self, path: Path) -> None:
        """Write the frames as an animated WebP that repeats."""
        self.frames[0].save(
            path,
            save_all=True,
            append_images=self.frames[1:],
            duration=self.durations_ms,
            loop=0,
            quality=90,
            method=6,
            allow_mixed=True,
            minimize_size=True,
        )


def _find_middle(element: Any) -> tuple[float, float]:
    box = element.bounding_box()
    across, down = min(0.5 * box["width"], 60.0), min(0.5 * box["height"], 12.0)  # a link may have two lines
    return box["x"] + across, box["y"] + down


def _draw_pointer(frame: Image.Image, x: float, y: float, *, presses: bool) -> tuple[Image.Image, tuple[int, int]]:
    """Return the pointer over the part of the frame where it is, and the part's corner."""
    side, scale = 64, 4
    corner = round(x) - side // 2, round(y) - side // 2
    part = frame.crop((*corner, corner[0] + side, corner[1] + side)).resize((side * scale, side * scale))
    pen, middle = ImageDraw.Draw(part), side * scale // 2
    if presses:
        pen.circle((middle, middle), 18 * scale, outline="#ffb000", width=3 * scale)
    outline = [(middle + scale * across, middle + scale * down) for across, down in _ARROW]
    pen.polygon(outline, fill="#000000", outline="#ffffff", width=2 * scale)
    return part.resize((side, side), Image.Resampling.LANCZOS), corner


_MOST_POWER = """page.unpack(page.data.samples.packed).then(({ x, y, power }) => {
  const i = power.indexOf(Math.max(...power));
  return [x[i], y[i]];
})"""
"""Where the sample of most power lies on the map."""


def record_tour(tab: Any, demo: Path, plan: Path, path: Path) -> None:
    """Write the tour of the demo's pages and of the picture of a plan."""
    tour = Recorder(tab)
    tour.open(demo / "store/report.html", "All runs in one store: are they usable, and what changes over time?")
    tour.hold(2000)
    tour.scroll("#s2")
    tour.click(tab.locator("#s2 td a").last)
    tour.settle("A run: where the robot drove, which metres are used, and why others are not")
    tour.hold(2000)
    metre = tab.evaluate("(({ x1, y1 }) => [x1[60], y1[60]])(page.model('segments').data_source.data)")
    tour.caption = "Colour the track by power, and click a metre: its labels and their uncertainty"
    tour.choose("#colour", "power w")
    tour.hold(1200)
    tour.click(tour.find_place("map", *metre))
    tour.hold(1800)
    tour.open(demo / "dataset/report.html", "A dataset: what is wrong with it, and the remedy as lines to copy")
    tour.hold(1600)
    tour.click(tab.locator(".verdict .copy").first)
    tour.hold(800)
    tour.caption = "Click a sample: its labels, its patches of the map, and the log it comes from"
    tour.scroll("#scale")
    tour.click(tour.find_place("map", *tab.evaluate(_MOST_POWER)))
    tab.wait_for_selector("#chosen .patch")
    tour.hold(2400)
    tour.caption = "Draw a box: one selection on the map, in all plots and in words"
    tour.drag(tour.find_place("brush", 4.0, 340.0), tour.find_place("brush", 15.0, 190.0))
    tour.hold(2000)
    tour.caption = "Its patches, and the line of Python that opens these samples"
    tour.scroll("#s2")
    tour.hold(1000)
    tour.click(tab.locator("#selected .copy").first)
    tour.hold(1400)
    tour.open(plan, "Train a model, and plan the paths of least energy, time and distance")
    tab.evaluate("document.body.style.background = 'white'")
    tour.hold(2500)
    tour.save(path)
