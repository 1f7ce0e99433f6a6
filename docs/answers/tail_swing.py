"""The table of docs/control.md on the swing of the tail, as JSON, from the directory of `sweeps/tail_swing.yaml`.

python docs/answers/tail_swing.py runs/tail_swing
"""

from __future__ import annotations

import json
import sys

import numpy as np

from nermo_mjx.sweep import read_table

#: The swing of the author's software.
PHASE, AMPLITUDE = np.pi, 0.5


def main(directory: str) -> dict[str, str]:
    table = read_table(directory).to_pandas()
    assert (table["status"] == "ok").all()
    table["yaw"] = np.degrees(table["yaw_std"])
    still, phase = table["tail.swing_amplitude"] == 0, np.isclose(table["tail.swing_phase"], PHASE)
    his = np.isclose(table["tail.swing_amplitude"], AMPLITUDE) & phase
    lines = ["| walks | without the spine | with the spine | ratio |", "|---|---|---|---|"]
    found = {}
    for profile in ("exact", "as_published"):
        of = table["profile"] == profile
        for title, which in (("no swing", still), ("the author's swing", his)):
            rows = [
                table[of & which & (table["spine"] == spine)]["yaw"]
                for spine in ("none", "stride_extension")
            ]
            cells = [f"{row.mean():.2g} ({row.min():.2g} to {row.max():.2g})" for row in rows]
            ratio = rows[1].mean() / rows[0].mean()
            lines.append(
                f"| `{profile}`, {title}, {len(rows[0])} walks each | {' | '.join(cells)} | {ratio:.2g} |"
            )
        # Three walks of each swing: with and without the spine they have the same phase and amplitude.
        columns = ["tail.swing_amplitude", "tail.swing_phase", "spine"]
        means = table[of].groupby(columns)["yaw"].mean().unstack()
        ratios = (means["stride_extension"] / means["none"]).to_numpy()
        found[f"swing.ratios_{profile}"] = f"{ratios.min():.1f} to {ratios.max():.1f}"
    return {"swing": "\n".join(lines), **found}


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1]), indent=1, ensure_ascii=False))
