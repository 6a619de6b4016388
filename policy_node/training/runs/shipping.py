"""Puts an actor of a run into the package: evaluation, critic and curve beside it."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

from fetch_hand_sim.simulation import Simulation
from node_runtime.signals import discard_unread_output
from policy_node.policies import checkpoint
from policy_node.policies.actor import Actor
from policy_node.policies.checkpoint import ActorInfo
from policy_node.policies.files import sha256, to_json, write_files
from policy_node.policies.loading import ROBUST
from policy_node.policies.shipped import shipped_name
from policy_node.training.evaluation.episodes import FIRST_SEED, evaluate, summarize
from policy_node.training.evaluation.table import print_table
from policy_node.training.policy_options import require_writable
from policy_node.training.runs.run_folder import (
    BEST_FILE,
    COMMAND_FILE,
    PROGRESS_FILE,
    STATE_FILE,
    companion_file,
)
from policy_node.training.runs.run_log import draw_curve, read_progress
from policy_node.training.runs.state_checks import is_finite
from policy_node.training.runs.training_state import TrainingState, read_state, state_bytes

# What decides which of two actors is better, the first first.
_BETTER = ('success_gymnasium', 'mean_return')


def ship(
    run: Path,
    actors: Path,
    *,
    episodes: int,
    num_envs: int = 100,
    threads: int = 0,
    name: str = BEST_FILE,
) -> bool:
    """Evaluates and, if it is better than the shipped actor, copies what belongs to an actor.

    An actor that is the shipped one, evaluated on as many episodes, is left as it is.

    Args:
        run: Folder of the run.
        actors: Where actors go.
        episodes: Fresh episodes.
        num_envs: Simulations in the batch.
        threads: Simulation threads; 0 is all cores.
        name: File of the actor in the run.

    Returns:
        Whether the actor of the run is the shipped one now.

    Raises:
        ValueError: If there is no such actor, no log beside it, a file of either folder is damaged,
            the shipped actor acts at another rate, or it was evaluated on more episodes: a few may
            all succeed by chance.
        UsageError: If the folder takes no file.
    """
    candidate = _read_candidate(run, name)
    target = actors / f'{candidate.name}.safetensors'
    _require_rate(target, candidate.info.control_hz)
    old = _evaluation_in(_evaluation_file(target))
    if (old.get('run_sha256'), old.get('episodes')) == (candidate.sha256, episodes):
        print(f'ship_actor: the actor in {actors} is this one; nothing changed')
        return True
    if old and old['episodes'] > episodes:
        raise ValueError(
            f'the actor in {actors} was evaluated on {old["episodes"]} episodes, this one would be '
            f'on {episodes}: give --episodes {old["episodes"]} or more'
        )
    require_writable(target)
    summary = _evaluate(candidate, episodes, num_envs, threads)
    if old and not is_better(summary, old):
        print(f'ship_actor: the actor in {actors} is at least as good; nothing changed')
        return False
    _write(candidate, target, summary)
    print(f'ship_actor: {target} is the actor of {run} now')
    return True


@dataclass(frozen=True, slots=True)
class _Candidate:
    """An actor of a run, and what the folder holds beside it.

    Attributes:
        run: Folder of the run.
        actor: The actor.
        info: What its file says about it.
        sha256: Fingerprint of its file.
        progress: Log of the run, one row at least.
        state: State of the run; None where it left none.
    """

    run: Path
    actor: Actor
    info: ActorInfo
    sha256: str
    progress: list[dict[str, float]]
    state: TrainingState | None

    @property
    def name(self) -> str:
        """Name of the shipped file: the task, with `_robust` where that recipe trained it."""
        is_robust = self.info.config.get('recipe') == ROBUST
        return shipped_name(self.info.task, ROBUST if is_robust else '')

    @property
    def disturbances(self) -> str | None:
        """Disturbances that it was trained with and is evaluated with."""
        return self.info.config.get('disturbances') or None

    @property
    def command(self) -> str:
        """What it was trained with."""
        return commands_of(self.run) or self.info.command


def _read_candidate(run: Path, name: str) -> _Candidate:
    """Reads all that may be shipped, before anything is evaluated or replaced.

    Raises:
        ValueError: If there is no such actor, no log beside it, or a file is damaged.
    """
    actor, info = checkpoint.load(run / name)
    progress, has_state = _progress_of(run), (run / STATE_FILE).is_file()
    state = read_state(run / STATE_FILE) if has_state else None
    return _Candidate(run, actor, info, checkpoint.checkpoint_hash(run / name), progress, state)


def _evaluate(candidate: _Candidate, episodes: int, num_envs: int, threads: int) -> dict[str, Any]:
    """Evaluates on fresh episodes and shows the table."""
    info = candidate.info
    simulation = Simulation(
        info.task,
        num_envs=min(num_envs, episodes),
        num_threads=threads,
        control_hz=info.control_hz,
        disturbances=candidate.disturbances,
    )
    summary = summarize(evaluate(simulation, candidate.actor, episodes, FIRST_SEED))
    # After an hour of episodes nobody may read the table any more; the actor is saved all the same.
    discard_unread_output()
    print_table({'policy': str(candidate.run), 'task': info.task, **summary})
    return summary


def _write(candidate: _Candidate, target: Path, summary: dict[str, Any]) -> None:
    """Writes the actor, and beside it critic, curve and evaluation, once there is room for all."""
    info = replace(candidate.info, success=summary, command=candidate.command)
    actor = checkpoint.to_bytes(candidate.actor, info)
    files = {target: actor}
    if candidate.state is not None:
        files[companion_file(target)] = _critic_bytes(candidate.state, sha256(actor))
    curve = target.with_suffix('.png')
    # A mean of networks, taken as it is, has no curve of its own: that of a part stays.
    if candidate.progress[-1].get('updates') or not curve.is_file():
        files[curve] = _curve_bytes(candidate)
    report = {
        'actor': candidate.name,
        'sha256': sha256(actor),
        'run_sha256': candidate.sha256,
        'env_steps': info.env_steps,
        'command': info.command,
        'init_from': info.init_from,
        'source_revision': info.source_revision,
        **({'disturbances': candidate.disturbances} if candidate.disturbances else {}),
        **summary,
    }
    # The last: without it the actor is shipped again.
    files[_evaluation_file(target)] = to_json(report)
    # Links stay links.
    write_files({path.resolve(): data for path, data in files.items()})
    if candidate.state is None:
        # That of the actor before would be refused beside this one.
        companion_file(target).unlink(missing_ok=True)


def _evaluation_file(target: Path) -> Path:
    return target.with_suffix('.json')


def _curve_bytes(candidate: _Candidate) -> bytes:
    info = candidate.info
    recipe = info.config.get('recipe', 'an unknown')
    picture = BytesIO()
    draw_curve(candidate.progress, f'{info.task}, {recipe} recipe, seed {info.seed}', picture)
    return picture.getvalue()


def _critic_bytes(state: TrainingState, actor_sha256: str) -> bytes:
    """The critic of a run as it lies beside its shipped actor, so that training can go on there.

    The actor holds its normalisers itself; optimisers start fresh.
    """
    tensors = {name: value for name, value in state.tensors.items() if name.startswith('critic.')}
    extra = {'config': state.extra['config'], 'actor_sha256': actor_sha256}
    return state_bytes(TrainingState(tensors, state.counters, extra))


def _require_rate(target: Path, control_hz: float) -> None:
    """Refuses to replace an actor by one for other robots, whatever its success there.

    Raises:
        ValueError: If the one that is there acts at another rate, or is damaged.
    """
    if not target.is_file():
        return
    there = checkpoint.read_info(target).control_hz
    if there != control_hz:
        raise ValueError(
            f'{target} acts at {there:g} Hz, this one at {control_hz:g} Hz: name another folder '
            'with --actors'
        )


def _evaluation_in(file: Path) -> dict[str, Any]:
    """What lies beside a shipped actor; empty where none is shipped.

    Raises:
        ValueError: If it is no evaluation.
    """
    if not file.is_file():
        return {}
    try:
        found = json.loads(file.read_text())
        for key in (*_BETTER, 'episodes'):
            if not is_finite(found[key]):
                raise ValueError(f'{key} {found[key]!r} is no number')
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f'{file} is no evaluation of an actor: {error!r}') from None
    return dict(found)


def _progress_of(run: Path) -> list[dict[str, float]]:
    """The log of a run, asked for before anything is evaluated or replaced."""
    file = run / PROGRESS_FILE
    try:
        progress = read_progress(file)
    except OSError as error:
        raise ValueError(f'{file} cannot be read: {error.strerror}') from None
    if not progress:
        raise ValueError(f'{file} has no row')
    return progress


def commands_of(run: Path) -> str:
    """Every command of a run in order, the first and those that resumed it; '' if unknown."""
    path = run / COMMAND_FILE
    # The same command again goes on where it stopped: once is enough to say it.
    return ' && '.join(dict.fromkeys(path.read_text().splitlines())) if path.is_file() else ''


def is_better(new: dict[str, Any], old: dict[str, Any]) -> bool:
    """Whether an evaluation is better: by last-step success, then by return."""
    return [new[key] for key in _BETTER] > [old[key] for key in _BETTER]
