"""Kill processes that log episodes, each at a random moment, and print their progress.

    python test/support/killed_recorder.py DIRECTORY KILLS LONGEST_LIFE SEED

For every kill a child runs recorded episodes at a factor of real time between 1 and 50 and logs
them as a robot does, model and all, into a directory of its own. The parent kills it and prints one
JSON line: directory, factor and, of every tick, the index of its episode, its stamp and the wall
time at which the robot made it. Simulating happens once, before.
"""

from __future__ import annotations

import dataclasses
import json
import mmap
import os
import signal
import struct
import sys
import time
from pathlib import Path

import numpy as np

from fetch_hand_sim.episodes.recorder import EpisodeRecorder, RecordingContext
from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from support.episode_recorder import rested_episode

PERIOD = 0.04
FACTORS = (1.0, 50.0)
# Number of ticks; then episode, stamp and wall time of each.
COUNT, TICK = struct.Struct('<q'), struct.Struct('<qqd')
MOST_TICKS = 20_000


def run(directory, context, ticks, factor, lived):
    """Logs the episode over and over at a pace; notes every tick before it is logged."""
    recorder = EpisodeRecorder(
        directory,
        attachments=context.attachments,
        metadata=context.metadata,
        on_error=sys.exit,
        on_logged=lambda _: None,
    )
    due, count, number = time.monotonic(), 0, 0
    while True:
        for tick, messages in ticks:
            due = max(due + PERIOD / factor, time.monotonic() - 0.1)
            time.sleep(max(0.0, due - time.monotonic()))
            where = COUNT.size + TICK.size * count
            TICK.pack_into(lived, where, number, tick.stamp_ns, time.monotonic())
            count += 1
            COUNT.pack_into(lived, 0, count)
            status = dataclasses.replace(tick.status, episode=number)
            recorder.record(dataclasses.replace(tick, status=status), messages)
        number += 1


def main() -> None:
    directory, kills, longest = Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
    generator = np.random.default_rng(int(sys.argv[4]))
    simulation = Simulation('FetchReach', num_threads=1)
    context = RecordingContext(simulation)
    ticks = list(rested_episode(EpisodeRunner(simulation)))
    lived = mmap.mmap(-1, COUNT.size + TICK.size * MOST_TICKS)
    for number, factor in enumerate(np.linspace(*FACTORS, kills)):
        target = directory / f'{number:03d}'
        COUNT.pack_into(lived, 0, 0)
        child = os.fork()
        if child == 0:
            run(target, context, ticks, factor, lived)
        time.sleep(generator.uniform(0.0, longest))
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL
        (count,) = COUNT.unpack_from(lived, 0)
        made = [TICK.unpack_from(lived, COUNT.size + TICK.size * i) for i in range(count)]
        report = {'directory': str(target), 'factor': factor, 'ticks': made}
        print(json.dumps(report), flush=True)


if __name__ == '__main__':
    main()
