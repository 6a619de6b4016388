"""Kills processes that write episodes, each at a random moment, and says what they had written.

    python test/support/killed_writer.py DIRECTORY KILLS SEED

For every kill a child writes episodes into a directory of its own, faster than real time; the
parent kills it, and prints one JSON line: directory, log time of the last message the child had
handed over, and of the first message of that episode. Simulating happens once, before.
"""

from __future__ import annotations

import json
import mmap
import os
import signal
import struct
import sys
import time
from pathlib import Path

import numpy as np

from fetch_hand_sim.episode_log import EpisodeDirectory
from support.episode_recorder import Recorder

# A child is killed within this many seconds of its start, and writes a tick in this many.
LONGEST_LIFE = 0.4
TICK = 0.0005
PROGRESS = struct.Struct('<qq')


def write_for_ever(directory: Path, recorder: Recorder, episodes: list, progress: mmap.mmap):
    """Writes the recorded episodes over and over; notes the times of the last message."""
    log, metadata = EpisodeDirectory(directory), recorder.metadata()
    while True:
        for ticks in episodes:
            writer = log.begin(recorder.spec.name, 0, metadata)
            for tick in ticks:
                writer.write_tick(tick.stamp_ns, tick.messages)
                progress[: PROGRESS.size] = PROGRESS.pack(ticks[0].stamp_ns, tick.stamp_ns)
                time.sleep(TICK)
            writer.finish({'success': 'false'})


def main() -> None:
    directory, kills = Path(sys.argv[1]), int(sys.argv[2])
    generator = np.random.default_rng(int(sys.argv[3]))
    recorder = Recorder('FetchReach')
    episodes = [recorder.ticks() for _ in range(2)]
    progress = mmap.mmap(-1, PROGRESS.size)
    for number in range(kills):
        target = directory / f'{number:03d}'
        progress[:] = PROGRESS.pack(0, 0)
        child = os.fork()
        if child == 0:
            write_for_ever(target, recorder, episodes, progress)
        time.sleep(generator.uniform(0.0, LONGEST_LIFE))
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        assert os.WTERMSIG(status) == signal.SIGKILL
        first, last = PROGRESS.unpack(progress[:])
        print(json.dumps({'directory': str(target), 'first': first, 'last': last}), flush=True)


if __name__ == '__main__':
    main()
