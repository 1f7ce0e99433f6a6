"""Pictures of the pages in the browser, by headless Chromium.

    python docs/browser.py explore DIR         # docs/images/explore.png, of the sweep DIR/runs/quickstart
    python docs/browser.py viewer PAGE.html    # docs/images/viewer.png
    python docs/browser.py drive DIR           # docs/images/drive.webp

Chromium draws them in software.
"""

from __future__ import annotations

import io
import itertools
import os
import sys
import threading
from pathlib import Path

from PIL import Image

from nermo_mjx import Setup
from nermo_mjx.live.driving import Driving
from nermo_mjx.live.server import LiveDrive
from nermo_mjx.view.explore import explore

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import chromium

IMAGES = Path(__file__).parent / "images"
#: The run beside the plot: 0.88 Hz, 0.2 rad, phase 0.
ROW = 140
#: What is done at which second of the drive, and the end [s]; a push is a drag over the canvas.
POINTER = """((kind, x, y) => {
    const canvas = document.getElementById("canvas"), {left, top, width, height} = canvas.getBoundingClientRect();
    canvas.setPointerCapture = () => {};
    canvas.dispatchEvent(new PointerEvent(kind, {shiftKey: true, pointerId: 1, bubbles: true,
        clientX: left + x * width, clientY: top + y * height}));
})"""
SCRIPT = {
    1.0: 'viewer.drive.choose("gait", "lateral_walk")',
    1.8: 'viewer.drive.choose("spine", "stride_extension")',
    2.8: 'viewer.drive.set("pilot.turn_rate", 0.8)',
    4.6: f"{POINTER}('pointerdown', 0.67, 0.68), {POINTER}('pointermove', 0.6, 0.7)",
    4.8: f"{POINTER}('pointermove', 0.5, 0.74)",
    4.9: f"{POINTER}('pointerup', 0.5, 0.74)",
    5.3: 'viewer.drive.set("pilot.turn_rate", 0)',
}
END, SLOW = 6.0, 0.25


def opened(tab: chromium.Tab, page: Path | str, width: int = 1280, height: int = 720) -> None:
    tab.open(page, width, height)
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
    tab.evaluate("viewer.player.seek(3.9)")
    while not tab.evaluate("!viewer.stage.stale && viewer.stage.quality.shown === viewer.stage.quality.still"):
        tab.picture()  # draws
    (IMAGES / "viewer.png").write_bytes(tab.picture())


def driven(tab: chromium.Tab, folder: str) -> None:
    """In slow motion, since a picture takes half a second; each stays for as long as the drive took to the next."""
    drive = LiveDrive(Driving(Setup(pilot="open_loop"), {"frequency": 0.9}))
    threading.Thread(target=drive.run, daemon=True).start()
    opened(tab, drive.address, 800, 500)
    tab.wait("viewer.drive.socket.readyState === WebSocket.OPEN")
    tab.evaluate(f"viewer.drive.send({{reset: true, pause: false, speed: {SLOW}}})")
    times, frames, script = list[float](), list[Image.Image](), sorted(SCRIPT.items())
    while not times or times[-1] < END:
        times.append(tab.evaluate("viewer.player.time"))
        while script and script[0][0] <= times[-1]:
            tab.evaluate(script.pop(0)[1])
        frames.append(Image.open(io.BytesIO(tab.picture())).convert("RGB"))
    drive.over = True
    stay = [int(1e3 * (after - now)) for now, after in itertools.pairwise(times)]
    target = IMAGES / "drive.webp"
    frames[0].save(target, save_all=True, append_images=frames[1:-1], duration=stay, loop=0, quality=60)


if __name__ == "__main__":
    with chromium.page() as page:
        {"explore": explored, "viewer": viewed, "drive": driven}[sys.argv[1]](page, sys.argv[2])
