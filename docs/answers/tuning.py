"""What a tuning found, for docs/gallery.md, as JSON: `python docs/answers/tuning.py DIR`.

Speeds of start and best point [mm/s], from starts that the tuning has not seen, and its steps to the best.
"""

import json
import sys
from pathlib import Path

if __name__ == "__main__":
    best = json.loads((Path(sys.argv[1]) / "best.json").read_text())
    speeds = {
        f"tuned.{name}": f"{1e3 * best['verified'][name]['metrics']['speed']:.0f}"
        for name in ("start", "best")
    }
    print(json.dumps(speeds | {"tuned.steps": f"{best['iteration']}"}, indent=1))
