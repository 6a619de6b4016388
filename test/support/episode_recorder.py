"""Real episodes for the tests of the log; as a program, a recorder to be killed.

    python test/support/episode_recorder.py DIRECTORY TASK EPISODES LAST_TICKS

records EPISODES whole episodes, then LAST_TICKS ticks of another, prints its directory and waits.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fetch_hand_sim.episode_log import EpisodeDirectory, EpisodeWriter, episode_metadata
from fetch_hand_sim.episodes.recorder import model_sha256
from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from msgs_spec.codecs import TopicCodec
from msgs_spec.robots import command_from_action
from msgs_spec.tasks import Timing
from msgs_spec.tick import Tick, TickEncoder
from msgs_spec.topics import INTERFACE_VERSION, TopicSpec, topic


@dataclass(frozen=True)
class RecordedTick:
    """The log between two stamps: messages of the tick, then the received command."""

    stamp_ns: int
    messages: list[tuple[TopicSpec, bytes]]
    command: bytes | None


def rested_episode(runner: EpisodeRunner) -> Iterator[tuple[Tick, list[tuple[TopicSpec, bytes]]]]:
    """Run the next episode under resting commands; yield its ticks with their messages."""
    encoder = TickEncoder(runner.spec)
    while True:
        tick = runner.advance(runner.resting_command())
        yield tick, encoder.encode(tick, latched=tick.status.phase != 'running')
        if runner.is_between_episodes:
            return


class Recorder:
    """Runs episodes of a task under random commands and writes them."""

    def __init__(
        self,
        task: str,
        control_hz: float = 25.0,
        first_seed: int = 0,
        timing: Timing = 'seconds',
        interface_version: int = INTERFACE_VERSION,
    ) -> None:
        self.interface_version = interface_version
        self.simulation = Simulation(task, num_threads=1, control_hz=control_hz, timing=timing)
        self.spec = self.simulation.spec
        self.runner = EpisodeRunner(self.simulation, first_seed=first_seed)
        self.commands = topic(self.spec, 'commands')
        self._encoder = TickEncoder(self.spec)
        self._command_encoder = TopicCodec(self.commands)

    def metadata(self, started: str | None = None) -> dict[str, str]:
        metadata = episode_metadata(
            self.spec,
            episode=self.runner.episode,
            seed=self.runner.seed,
            reward_type='sparse',
            success_rule='gymnasium',
            control_hz=self.simulation.control_hz,
            timing=self.simulation.timing,
            model_sha256=model_sha256(self.simulation.model),
            source_revision='12e4567',
            started=started,
        )
        metadata['interface_version'] = str(self.interface_version)
        if self.interface_version == 1:
            del metadata['interface_version']
        return metadata

    def encode(self, tick: Tick) -> list[tuple[TopicSpec, bytes]]:
        """The messages of a tick, as the robot of the interface version publishes them."""
        messages = self._encoder.encode(tick, latched=tick.status.phase != 'running')
        return [each for each in messages if each[0].since <= self.interface_version]

    def ticks(self) -> list[RecordedTick]:
        """Runs the next episode to its end."""
        generator = np.random.default_rng(self.runner.seed)
        command = self.runner.resting_command()
        recorded = []
        while not recorded or not self.runner.is_between_episodes:
            tick = self.runner.advance(command)
            messages = self.encode(tick)
            action = generator.uniform(-1, 1, self.spec.robot.action_size)
            command = command_from_action(self.spec.robot, action)
            is_last = self.runner.is_between_episodes
            data = None if is_last else self._command_encoder.encode(tick.stamp_ns, command)
            recorded.append(RecordedTick(tick.stamp_ns, messages, data))
        return recorded

    def write(self, writer: EpisodeWriter, ticks: list[RecordedTick]) -> None:
        for tick in ticks:
            writer.write_tick(tick.stamp_ns, tick.messages)
            if tick.command is not None:
                writer.write_received(self.commands, tick.command)

    def record(self, directory: EpisodeDirectory, started: str | None = None) -> Path:
        """Runs and writes one whole episode."""
        seed, metadata = self.runner.seed, self.metadata(started)
        writer = directory.begin(self.spec.name, seed, metadata)
        self.write(writer, self.ticks())
        path = writer.finish({'success': 'false', 'return': '-50.0'})
        assert path is not None
        return path


def main() -> None:
    directory, recorder = EpisodeDirectory(Path(sys.argv[1])), Recorder(sys.argv[2])
    for _ in range(int(sys.argv[3])):
        recorder.record(directory)
    writer = directory.begin(recorder.spec.name, recorder.runner.seed, recorder.metadata())
    recorder.write(writer, recorder.ticks()[: int(sys.argv[4])])
    print(directory.path, flush=True)
    signal.pause()


if __name__ == '__main__':
    main()
