"""Pictures of the pages in the browser, by headless Chromium.

    python docs/browser.py explore DIR         # docs/images/explore.png, of the sweep DIR/runs/quickstart
    python docs/browser.py viewer PAGE.html    # docs/images/viewer.png

Chromium draws them in software.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from nermo_mjx.view.explore import explore

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import chromium

IMAGES = Path(__file__).parent / "images"
#: The run beside the plot: 0.88 Hz, 0.2 rad, phase 0.
ROW = 140


def opened(tab: chromium.Tab, page: Path) -> None:
    tab.open(page, 1280, 720)
    tab.wait(chromium.READY)


def explored(tab: chromium.Tab, folder: str) -> None:
    os.chdir(folder)  # the page shows the path of its directory
    opened(tab, explore("runs/quickstart").save("explore.html"))
    x, y = tab.evaluate(f"(({{x, y}}) => [x, y])(explorer.chart.itemOf(explorer.table.placeOf.get({ROW})))")
    box = tab.box("#marks")
    for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
        tab.mouse(kind, box["left"] + x, box["top"] + y)
    tab.mouse("mouseMoved", 1, 1)  # away from the cell and its hint
    (IMAGES / "explore.png").write_bytes(tab.picture())


def viewed(tab: chromium.Tab, page: str) -> None:
    opened(tab, Path(page))
    tab.evaluate("viewer.player.toggle(false), viewer.player.seek(3.9)")
    tab.wait("!viewer.stage.stale && viewer.stage.quality.shown === viewer.stage.quality.still")
    (IMAGES / "viewer.png").write_bytes(tab.picture())


if __name__ == "__main__":
    with chromium.page() as page:
        {"explore": explored, "viewer": viewed}[sys.argv[1]](page, sys.argv[2])
