"""Plays an environment of Gymnasium-Robotics and ours under the same id; run with `python -O`.

Usage: gymnasium_robotics_side_by_side.py ID... Prints, as JSON for each id, what differs.
"""

from __future__ import annotations

import json
import sys
import warnings
from typing import Any

import gymnasium
import gymnasium_robotics
import numpy as np

import fetch_hand_sim

# Objects of their own: compared by what is in them.
OWN = ('data', 'model', 'mujoco_renderer', 'np_random', 'spec', 'unwrapped', 'metadata')
FIELDS = 'qpos qvel ctrl xpos site_xpos time cvel qacc qfrc_bias'.split()
STEPS = 30


def difference(first: Any, second: Any) -> float:
    """Largest absolute difference."""
    return float(np.abs(np.subtract(first, second, dtype=np.float64)).max(initial=0.0))


def facts_that_differ(reference: Any, ours: Any) -> list[str]:
    """Public attributes that are no methods and have another value."""
    differ = []
    for name in dir(reference):
        if name.startswith('_') or name in OWN or callable(getattr(reference, name)):
            continue
        expected, got = getattr(reference, name), getattr(ours, name, None)
        if name in ('goal', 'parallel_quats'):
            equal = difference(expected, got) < 1e-12
        else:
            equal = type(expected) is type(got) and np.array_equal(expected, got)
        if not equal:
            differ.append(f'{name}: {expected!r} {got!r}')
    return differ


def types(step: tuple[Any, ...]) -> list[str]:
    """Types of what `step` and the reward function give."""
    _, reward, terminated, truncated, info = step
    return [type(x).__name__ for x in (reward, terminated, truncated, info['is_success'])]


def play(name: str, reference: Any) -> dict[str, Any]:
    """Both environments through the same actions, some of them out of range."""
    ours = gymnasium.make(name).unwrapped
    generator = np.random.default_rng(0)
    apart = dict.fromkeys(('observation', 'reward', 'success', 'data', 'batch_reward'), 0.0)

    def note(part: str, first: Any, second: Any) -> None:
        apart[part] = max(apart[part], difference(first, second))

    differing_types = []
    sites = [ours.model.site(site).name for site in range(ours.model.nsite)]
    counted = [not name.startswith(('target', 'finger')) for name in sites]
    first, second = reference.reset(seed=5), ours.reset(seed=5)
    facts = facts_that_differ(reference, ours)
    for _ in range(STEPS):
        action = generator.uniform(-1.5, 1.5, ours.action_space.shape).astype(np.float32)
        first, second = reference.step(action), ours.step(action)
        if types(first) != types(second):
            differing_types.append([types(first), types(second)])
        for key in first[0]:
            note('observation', first[0][key], second[0][key])
        note('reward', first[1], second[1])
        note('success', first[4]['is_success'], second[4]['is_success'])
        for field in FIELDS:
            values = (getattr(reference.data, field), getattr(ours.data, field))
            if field == 'site_xpos':
                # The reference moves these before a picture only.
                values = (values[0][counted], values[1][counted])
            note('data', *values)
    goals = np.stack([first[0]['achieved_goal']] * 3), np.stack([first[0]['desired_goal']] * 3)
    # The reference cannot give a batch of rewards for the pen.
    if 'Pen' not in name:
        rewards = reference.compute_reward(*goals, {}), ours.compute_reward(*goals, {})
        note('batch_reward', *rewards)
        if rewards[0].dtype != rewards[1].dtype:
            differing_types.append([str(reward.dtype) for reward in rewards])
    return {
        'missing': sorted(set(dir(reference)) - set(dir(ours))),
        'facts': facts,
        'types': differing_types,
        'apart': apart,
        'is_goal_env': isinstance(ours, gymnasium_robotics.core.GoalEnv),
    }


def override(env: Any) -> list[str]:
    """Overrides the methods of an environment that count; their names as they are called."""
    calls: list[str] = []
    sample_goal, get_obs, reward = env._sample_goal, env._get_obs, env.compute_reward

    def noted(name: str, method: Any) -> Any:
        def call(*arguments: Any) -> Any:
            calls.append(name)
            return method(*arguments)

        return call

    methods = {
        '_sample_goal': lambda: sample_goal() + 0.01,
        '_get_obs': lambda: {key: 2.0 * values for key, values in get_obs().items()},
        '_is_success': lambda achieved, goal: np.float32(achieved[0] - goal[0]),
        'compute_terminated': lambda achieved, goal, info: len(calls) > 15,
        'compute_truncated': lambda achieved, goal, info: len(calls) > 20,
        'compute_reward': lambda achieved, goal, info: float(reward(achieved, 2.0 * goal, info)),
    }
    for name, method in methods.items():
        setattr(env, name, noted(name, method))
    return calls


def play_overridden(reference: Any, ours: Any) -> dict[str, Any]:
    """Both with the same methods overridden: how far they are apart, and what differs."""
    first_calls, second_calls = override(reference), override(ours)
    first, second = reference.reset(seed=5), ours.reset(seed=5)
    apart = difference(reference.goal, ours.goal)
    differ = []
    for _ in range(4):
        apart = max(apart, *(difference(first[0][key], second[0][key]) for key in first[0]))
        action = np.ones(ours.action_space.shape, np.float32)
        first, second = reference.step(action), ours.step(action)
        if first[2:4] != second[2:4] or types(first) != types(second):
            differ.append(f'{first[1:4]} {second[1:4]}')
        success = difference(first[4]['is_success'], second[4]['is_success'])
        apart = max(apart, success, difference(first[1], second[1]))
    if first_calls != second_calls:
        differ.append(f'{first_calls} {second_calls}')
    return {'apart': apart, 'differ': differ, 'ended': [bool(end) for end in first[2:4]]}


def main() -> None:
    """Makes the reference's environments, then replaces their ids."""
    warnings.simplefilter('ignore')
    names = sys.argv[1:]
    gymnasium.register_envs(gymnasium_robotics)
    references = {name: gymnasium.make(name).unwrapped for name in names}
    overridden = {name: gymnasium.make(name).unwrapped for name in names}
    known = [name for name in gymnasium.registry if name.startswith(('Fetch', 'Hand'))]
    fetch_hand_sim.register_gymnasium_robotics(override=True)
    report = {name: play(name, reference) for name, reference in references.items()}
    for name, reference in overridden.items():
        report[name]['overridden'] = play_overridden(reference, gymnasium.make(name).unwrapped)
    print(json.dumps({'known': known, **report}))


main()
