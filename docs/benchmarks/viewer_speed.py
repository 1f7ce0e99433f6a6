"""How fast the pages are in headless Chromium, for docs/benchmarks/viewer.md, as JSON; on an idle machine.

    python docs/benchmarks/viewer_speed.py DIR   # of DIR/free.npz and DIR/stiff.npz; pages are made beside them

Of a recording's page: the time until it is ready, until it is stopped and drawn as a still, and the frames a second
while it plays. Of a directory's page: the time until it is ready and until it is seen, until another choice is drawn,
and until a recording plays. Medians of three, each in a new browser. Of a drive: how far the picture is behind.
"""

from __future__ import annotations

import json
import shutil
import sys
import threading
import time
from pathlib import Path

import pandas as pd

from nermo_mjx import Setup
from nermo_mjx.live.driving import Driving
from nermo_mjx.live.server import LiveDrive
from nermo_mjx.recording import Recording
from nermo_mjx.sweep import read_table
from nermo_mjx.view import show
from nermo_mjx.view.explore import MAX_RECORDINGS, explore

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
import chromium
from fakes.explore_data import many

SECONDS = 6.0
COUNT = """new Promise((done) => {
    viewer.player.toggle(true);
    const begin = performance.now();
    let [half, drawn] = [null, 0];
    const tick = (now) => {
        if (now - begin >= SECONDS * 500 && half === null) [half, drawn] = [now, viewer.stage.frames];
        if (now - begin < SECONDS * 1000) requestAnimationFrame(tick);
        else done([[begin, 0], [half, drawn]].map(([t, n]) => (1000 * (viewer.stage.frames - n)) / (now - t)));
    };
    viewer.stage.frames = 0;
    requestAnimationFrame(tick);
})""".replace("SECONDS", str(SECONDS))


#: Browsers draw when somebody looks.
FLUSH = "explorer.chart.points.getContext('2d').getImageData(0, 0, 1, 1)"


def measure(browser: chromium.Browser, page: Path, width: int, height: int) -> dict[str, float]:
    """Seconds until ready and until a finished still; frames a second over all the time and over its second half."""
    with browser.tab() as tab:
        begin = time.monotonic()
        tab.open(page, width, height)
        tab.wait("document.documentElement?.dataset.ready === 'yes'")
        ready = time.monotonic() - begin
        if tab.evaluate("'explorer' in window"):
            return {"ready_s": round(ready, 2)} | explored(tab, begin)
        tab.evaluate("viewer.player.toggle(false)")
        tab.wait("!viewer.stage.stale && viewer.stage.quality.shown === viewer.stage.quality.still")
        tab.picture()
        still = time.monotonic() - begin
        whole, later = tab.evaluate(COUNT)
        level = tab.evaluate("viewer.stage.quality.level")
        assert tab.complaints() == []
        figures = {"ready_s": ready, "still_s": still, "frames_per_s": whole, "second_half": later}
        return {key: round(value, 2) for key, value in figures.items()} | {"level": level}


def explored(tab: chromium.Tab, begin: float) -> dict[str, float]:
    """Seconds until a directory's page is seen; milliseconds that points and a brush take; seconds until it plays."""
    tab.picture()
    figures = {"seen_s": time.monotonic() - begin}
    for name, act in (
        ("points_ms", "explorer.chart.draw()"),
        ("brush_ms", "explorer.brush([0.2, 0.7, 0.2, 0.8])"),
    ):
        script = f"(() => {{ const begin = performance.now(); {act}; {FLUSH}; return performance.now() - begin; }})()"
        tab.evaluate("explorer.view.cells = false, explorer.show()")
        figures[name] = tab.evaluate(script)
    begin = time.monotonic()
    if tab.evaluate("explorer.recorded.size"):
        tab.evaluate("explorer.filters.release(), explorer.play([...explorer.recorded][0])")
        tab.wait(
            "document.querySelector('#theatre iframe')?.contentWindow.viewer?.stage.frames > 0"
        )
        figures["plays_s"] = time.monotonic() - begin
    assert tab.complaints() == []
    return {key: round(value, 2) for key, value in figures.items()}


def medians(page: Path, width: int = 1280, height: int = 720) -> pd.Series:
    rows = []
    for _ in range(3):
        with chromium.browser(chromium.require()) as browser:
            rows.append(measure(browser, page, width, height))
    return pd.DataFrame(rows).median(numeric_only=True)


def of_recordings(out: Path) -> dict[str, str]:
    free, stiff = (Recording.load(out / f"{name}.npz") for name in ("free", "stiff"))
    pages = {
        "one recording": show(free).save(out / "one.html"),
        "two in comparison": show(free, stiff).save(out / "two.html"),
    }
    lines, ready = (
        ["| page | window | ready | final still | frames/s |", "|---|---|---|---|---|"],
        list[str](),
    )
    for name, page in pages.items():
        told = f"{name}, {page.stat().st_size / 1e6:.1f} MB"
        for width, height in ((1280, 720), (640, 360)):
            found = medians(page, width, height)
            cells = f"{found.ready_s:.1f} s | {found.still_s:.1f} s | {found.frames_per_s:.0f}"
            lines.append(f"| {told} | {width} x {height} | {cells} |")
            ready.append(f"{found.ready_s:.1f}")
    table = {"viewer.recordings": "\n".join(lines), "viewer.recording_ready": ready[0]}
    return table | {"viewer.samples": f"{len(free.time):,}"}


def of_a_directory(out: Path) -> dict[str, str]:
    shutil.rmtree(out / "many", ignore_errors=True)
    folder = many(out / "many", 10_000)
    (folder / "recordings").mkdir()
    walk = Recording.load(out / "free.npz").between(0.0, 10.0).save(out / "walk.npz")
    for k in range(MAX_RECORDINGS):
        shutil.copy(walk, folder / "recordings" / f"row-{200 * k:06d}.npz")
    page, table = explore(folder).save(out / "many.html"), read_table(folder)
    found = medians(page)
    rows = [
        ("what", "after"),
        ("---", "---"),
        ("the page accepts input", f"{found.ready_s:.1f} s"),
        ("it is visible", f"{found.seen_s:.1f} s"),
        ("another choice of axes or colours is drawn, all points", f"{found.points_ms:.0f} ms"),
        (
            "a rectangle is brushed: two filters, plot, histograms and lists",
            f"{found.brush_ms:.0f} ms",
        ),
        ("a recording plays, from the click to its first frame", f"{found.plays_s:.1f} s"),
    ]
    whole = f"{table.num_rows:,} runs of {table.num_columns} columns, with {MAX_RECORDINGS} recordings of 10 s,"
    return {
        "viewer.runs": whole,
        "viewer.size": f"{page.stat().st_size / 1e6:.1f}",
        "viewer.ready": f"{found.ready_s:.1f}",
        "viewer.directory": "\n".join(f"| {' | '.join(row)} |" for row in rows),
    }


def of_a_drive() -> dict[str, str]:
    drive = LiveDrive(Driving(Setup(pilot="open_loop"), {"frequency": 0.8}))
    thread = threading.Thread(target=drive.run)
    thread.start()
    try:
        with chromium.page() as tab:
            tab.open(drive.address, 1280, 720)
            tab.wait(chromium.READY)
            tab.wait("viewer.drive.socket.readyState === WebSocket.OPEN")
            tab.evaluate("viewer.drive.send({reset: true, pause: false, speed: 1})")
            tab.wait("viewer.drive.state.paused === false && viewer.player.time > 20", 300.0)
    finally:
        drive.over = True
        thread.join(30)
    told = drive.report()
    return {
        "drive.delay": f"{1e3 * told['delay']:.0f}",
        "drive.delay_95": f"{1e3 * told['delay_95']:.0f}",
        "drive.factor": f"{told['factor']:.2f}",
    }


def main(out: Path) -> None:
    found = of_recordings(out) | of_a_directory(out) | of_a_drive()
    print(json.dumps(found, indent=1, ensure_ascii=False))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
