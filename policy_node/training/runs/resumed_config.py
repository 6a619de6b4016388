"""How a run that goes on is configured."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.flat import config_from_dict, removed_fields, to_flat
from policy_node.training.runs.run_folder import STATE_FILE
from policy_node.training.runs.training_state import read_state

# What networks are made of or came from, and what their values and the replay are of: all that
# stays with a run.
_NETWORK_FIELDS = (
    'hidden_sizes layer_norm goal_features algorithm critics quantiles norm advantage condition '
    'longest_hold subgoal_every init_from'
).split()
_EXPERIENCE_FIELDS = 'seed control_hz reward_type discount gamble'.split()


def resumed_config(
    folder: Path, task: str | None, recipe: str | None, changes: Mapping[str, Any]
) -> TrainConfig:
    """The configuration of a run that goes on, with what may change in it.

    Args:
        folder: Of the run.
        task: Refuse a run of any other task.
        recipe: Likewise.
        changes: Fields that are otherwise from now on.

    Raises:
        ValueError: If there is no run, or it cannot go on so.
    """
    if not (folder / STATE_FILE).is_file():
        raise ValueError(f'{folder} is no folder of a run to go on with: no {STATE_FILE}')
    stored = read_state(folder / STATE_FILE).extra['config']
    for name, chosen in (('task', task), ('recipe', recipe)):
        if chosen not in (None, stored.get(name)):
            raise ValueError(f'{folder} is a run of {stored.get(name)}, not of {chosen}')
    for name, value in removed_fields(stored).items():
        raise ValueError(f'{folder} was trained with {name} {value!r}, removed in version 2.0')
    before, config = config_from_dict(stored), config_from_dict(stored, **changes)
    fixed = {name: 'networks' for name in _NETWORK_FIELDS}
    fixed |= {name: 'experience' for name in _EXPERIENCE_FIELDS}
    for name, kind in fixed.items():
        old, new = to_flat(before)[name], to_flat(config)[name]
        if old != new:
            raise ValueError(f'{folder} has {kind} of {name} {old!r}, which stay; not {new!r}')
    return config
