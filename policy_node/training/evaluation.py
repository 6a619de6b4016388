"""Evaluate policies on fresh episodes, without noise; summarise and print the outcomes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.tasks.hand_manipulate import PALM_HEIGHT
from msgs_spec.tasks import GoalKind, TaskSpec
from msgs_spec.text import counted
from node_runtime.command_line import show_table
from policy_node.policies.policy import Policy

# Far from the seeds of training and of its evaluations.
FIRST_SEED = 2_000_000_000
# Two-sided 95 % quantile of the standard normal distribution.
_Z95 = 1.959963984540054


@dataclass(frozen=True, slots=True)
class EpisodeOutcomes:
    """Outcomes of evaluated episodes; each attribute is an array (episodes,).

    Attributes:
        seed: Seed of the episode.
        success_gymnasium: Success at the last step, by the rule `gymnasium` of the released code.
        success_paper: Success at the last step, by the rule in the text of the paper.
        touched: Success at any step before a divergence, by the success rule of the simulation.
        episode_return: Sum of the rewards.
        diverged: The simulation diverged; the episode counts as a failure.
        ticks_reached: Number of ticks with success (rule of the simulation), except the last tick.
        ticks_kept: Number of these ticks that are followed by another tick with success.
        long_way: At the start, the quaternions of goal and object had opposite signs. The
            `gymnasium` rule then requires a rotation by more than pi. False if the goal is no pose.
        dropped: The object was below the palm at the end; False if the goal is no pose.
        final_distance: Metres to the goal at the end; NaN if position does not count.
        final_rotation: Radians to the goal at the end; NaN if rotation does not count.
    """

    seed: NDArray[np.int64]
    success_gymnasium: NDArray[np.bool_]
    success_paper: NDArray[np.bool_]
    touched: NDArray[np.bool_]
    episode_return: NDArray[np.float64]
    diverged: NDArray[np.bool_]
    ticks_reached: NDArray[np.int64]
    ticks_kept: NDArray[np.int64]
    long_way: NDArray[np.bool_]
    dropped: NDArray[np.bool_]
    final_distance: NDArray[np.float64]
    final_rotation: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.seed)

    def join(self, other: EpisodeOutcomes) -> EpisodeOutcomes:
        """Return these episodes, followed by those of `other`."""
        names = EpisodeOutcomes.__slots__
        pairs = [(getattr(self, name), getattr(other, name)) for name in names]
        return EpisodeOutcomes(*(np.concatenate(pair) for pair in pairs))

    def first(self, count: int) -> EpisodeOutcomes:
        """Return the first `count` episodes, or all if there are fewer."""
        return EpisodeOutcomes(*(getattr(self, n)[:count] for n in EpisodeOutcomes.__slots__))


def wilson_interval(successes: int, episodes: int) -> tuple[float, float]:
    """Return the 95 % interval of a success probability (Wilson 1927).

    Raises:
        ValueError: If `episodes` is less than 1.
    """
    if episodes < 1:
        raise ValueError(f'{episodes} episodes; allowed: 1 or more')
    rate, square = successes / episodes, _Z95**2
    centre = rate + square / (2 * episodes)
    spread = _Z95 * math.sqrt(rate * (1 - rate) / episodes + square / (4 * episodes**2))
    scale = 1 + square / episodes
    # Rounding must not exclude the rate itself.
    low, high = min(rate, (centre - spread) / scale), max(rate, (centre + spread) / scale)
    return max(0.0, low), min(1.0, high)


def compare(
    first: EpisodeOutcomes, second: EpisodeOutcomes, success_rule: str = 'gymnasium'
) -> dict[str, Any]:
    """Compare the success of two policies on the same episodes; return JSON values.

    Args:
        first: Outcomes of one policy.
        second: Outcomes of the other policy, with the same seeds. If one of the two has more
            episodes, its last ones are ignored.
        success_rule: `gymnasium` or `paper`.

    Returns:
        `episodes`: number of compared episodes. `difference`: success rate of the first minus that
        of the second. `difference_interval_95`: its 95 % interval for paired episodes (Agresti and
        Min 2005, who add half an episode to each of the four outcomes). `only_first`,
        `only_second`: number of episodes in which only this policy succeeds.
    """
    count = min(len(first), len(second))
    one, two = (getattr(each, f'success_{success_rule}')[:count] for each in (first, second))
    only_first, only_second = int((one & ~two).sum()), int((two & ~one).sum())
    gap, size = only_first - only_second, count + 2
    spread = _Z95 * math.sqrt(only_first + only_second + 1 - gap**2 / size) / size
    interval = [max(-1.0, gap / size - spread), min(1.0, gap / size + spread)]
    return {
        'episodes': count,
        'difference': gap / count,
        'difference_interval_95': interval,
        'only_first': only_first,
        'only_second': only_second,
    }


def summarize(outcomes: EpisodeOutcomes) -> dict[str, Any]:
    """Return the measures of an evaluation by name, as JSON values.

    `success_gymnasium`, `success_paper` and `touched` are rates, each with an `_interval_95`. The
    others are counts, the first seed, the mean return and the result of `diagnose`.
    """
    episodes = len(outcomes)
    summary: dict[str, Any] = {'episodes': episodes, 'first_seed': int(outcomes.seed[0])}
    for name in ('success_gymnasium', 'success_paper', 'touched'):
        count = int(getattr(outcomes, name).sum())
        summary[name] = count / episodes
        summary[f'{name}_interval_95'] = list(wilson_interval(count, episodes))
    summary['mean_return'] = float(outcomes.episode_return.mean())
    summary['diverged'] = int(outcomes.diverged.sum())
    return summary | diagnose(outcomes)


def diagnose(outcomes: EpisodeOutcomes) -> dict[str, float]:
    """Return measures that show why episodes fail, by name.

    Returns:
        `stay`: probability of success at the next tick, given success at this one. `long_way`:
        success rate (rule `gymnasium`) of the episodes that require a rotation by more than pi.
        `long_way_share`: their share. `dropped`: share of episodes that end with the object below
        the palm. `distance`, `rotation`: median distance (m) and rotation (rad) to the goal at the
        end. Measures that do not apply to the task or to any episode are missing.
    """
    found: dict[str, float] = {}
    if outcomes.ticks_reached.any():
        found['stay'] = float(outcomes.ticks_kept.sum() / outcomes.ticks_reached.sum())
    if outcomes.long_way.any():
        found['long_way'] = float(outcomes.success_gymnasium[outcomes.long_way].mean())
        found['long_way_share'] = float(outcomes.long_way.mean())
    if np.isfinite(outcomes.final_rotation).any():
        found['dropped'] = float(outcomes.dropped.mean())
        found['rotation'] = float(np.nanmedian(outcomes.final_rotation))
    if np.isfinite(outcomes.final_distance).any():
        found['distance'] = float(np.nanmedian(outcomes.final_distance))
    return found


def run_episodes(simulation: Simulation, policy: Policy, seeds: list[int]) -> EpisodeOutcomes:
    """Run one episode in each simulation, with deterministic actions, and return the outcomes.

    `seeds` has one seed per simulation. An episode does not depend on the others of the batch.
    """
    observation = simulation.reset(seed=seeds)
    count = simulation.num_envs
    long_way = _long_way(simulation.spec, observation)
    touched, diverged = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    success = np.zeros(count, np.bool_)
    ticks_reached, ticks_kept = np.zeros(count, np.int64), np.zeros(count, np.int64)
    episode_return = np.zeros(count)
    state = None
    for _ in range(simulation.spec.episode_ticks):
        action, state = policy.predict(observation, state, deterministic=True)
        result = simulation.step(action)
        observation = result.observation
        ticks_reached += success
        ticks_kept += success & result.success
        success = result.success
        diverged |= result.diverged
        touched |= success & ~diverged
        episode_return += result.reward
    goals = observation['achieved_goal'], observation['desired_goal']
    metric, spec = simulation.metric, simulation.spec
    distance, rotation = metric.distances(*goals)
    fallen = spec.goal is GoalKind.POSE and goals[0][:, 2] < PALM_HEIGHT
    return EpisodeOutcomes(
        seed=np.array(seeds),
        success_gymnasium=metric.with_changes(success_rule='gymnasium').success(*goals) & ~diverged,
        success_paper=metric.with_changes(success_rule='paper').success(*goals) & ~diverged,
        touched=touched,
        episode_return=episode_return,
        diverged=diverged,
        ticks_reached=ticks_reached,
        ticks_kept=ticks_kept,
        long_way=long_way,
        dropped=np.broadcast_to(fallen, count),
        final_distance=distance if spec.position_counts else np.full(count, np.nan),
        final_rotation=rotation if spec.goal is GoalKind.POSE else np.full(count, np.nan),
    )


def _long_way(spec: TaskSpec, observation: dict[str, NDArray[np.float64]]) -> NDArray[np.bool_]:
    """Return `EpisodeOutcomes.long_way`, (episodes,), from the first observations of episodes."""
    achieved, desired = observation['achieved_goal'], observation['desired_goal']
    if spec.goal is not GoalKind.POSE:
        return np.zeros(len(achieved), np.bool_)
    return np.asarray((achieved[:, 3:] * desired[:, 3:]).sum(axis=-1) < 0.0)


def evaluate(
    simulation: Simulation,
    policy: Policy,
    episodes: int,
    first_seed: int,
    hopeless: Callable[[EpisodeOutcomes], bool] | None = None,
) -> EpisodeOutcomes:
    """Evaluate a policy on episodes with the seeds `first_seed`, `first_seed` + 1, ...

    Args:
        simulation: The simulations; the result does not depend on their number.
        hopeless: Called after each batch except the last, with all outcomes so far. If it returns
            True, the evaluation ends, with fewer than `episodes` outcomes.

    Raises:
        ValueError: If `episodes` is less than 1.
    """
    if episodes < 1:
        raise ValueError(f'{episodes} episodes; allowed: 1 or more')

    def batch(first: int) -> EpisodeOutcomes:
        return run_episodes(simulation, policy, list(range(first, first + simulation.num_envs)))

    outcomes = batch(first_seed)
    while len(outcomes) < episodes and not (hopeless and hopeless(outcomes)):
        outcomes = outcomes.join(batch(first_seed + len(outcomes)))
    return outcomes.first(episodes)


# Seeds of evaluation episodes start here; those of training runs stay far below.
EVALUATION_SEED = 1_000_000_000


def training_seeds(sequence: np.random.SeedSequence, count: int) -> list[int]:
    """Return `count` training seeds drawn from `sequence`, all below the seeds of evaluations."""
    return [int(seed) % EVALUATION_SEED for seed in sequence.generate_state(count) >> 2]


def success_rate(outcomes: EpisodeOutcomes, success_rule: str) -> float:
    """Return the success rate at the last step; `success_rule` is `gymnasium` or `paper`."""
    return float(getattr(outcomes, f'success_{success_rule}').mean())


_DIAGNOSES = {
    'stay': 'success at the next tick, given success at this one',
    'long_way': 'success where the goal is the long way round',
    'dropped': 'object below the palm at the end',
    'distance': 'median distance at the end, m',
    'rotation': 'median rotation at the end, rad',
}

_NARROWEST = 60


def print_table(report: dict[str, Any]) -> None:
    """Print the summary of an evaluation as a table, with 95 % intervals.

    `report` is the result of `summarize` with the additional keys `task` and `policy`. The optional
    key `disturbances` marks the robot as disturbed. The optional key `against` contains the result
    of `compare` and `policy`, the name of the other policy.
    """
    episodes = counted(report['episodes'], 'episode')
    title = f'{report["task"]}: {report["policy"]}, {episodes}'
    if 'disturbances' in report:
        title += ', disturbed'
    table = Table('measure', 'value', '95 % interval', title=Text(title))
    names = {
        'success_gymnasium': 'success at the last step, gymnasium rule',
        'success_paper': 'success at the last step, paper rule',
        'touched': 'goal touched at least once',
    }
    for name, label in names.items():
        low, high = report[f'{name}_interval_95']
        table.add_row(label, f'{report[name]:.4f}', f'{low:.4f} ... {high:.4f}')
    for name, label in _DIAGNOSES.items():
        if name in report:
            table.add_row(label, f'{report[name]:.4f}', '')
    table.add_row('mean return', f'{report["mean_return"]:.3f}', '')
    table.add_row('diverged episodes', str(report['diverged']), '')
    if 'against' in report:
        _add_comparison(table, report['against'])
    # Numbers are whole in a terminal that has no room for them.
    show_table(table, _NARROWEST)


def _add_comparison(table: Table, other: dict[str, Any]) -> None:
    low, high = other['difference_interval_95']
    table.add_section()
    label = Text(f'success minus that of {other["policy"]}')
    table.add_row(label, f'{other["difference"]:+.4f}', f'{low:+.4f} ... {high:+.4f}')
    table.add_row('compared episodes', str(other['episodes']), '')
    table.add_row('only this policy succeeds', str(other['only_first']), '')
    table.add_row('only the other succeeds', str(other['only_second']), '')
