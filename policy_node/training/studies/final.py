"""How good a run is at its end: its last actor on fresh episodes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from policy_node.policies import checkpoint
from policy_node.policies.files import to_json, write_file
from policy_node.training.collection.simulations import make_simulation
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.evaluation.episodes import FIRST_SEED, evaluate, wilson_interval
from policy_node.training.evaluation.evaluator import successes
from policy_node.training.runs.run_folder import LATEST_FILE
from policy_node.training.runs.state_checks import is_finite
from policy_node.training.studies.machines import machine

FINAL_FILE = 'final.json'
_MOST_AT_ONCE = 64


def measure_final(config: TrainConfig, folder: Path, episodes: int) -> None:
    """Evaluates the last actor of a run, in simulations as it was trained in.

    Writes `final.json` into the folder; the file is complete or not there.

    Args:
        config: Configuration of the run.
        folder: Its folder.
        episodes: Fresh episodes, the same for every run.
    """
    actor, _ = checkpoint.load(folder / LATEST_FILE)
    threads = config.simulation_threads
    simulation = make_simulation(config, min(episodes, _MOST_AT_ONCE), threads)
    outcomes = evaluate(simulation, actor, episodes, FIRST_SEED)
    succeeded = int(successes(outcomes, config.success_rule).sum())
    found = {
        'success': succeeded / episodes,
        'interval_95': list(wilson_interval(succeeded, episodes)),
        'touched': float(outcomes.touched.mean()),
        'mean_return': float(outcomes.episode_return.mean()),
        'episodes': episodes,
        'first_seed': FIRST_SEED,
        'machine': machine(),
    }
    write_file(folder / FINAL_FILE, to_json(found))


def read_final(folder: Path) -> dict[str, Any] | None:
    """What `measure_final` wrote; None if it has not, or if what is there is damaged."""
    try:
        found = json.loads((folder / FINAL_FILE).read_text())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) and _is_whole(found) else None


def _is_whole(found: dict[str, Any]) -> bool:
    success = found.get('success')
    is_rate = is_finite(success) and 0.0 <= success <= 1.0
    return is_rate and type(found.get('episodes')) is int
