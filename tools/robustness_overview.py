"""Writes the figure and the table of `docs/robustness.md` from the results of all policies.

`make tables` runs it. A result is what `fetch_hand_sim robustness` wrote beside a shipped policy.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from policy_node.training.robustness.figure import draw_overview

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / 'policy_node' / 'actors'
PAGE, FIGURE = ROOT / 'docs' / 'robustness.md', ROOT / 'docs' / 'images' / 'robustness.png'
BEGIN, END = '<!-- table: written by tools/robustness_overview.py -->', '<!-- end of the table -->'
POINTS = ('none 0', 'action latency 1', 'action latency 2', 'mild 1', 'hardware 1', 'severe 1')


def main() -> None:
    """Write both."""
    results = [json.loads(file.read_text()) for file in sorted(RESULTS.glob('*.robustness.json'))]
    FIGURE.write_bytes(draw_overview(results))
    before, rest = PAGE.read_text().split(BEGIN)
    PAGE.write_text(f'{before}{BEGIN}\n{table(results)}\n{END}{rest.split(END)[1]}')


def table(results: list[dict[str, Any]]) -> str:
    """Return success under latency and presets, one row per policy."""
    lines = [
        '| policy | undisturbed | 40 ms late | 80 ms late | mild | hardware | severe | episodes |',
        '| --- | --- | --- | --- | --- | --- | --- | --- |',
    ]
    for each in results:
        values = (f'{each["points"][name]["success"]:.2f}' for name in POINTS)
        lines.append(f'| {each["policy"]} | {" | ".join(values)} | {each["episodes"]} |')
    return '\n'.join(lines)


if __name__ == '__main__':
    main()
