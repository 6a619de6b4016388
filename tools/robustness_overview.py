"""The table and the figure of docs/robustness.md, from the results of all policies.

A result is what `fetch_hand_sim robustness` wrote beside a shipped policy.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from markdown_table import table

from policy_node.training.robustness.figure import draw_overview

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / 'policy_node' / 'actors'
FIGURE = ROOT / 'docs' / 'images' / 'robustness.png'
# Points of a result by the title of their column.
POINTS = {
    'undisturbed': 'none 0',
    '40 ms late': 'action latency 1',
    '80 ms late': 'action latency 2',
    'mild': 'mild 1',
    'hardware': 'hardware 1',
    'severe': 'severe 1',
}


def draw_figure() -> None:
    """Write the figure."""
    FIGURE.write_bytes(draw_overview(_results()))


def robustness_table() -> str:
    """Return success under latency and presets, one row per policy."""
    rows = []
    for each in _results():
        values = (f'{each["points"][name]["success"]:.2f}' for name in POINTS.values())
        rows.append((each['policy'], *values, str(each['episodes'])))
    return table(('policy', *POINTS, 'episodes'), rows)


def _results() -> list[dict[str, Any]]:
    return [json.loads(path.read_text()) for path in sorted(RESULTS.glob('*.robustness.json'))]
