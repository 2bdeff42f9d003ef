"""Write docs/images/ from the demo: one metre, a plan, and a tour of its pages in Chromium (`make pictures`)."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from metre import draw_metre
from PIL import Image
from plan_picture import draw_plans
from playwright.sync_api import sync_playwright
from tour import SCREEN_PX, record_tour

from tcpipe.learning.models import load_model
from tcpipe.planning.cost_grid import make_survey
from tcpipe.planning.path_files import choose_map
from tcpipe.planning.plan import OBJECTIVES, plan_path

IMAGES = Path(__file__).parent / "images"
_START, _GOAL = np.array([17.5993534, 47.0000495]), np.array([17.6000909, 47.0000675])
"""On both sides of the demo's hill."""
_PLAN_PX = (1600, 1000)


def main() -> None:
    """Run the demo, open its pages and write the pictures."""
    here = Path(tempfile.gettempdir(), "robot")  # the pages show this path
    here.mkdir()
    try:
        run(here, "demo", "demo", "--quiet")
        draw_metre(here / "demo", IMAGES / "metre.png")
        run(here, "train", "demo/dataset", "model", "--model", "physics")
        model, source = load_model(here / "model"), choose_map(here / "demo/store", None)
        survey = make_survey(model, source, 1.0)
        plans = [plan_path(survey, _START, _GOAL, objective, allow_extrapolation=True) for objective in OBJECTIVES]
        least_energy, _, shortest = (plan.totals for plan in plans)
        sys.stdout.write(
            f"the shortest path needs {shortest.energy_joule / least_energy.energy_joule - 1:.1%} more energy than that of "
            f"least energy, which is {least_energy.length_m / shortest.length_m - 1:.1%} longer\n"
        )
        draw_plans(here / "plan.png", source, plans)
        plan = Image.open(here / "plan.png").convert("RGB")
        plan.thumbnail(_PLAN_PX)
        plan.save(IMAGES / "plan.jpg", quality=85)
        with sync_playwright() as started:
            browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
            tab = browser.new_page(viewport=SCREEN_PX, color_scheme="light")
            record_tour(tab, here / "demo", here / "plan.png", IMAGES / "tour.webp")
    finally:
        shutil.rmtree(here)
    sys.stdout.write(f"wrote {', '.join(path.name for path in sorted(IMAGES.iterdir()))} to {IMAGES}\n")


def run(here: Path, *arguments: str) -> None:
    """Run a command of tcpipe."""
    subprocess.run([sys.executable, "-m", "tcpipe", *arguments], cwd=here, check=True)


if __name__ == "__main__":
    main()
