"""Episodes to arrays: `load_episodes` beside the generic decoders (`make bench-episodes`).

All read the same generated files and end with the same observations, actions and rewards, which is
checked. The generic ones decode only the topics that are needed for that.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rich.console import Console
from rich.table import Table
from rosbags.highlevel import AnyReader

from fetch_hand_sim.episode_log import load_episodes, read_summary
from fetch_hand_sim.episodes.generator import EpisodeGenerator
from fetch_hand_sim.episodes.recorder import RecordingContext
from fetch_hand_sim.simulation import Simulation
from msgs_spec.codecs import decode
from msgs_spec.observations import ObservationAssembler
from msgs_spec.tasks import TASKS, TaskSpec, task_spec
from msgs_spec.topics import topic

Arrays = list[dict[str, np.ndarray]]
STEPS = ('reward', 'applied_command', 'is_success')


def generate(directory: Path, task: str, episodes: int) -> None:
    """Logs episodes under random actions."""
    simulation = Simulation(task, num_envs=episodes)
    generator = np.random.default_rng(0)
    size = simulation.spec.robot.action_size

    def act(observation: dict[str, np.ndarray]) -> np.ndarray:
        return generator.uniform(-1.0, 1.0, (episodes, size)).astype(np.float32)

    context = RecordingContext(simulation, with_compiled_model=False)
    for _ in EpisodeGenerator(simulation, directory, act, context).generate(episodes):
        pass


def with_load_episodes(directory: Path, task: TaskSpec) -> Arrays:
    """This project's loader."""
    del task
    return [
        {**e.observations, 'reward': e.rewards, 'applied_command': e.commands}
        for e in load_episodes(directory)
    ]


def with_rosbags(directory: Path, task: TaskSpec) -> Arrays:
    """`rosbags`, one message at a time."""
    wanted = needed_topics(task)
    result = []
    for path in sorted(directory.iterdir()):
        with AnyReader([path]) as reader:
            connections = [c for c in reader.connections if c.topic in wanted]
            result.append(
                assembled(
                    task,
                    (
                        (connection.topic, reader.deserialize(data, connection.msgtype))
                        for connection, _, data in reader.messages(connections=connections)
                    ),
                )
            )
    return result


def with_mcap_ros2(directory: Path, task: TaskSpec) -> Arrays:
    """`mcap-ros2-support`, one message at a time."""
    result = []
    for path in sorted(directory.iterdir()):
        with read_summary(path).path.open('rb') as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            messages = reader.iter_decoded_messages(topics=list(needed_topics(task)))
            result.append(assembled(task, ((c.topic, message) for _, c, _, message in messages)))
    return result


def needed_topics(task: TaskSpec) -> set[str]:
    """Topics of observations, rewards and commands."""
    observed = {spec.name for spec in ObservationAssembler(task, 25.0).topics}
    return {f'/{name}' for name in observed | set(STEPS)}


def assembled(task: TaskSpec, messages: Iterable[tuple[str, Any]]) -> dict[str, np.ndarray]:
    """Arrays of decoded messages."""
    vectors: dict[str, list[np.ndarray]] = defaultdict(list)
    for name, message in messages:
        vectors[name[1:]].append(decode(topic(task, name[1:]), message))
    stacked = {name: np.array(rows) for name, rows in vectors.items()}
    observations = ObservationAssembler(task, 25.0).assemble(stacked)
    rewards, commands = stacked['reward'][:, 0], stacked['applied_command']
    return {**observations, 'reward': rewards, 'applied_command': commands}


READERS: dict[str, Callable[[Path, TaskSpec], Arrays]] = {
    'load_episodes': with_load_episodes,
    'rosbags': with_rosbags,
    'mcap-ros2-support': with_mcap_ros2,
}


def measure(directory: Path, task: TaskSpec, repeats: int) -> dict[str, float]:
    """Seconds per episode of each reader, median over the repeats, which take turns."""
    expected = with_load_episodes(directory, task)
    times: dict[str, list[float]] = {name: [] for name in READERS}
    for _ in range(repeats):
        for name, read in READERS.items():
            began = time.perf_counter()
            arrays = read(directory, task)
            times[name].append((time.perf_counter() - began) / len(arrays))
            for mine, others in zip(expected, arrays, strict=True):
                for key, values in mine.items():
                    if values.tobytes() != others[key].tobytes():
                        raise RuntimeError(f'{name} reads another {key}')
    return {name: statistics.median(values) for name, values in times.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints the table; returns 1 if `load_episodes` is less than ten times as fast."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--episodes', type=int, default=20)
    parser.add_argument('--repeats', type=int, default=5)
    parser.add_argument(
        '--tasks', nargs='+', choices=TASKS, default=['FetchReach', 'FetchPush', 'HandReach']
    )
    options = parser.parse_args(arguments)
    table = Table('task', *(f'{name}, ms/episode' for name in READERS), 'least ratio')
    worst = float('inf')
    for name in options.tasks:
        with tempfile.TemporaryDirectory() as directory:
            generate(Path(directory), name, options.episodes)
            times = measure(Path(directory), task_spec(name), options.repeats)
        ratio = min(times[other] for other in list(READERS)[1:]) / times['load_episodes']
        worst = min(worst, ratio)
        table.add_row(name, *(f'{1e3 * times[r]:.2f}' for r in READERS), f'{ratio:.1f}')
    Console(width=120).print(table)
    load = os.getloadavg()[0]
    print(f'{platform.machine()}, {os.cpu_count()} cores, load {load:.1f}')
    return 0 if worst >= 10.0 else 1


if __name__ == '__main__':
    sys.exit(main())
