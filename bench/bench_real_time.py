"""Success of the shipped policies in real time against lockstep (`make bench-real-time`).

Two nodes play the same episodes in lockstep, in real time, and in real time with `answer_wait`.
Success, late commands and rate are read from the episode files. Other programs on the machine make
commands late, so the load average is part of the result.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
from datetime import datetime
from pathlib import Path

from fetch_hand_sim.episode_log import EpisodeSummary, find_episodes, read_summary
from msgs_spec.tasks import DEFAULT_CONTROL_HZ, TASKS
from policy_node.training.machine import processor

ROOT = Path(__file__).resolve().parents[1]
# A graph of its own; below 102, where the ports of DDS meet those of Linux.
os.environ.setdefault('ROS_DOMAIN_ID', str(40 + os.getpid() % 62))
FIRST_SEED = 10_000
DEFAULT_TASKS = ('FetchPush', 'FetchSlide', 'HandReach', 'HandManipulateBlockRotateZ')


def parameters(**values: object) -> list[str]:
    """Return the command-line words that set parameters of a node."""
    words = ['--ros-args', '--log-level', 'warn']
    for name, value in values.items():
        words += ['-p', f'{name}:={value}']
    return words


def play(task: str, episodes: int, settings: dict[str, object]) -> list[EpisodeSummary]:
    """Run both nodes; return the logged episodes, in order."""
    with tempfile.TemporaryDirectory() as directory:
        words = parameters(
            task=task,
            seed=FIRST_SEED,
            episodes=episodes,
            wait_for_commands='true',
            log_compiled_model='false',
            episode_dir=directory,
            **settings,
        )
        policy = subprocess.Popen(
            [sys.executable, '-m', 'policy_node.node', *parameters(task=task)], cwd=ROOT
        )
        try:
            sim = [sys.executable, '-m', 'fetch_hand_sim.sim_node', *words]
            subprocess.run(sim, cwd=ROOT, check=True)
        finally:
            policy.send_signal(signal.SIGINT)
            policy.wait()
        return [read_summary(path) for path in sorted(find_episodes(Path(directory)))]


def factor(played: list[EpisodeSummary]) -> float:
    """Return simulated seconds per second, from the start of the first to that of the last one."""
    first, last = (datetime.fromisoformat(e.metadata['started']) for e in (played[0], played[-1]))
    steps = sum((e.outcome.steps or 0) + 1 for e in played[:-1])
    return steps / DEFAULT_CONTROL_HZ / (last - first).total_seconds()


def row(task: str, label: str, played: list[EpisodeSummary]) -> str:
    """Return a line of the table."""
    successes = sum(episode.outcome.is_success is True for episode in played)
    steps = sum(episode.outcome.steps or 0 for episode in played)
    late = '-'
    if played[0].outcome.late_commands is not None:
        late = f'{sum(episode.outcome.late_commands or 0 for episode in played) / steps:.1%}'
    return (
        f'| {task} | {label} | {successes} of {len(played)} | {late} | {factor(played):.2f} | '
        f'{os.getloadavg()[0]:.0f} |'
    )


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--tasks', nargs='+', choices=tuple(TASKS), default=list(DEFAULT_TASKS))
    parser.add_argument('--episodes', type=int, default=50, help='2 or more; default: 50')
    default = [0.0, 20.0]
    parser.add_argument('--answer-wait', nargs='+', type=float, default=default, help='ms')
    options = parser.parse_args()
    variants: dict[str, dict[str, object]] = {'lockstep': {'mode': 'lockstep'}}
    for wait in options.answer_wait:
        variants[f'real time, answer_wait {wait:g}'] = {'answer_wait': wait}
    print(f'{processor()}, {os.cpu_count()} CPUs, seeds from {FIRST_SEED}\n')
    print('| task | mode | success | late commands | real-time factor | load average |')
    print('|---|---|---:|---:|---:|---:|')
    for task in options.tasks:
        for label, settings in variants.items():
            print(row(task, label, play(task, options.episodes, settings)), flush=True)


if __name__ == '__main__':
    main()
