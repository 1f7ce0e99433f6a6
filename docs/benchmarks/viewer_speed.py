"""How fast a page is in headless Chromium, by hand: `python docs/benchmarks/viewer_speed.py FILE`, on a quiet machine.

Of a recording's page it prints the time until it is ready and until its first still is drawn, and the frames a second
while it plays; of a directory's page the time until it is ready and until it is seen, until another choice is drawn,
and until a recording plays.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
import chromium

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
    for name, act in (("points_ms", "explorer.chart.draw()"), ("brush_ms", "explorer.brush([0.2, 0.7, 0.2, 0.8])")):
        script = f"(() => {{ const begin = performance.now(); {act}; {FLUSH}; return performance.now() - begin; }})()"
        tab.evaluate("explorer.view.cells = false, explorer.show()")
        figures[name] = tab.evaluate(script)
    begin = time.monotonic()
    if tab.evaluate("explorer.recorded.size"):
        tab.evaluate("explorer.filters.release(), explorer.play([...explorer.recorded][0])")
        tab.wait("document.querySelector('#theatre iframe')?.contentWindow.viewer?.stage.frames > 0")
        figures["plays_s"] = time.monotonic() - begin
    assert tab.complaints() == []
    return {key: round(value, 2) for key, value in figures.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path)
    page = parser.parse_args().page
    program = chromium.find()
    assert program, "no Chromium"
    print(f"{page.name}: {page.stat().st_size / 1e6:.2f} MB")
    for width, height in ((1280, 720), (640, 360)):
        for _ in range(3):
            with chromium.browser(program) as browser:
                print(f"{width} x {height}: {json.dumps(measure(browser, page, width, height))}", flush=True)


if __name__ == "__main__":
    main()
