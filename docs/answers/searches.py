"""What searches find of a dense sweep, for docs/searches.md and docs/benchmarks/studies.md, as JSON.

python docs/answers/searches.py docs/benchmarks/search.jsonl
"""

from __future__ import annotations

import json
import sys
from pathlib import Path


def spread(searches: list[dict[str, float]], name: str, form: str) -> str:
    values = [search[name] for search in searches]
    return f"{min(values):{form}} to {max(values):{form}}"


def main(path: Path) -> dict[str, str]:
    cases = [case for line in path.read_text().splitlines() for case in json.loads(line)["cases"]]
    found = {}
    lines = [
        "| trot [Hz] | seeds | amplitude [rad] | phase [rad] | of the best | runs to 99 % |",
        "|---|---|---|---|---|---|",
    ]
    told = []
    for case in cases:
        each, name = case["searches"], f"{case['frequency']:g}"
        told.append(
            f"- Trot at {name} Hz: {case['dense_runs']} runs of a dense sweep reach {case['dense_speed']:.4f} m/s, "
            f"{case['budget_runs']} runs of a search {case['median_share']:.2%} of it in the median of the seeds; the "
            f"published gait, where each begins, {case['published_share']:.2%}."
        )
        reached = [search["runs_to_99"] or case["budget_runs"] for search in each]
        spans = [
            spread(each, what, form)
            for what, form in (("amplitude", ".3f"), ("phase", ".2f"), ("share", ".2%"))
        ]
        lines.append(
            f"| {name} | {len(each)} | {' | '.join(spans)} | {min(reached)} to {max(reached)} |"
        )
        found |= {
            f"search.median_{name}": f"{100 * case['median_share']:.1f}",
            f"search.worst_{name}": f"{100 * min(search['share'] for search in each):.1f}",
            f"search.to_99_{name}": f"{min(reached)} to {max(reached)}",
            f"search.published_{name}": f"{100 * case['published_share']:.1f}",
        }
    return found | {"search.told": "\n".join(told), "search.table": "\n".join(lines)}


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1])), indent=1, ensure_ascii=False))
