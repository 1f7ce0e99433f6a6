"""Pictures of the pages in the browser, by headless Chromium.

    python docs/browser.py explore DIR    # DIR/explore.png, of the sweep DIR/runs/quickstart
    python docs/browser.py viewer DIR     # DIR/viewer.png, of the page DIR/walk.html
    python docs/browser.py drive DIR      # docs/images/drive.webp; needs an idle machine

Chromium draws them in software.
"""

from __future__ import annotations

import io
import itertools
import os
import sys
import threading
import time
from pathlib import Path

from PIL import Image

from nermo_mjx import Setup
from nermo_mjx.live.driving import Driving
from nermo_mjx.live.server import LiveDrive
from nermo_mjx.view.explore import explore

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import chromium
import pictures

FILM = Path(__file__).parent / "images" / "drive.webp"
#: The run beside the plot: 0.88 Hz, 0.2 rad, phase 0.
ROW = 140
#: What is done while the robot is driven: simulated time [s], and what the page then says to the drive.
DEEDS = (
    (0.8, '{"gait": "lateral_walk"}'),
    (2.2, '{"spine": "stride_extension"}'),
    (3.8, '{"set": {"pilot.turn_rate": 0.8}}'),
    (5.2, '{"set": {"pilot.turn_rate": 0}}'),
)
#: Length of the film [simulated s], and its pictures a simulated second, at most. It is shown in real time.
LENGTH, RATE = 6.8, 6.0


def opened(tab: chromium.Tab, page: Path) -> None:
    tab.open(page, 1280, 720)
    tab.wait(chromium.READY)


def explored(tab: chromium.Tab, folder: str) -> None:
    os.chdir(folder)  # the page shows the path of its directory
    opened(tab, explore("runs/quickstart").save("explore.html"))
    x, y = tab.evaluate(
        f"(({{x, y}}) => [x, y])(explorer.chart.itemOf(explorer.table.placeOf.get({ROW})))"
    )
    box = tab.box("#marks")
    for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
        tab.mouse(kind, box["left"] + x, box["top"] + y)
    tab.mouse("mouseMoved", 1, 1)  # away from the cell and its hint
    Path("explore.png").write_bytes(tab.picture())


def viewed(tab: chromium.Tab, folder: str) -> None:
    opened(tab, Path(folder) / "walk.html")
    tab.evaluate("viewer.player.toggle(false), viewer.player.seek(3.9)")
    tab.wait("!viewer.stage.stale && viewer.stage.quality.shown === viewer.stage.quality.still")
    (Path(folder) / "viewer.png").write_bytes(tab.picture())


def driven(tab: chromium.Tab, folder: str) -> None:
    record = Path(folder) / f"drive-{time.time_ns()}.npz"
    drive = LiveDrive(Driving(Setup(pilot="open_loop"), {"frequency": 0.8}), record)
    thread = threading.Thread(target=drive.run)
    thread.start()
    try:
        tab.open(drive.address, 1000, 625, scale=0.8)
        tab.wait(chromium.READY)
        tab.wait("viewer.drive.socket.readyState === WebSocket.OPEN")
        # Time is so slow that every picture can be as good as a still.
        tab.evaluate(
            "Object.defineProperty(viewer.stage.quality, 'wanted', {get() { return this.still; }}), 1"
        )
        tab.evaluate("viewer.drive.send({reset: true, pause: false, speed: 0.1})")
        tab.wait("viewer.drive.state.paused === false && viewer.player.time < 0.3")
        deeds, times, shown = list(DEEDS), [], []
        while (now := tab.evaluate("viewer.player.time")) < LENGTH:
            if deeds and now >= deeds[0][0]:
                tab.evaluate(f"viewer.drive.send({deeds.pop(0)[1]})")
            if not times or now >= times[-1] + 1.0 / RATE:
                times.append(now)
                shown.append(Image.open(io.BytesIO(tab.picture())).convert("RGB"))
    finally:
        drive.over = True
        thread.join(30)
    waits = [1000 * (after - before) for before, after in itertools.pairwise([*times, LENGTH])]
    # The floor of the page has few traces, so that a lower quality is enough.
    pictures.write_film(shown, waits, FILM, width=640, quality=55)


if __name__ == "__main__":
    with chromium.page() as page:
        {"explore": explored, "viewer": viewed, "drive": driven}[sys.argv[1]](page, sys.argv[2])
