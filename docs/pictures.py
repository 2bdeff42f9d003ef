"""Write docs/images/ from the demo: the dataset's page in Chromium, and a plan (`make pictures`)."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from io import BytesIO
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

IMAGES = Path(__file__).parent / "images"
_SCREEN_PX = {"width": 1400, "height": 900}
_SAMPLE = "{source}.selected.indices = [{source}.length >> 1]".format(
    source="Bokeh.documents[0].get_model_by_name('samples').data_source"
)
"""A click on the sample in the middle of the table."""
_START, _GOAL = "17.5993534,47.0000495", "17.6000909,47.0000675"
"""On both sides of the demo's hill."""
_PLAN_PX = (1600, 1000)


def main() -> None:
    """Run the demo in a temporary directory, open its pages and write the pictures."""
    with tempfile.TemporaryDirectory() as place:
        here = Path(place)
        run(here, "demo", "demo", "--quiet")
        run(here, "train", "demo/dataset", "model", "--model", "physics")
        ends = ("--from", _START, "--to", _GOAL, "--store", "demo/store", "--allow-extrapolation")
        run(here, "plan-path", "model", *ends, "--picture", "plan.png")
        plan = Image.open(here / "plan.png").convert("RGB")
        plan.thumbnail(_PLAN_PX)
        plan.save(IMAGES / "plan.jpg", quality=85)
        picture = Image.open(BytesIO(photograph(here / "demo/dataset/report.html")))
        picture.convert("P", palette=Image.Palette.ADAPTIVE, colors=256).save(IMAGES / "report.png", optimize=True)
    sys.stdout.write(f"wrote {', '.join(path.name for path in sorted(IMAGES.iterdir()))} to {IMAGES}\n")


def run(here: Path, *arguments: str) -> None:
    """Run a command of tcpipe."""
    subprocess.run([sys.executable, "-m", "tcpipe", *arguments], cwd=here, check=True)


def photograph(page: Path) -> bytes:
    """Return the first screen of a dataset's page with one sample selected, as PNG."""
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        tab = browser.new_page(viewport=_SCREEN_PX, color_scheme="light")
        tab.goto(page.as_uri())
        tab.wait_for_selector("html[data-ready]")
        tab.evaluate(_SAMPLE)
        tab.wait_for_timeout(2000)  # until its patch is drawn
        return tab.screenshot()


if __name__ == "__main__":
    main()
