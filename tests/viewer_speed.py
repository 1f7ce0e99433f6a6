"""How fast the page is in headless Chromium, by hand: `python tests/viewer_speed.py FILE.html`, on a quiet machine.

Prints the time until the page is ready and until its first still is drawn, and the frames a second while it plays.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

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


def measure(browser: chromium.Browser, page: Path, width: int, height: int) -> dict[str, float]:
    """Seconds until ready and until a finished still; frames a second over all the time and over its second half."""
    with browser.tab() as tab:
        begin = time.monotonic()
        tab.open(page, width, height)
        tab.wait("document.documentElement?.dataset.ready === 'yes'")
        ready = time.monotonic() - begin
        tab.wait("!viewer.stage.stale && !viewer.stage.quality.unsettled")
        tab.picture()
        still = time.monotonic() - begin
        whole, later = tab.evaluate(COUNT)
        level = tab.evaluate("viewer.stage.quality.level")
        assert tab.complaints() == []
        figures = {"ready_s": ready, "still_s": still, "frames_per_s": whole, "second_half": later}
        return {key: round(value, 2) for key, value in figures.items()} | {"level": level}


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
