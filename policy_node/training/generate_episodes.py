"""Log episodes of a policy in the batched simulation, without ROS.

The files have the same format as those of `sim_node`. The same command line logs the same
messages again, byte for byte.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from fetch_hand_sim.episode_log import EpisodeLogError
from fetch_hand_sim.episode_log.writer import named_seeds
from fetch_hand_sim.episodes.generator import EpisodeGenerator
from fetch_hand_sim.episodes.recorder import RecordingContext
from fetch_hand_sim.simulation import Observation, Simulation
from msgs_spec.parameters import LARGEST_SEED
from msgs_spec.text import counted
from node_runtime.command_line import (
    EXIT_SUCCESS,
    CommandError,
    CommandParser,
    complain,
    progress,
    run_command,
    say,
)
from policy_node.policies.policy import RandomPolicy
from policy_node.training.policy_options import (
    add_first_seed,
    add_policy_options,
    add_simulation_options,
    load_chosen_policy,
    make_chosen_simulation,
    policy_errors,
)

_NAME = 'fetch_hand_sim episodes generate'


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = CommandParser(prog=_NAME, description=__doc__)
    add_policy_options(parser)
    add_simulation_options(parser, num_envs=64)
    add_first_seed(parser, 0)
    add = parser.add_argument
    add('--output', type=Path, required=True, help='directory in which episodes are collected')
    add('--compiled-model', action='store_true', help='store the compiled model in every file')
    return parser.parse_args(arguments)


def make_generator(options: argparse.Namespace) -> tuple[EpisodeGenerator, Simulation]:
    """Return an episode generator for the chosen policy, and the simulation that it steps.

    Raises:
        UsageError: If the policy cannot be loaded, or an option does not fit the policy.
    """
    loaded = load_chosen_policy(options)
    simulation = make_chosen_simulation(options, loaded)
    context = RecordingContext(simulation, with_compiled_model=options.compiled_model)
    context.checkpoint_sha256 = loaded.sha256 or None
    random = loaded.policy if isinstance(loaded.policy, RandomPolicy) else None
    state: Any = None

    def act(observation: Observation) -> NDArray[Any]:
        nonlocal state
        action, state = loaded.predict(observation, state)
        return action

    def start(seeds: Sequence[int]) -> None:
        nonlocal state
        state = None
        if random is not None:
            random.start(seeds)

    return EpisodeGenerator(simulation, options.output, act, context, start), simulation


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    options = parse_arguments(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    generator, simulation = make_generator(options)
    _warn_of_repeated_seeds(options, simulation.spec.name)
    began, cpu_began = time.perf_counter(), time.process_time()
    count = steps = successes = 0
    try:
        with policy_errors(), progress('episodes', options.episodes) as advance:
            for logged in generator.generate(options.episodes, options.first_seed):
                count += 1
                steps += logged.status.tick
                successes += logged.status.is_success
                advance(1)
    except EpisodeLogError as error:
        raise CommandError(str(error)) from None
    finally:
        wall, cpu = time.perf_counter() - began, time.process_time() - cpu_began
        simulated = steps * simulation.tick_duration
        say(
            f'{counted(count, "episode")} of {simulation.spec.name} in {options.output}: '
            f'{counted(successes, "success")}, {steps} steps, {wall:.1f} s, '
            f'{simulated / wall:.0f} x real time, {simulated / cpu:.0f} x per core'
        )
    return EXIT_SUCCESS


def _warn_of_repeated_seeds(options: argparse.Namespace, task: str) -> None:
    """Warn if the output folder contains episodes of `task` with seeds of the new episodes.

    Training would use such episodes twice.
    """
    try:
        seeds = named_seeds(options.output, task)
    except OSError:
        return  # Writing reports the error.
    series = range(options.first_seed, options.first_seed + options.episodes)
    if twice := sum(seed in seeds for seed in series):
        after = max(seeds) + 1
        fits = after + options.episodes - 1 <= LARGEST_SEED
        remedy = f'; --first-seed {after} avoids them' if fits else ''
        complain(
            _NAME, f'{options.output} already contains {twice} of these seeds of {task}{remedy}'
        )


if __name__ == '__main__':
    sys.exit(main())
