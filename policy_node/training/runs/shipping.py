"""Copy an actor of a run into the package, with its evaluation, critic and curve."""

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
from policy_node.policies.loading import ROBUST, shipped_name
from policy_node.training.evaluation import FIRST_SEED, evaluate, print_table, summarize
from policy_node.training.policy_options import require_writable
from policy_node.training.runs.run_folder import (
    BEST_FILE,
    COMMAND_FILE,
    PROGRESS_FILE,
    STATE_FILE,
    companion_file,
)
from policy_node.training.runs.run_log import draw_curve, read_progress
from policy_node.training.runs.training_state import (
    TrainingState,
    is_finite,
    read_state,
    state_bytes,
)

# An actor is better by the first of these; equal values are decided by the next.
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
    """Evaluate an actor of a run and copy it with its files if it beats the shipped actor.

    Returns:
        Whether the actor is now shipped.

    Raises:
        ValueError: If the actor or its log is missing or damaged, or the shipped actor has another
            action frequency or was evaluated on more episodes. A few episodes may all succeed by
            chance.
        UsageError: If the folder cannot be written.
    """
    candidate = _read_candidate(run, name)
    target = actors / f'{candidate.name}.safetensors'
    _require_rate(target, candidate.info.control_hz)
    old = _read_evaluation(target.with_suffix('.json'))
    if (old.get('run_sha256'), old.get('episodes')) == (candidate.sha256, episodes):
        print(f'ship_actor: {target} is already this actor')
        return True
    if old and old['episodes'] > episodes:
        raise ValueError(
            f'{target} was evaluated on {old["episodes"]} episodes, more than {episodes}: '
            f'give --episodes {old["episodes"]} or more'
        )
    require_writable(target)
    summary = _evaluate(candidate, episodes, num_envs, threads)
    if old and [summary[key] for key in _BETTER] <= [old[key] for key in _BETTER]:
        print(f'ship_actor: {target} is at least as good; it stays')
        return False
    _write(candidate, target, summary)
    print(f'ship_actor: {target} is now the actor of {run}')
    return True


@dataclass(frozen=True, slots=True)
class _Candidate:
    """An actor of a run, with log and state of the run; the state may be missing."""

    run: Path
    actor: Actor
    info: ActorInfo
    sha256: str
    progress: list[dict[str, float]]
    state: TrainingState | None

    @property
    def name(self) -> str:
        """Name of the shipped file: the task, with `_robust` for that recipe."""
        is_robust = self.info.config.get('recipe') == ROBUST
        return shipped_name(self.info.task, ROBUST if is_robust else '')

    @property
    def disturbances(self) -> str | None:
        """Disturbances of its training, which its evaluation repeats."""
        return self.info.config.get('disturbances') or None

    @property
    def command(self) -> str:
        """Every command of the run in order, each once."""
        path = self.run / COMMAND_FILE
        if not path.is_file():
            return self.info.command
        return ' && '.join(dict.fromkeys(path.read_text().splitlines()))


def _read_candidate(run: Path, name: str) -> _Candidate:
    """Read all files before the evaluation; raise ValueError if one is missing or damaged."""
    actor, info = checkpoint.load(run / name)
    log, state = run / PROGRESS_FILE, run / STATE_FILE
    try:
        progress = read_progress(log)
    except OSError as error:
        raise ValueError(f'{log} cannot be read: {error.strerror}') from None
    if not progress:
        raise ValueError(f'{log} has no row')
    digest = checkpoint.checkpoint_hash(run / name)
    found = read_state(state) if state.is_file() else None
    return _Candidate(run, actor, info, digest, progress, found)


def _evaluate(candidate: _Candidate, episodes: int, num_envs: int, threads: int) -> dict[str, Any]:
    info = candidate.info
    simulation = Simulation(
        info.task,
        num_envs=min(num_envs, episodes),
        num_threads=threads,
        control_hz=info.control_hz,
        disturbances=candidate.disturbances,
    )
    summary = summarize(evaluate(simulation, candidate.actor, episodes, FIRST_SEED))
    # A closed terminal must not stop the copy.
    discard_unread_output()
    print_table({'policy': str(candidate.run), 'task': info.task, **summary})
    return summary


def _write(candidate: _Candidate, target: Path, summary: dict[str, Any]) -> None:
    """Write the actor with critic, curve and evaluation: all or none."""
    info = replace(candidate.info, success=summary, command=candidate.command)
    actor = checkpoint.to_bytes(candidate.actor, info)
    files = {target: actor}
    if candidate.state is not None:
        files[companion_file(target)] = _critic_bytes(candidate.state, sha256(actor))
    curve = target.with_suffix('.png')
    # A mean of networks has no curve of its own; the old one stays.
    if candidate.progress[-1].get('updates') or not curve.is_file():
        picture, recipe = BytesIO(), info.config.get('recipe', 'an unknown')
        title = f'{info.task}, {recipe} recipe, seed {info.seed}'
        draw_curve(candidate.progress, title, picture)
        files[curve] = picture.getvalue()
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
    # The last file: without it the actor is shipped again.
    files[target.with_suffix('.json')] = to_json(report)
    # Links stay links.
    write_files({path.resolve(): data for path, data in files.items()})
    if candidate.state is None:
        # Remove the critic of the former actor.
        companion_file(target).unlink(missing_ok=True)


def _critic_bytes(state: TrainingState, actor_sha256: str) -> bytes:
    """Return the file of the critic, from which another training can start.

    The actor file contains the normalisers; optimisers start fresh.
    """
    tensors = {name: value for name, value in state.tensors.items() if name.startswith('critic.')}
    extra = {'config': state.extra['config'], 'actor_sha256': actor_sha256}
    return state_bytes(TrainingState(tensors, state.counters, extra))


def _require_rate(target: Path, control_hz: float) -> None:
    """Raise ValueError if the shipped actor has another action frequency."""
    if not target.is_file():
        return
    shipped = checkpoint.read_info(target).control_hz
    if shipped != control_hz:
        raise ValueError(
            f'{target} acts at {shipped:g} Hz, this actor at {control_hz:g} Hz: give another '
            'folder with --actors'
        )


def _read_evaluation(file: Path) -> dict[str, Any]:
    """Return the evaluation of a shipped actor; empty without an actor.

    Raises:
        ValueError: If the file contains no evaluation.
    """
    if not file.is_file():
        return {}
    try:
        found = json.loads(file.read_text())
        for key in (*_BETTER, 'episodes'):
            if not is_finite(found[key]):
                raise ValueError(f'{key} {found[key]!r} is not a number')
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f'{file} is no evaluation of an actor: {error!r}') from None
    return dict(found)
