"""Copy an actor of a run into the package, with its evaluation, critic and curve."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

from fetch_hand_sim.simulation import Simulation
from node_runtime.signals import discard_unread_output
from policy_node.policies import checkpoint
from policy_node.policies.checkpoint import ActorInfo
from policy_node.policies.files import read_file, require_writable, sha256, to_json, write_files
from policy_node.policies.loading import ROBUST, shipped_name
from policy_node.training.evaluation import FIRST_SEED, evaluate, print_table, summarize
from policy_node.training.runs.run_folder import (
    BEST_FILE,
    COMMAND_FILE,
    LATEST_FILE,
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

# Episodes from this seed on choose between two actors of a run. Neither training nor the reported
# evaluation uses them.
_CHOOSING_SEED = 1_500_000_000
# An actor is better by the first of these; equal values are decided by the next.
_BETTER = ('success_gymnasium', 'mean_return')


def ship(
    run: Path,
    actors: Path,
    *,
    episodes: int,
    num_envs: int = 100,
    threads: int = 0,
    name: str | None = None,
) -> bool:
    """Evaluate an actor of a run; copy it with its files if it is better than the shipped one.

    The better actor has the higher success rate or, at equal rates, the higher mean return. The
    shipped actor is `<task>.safetensors` in the folder `actors`, `<task>_robust.safetensors` for
    the recipe `robust`.

    Args:
        name: File of the actor in `run`. None takes the better of its best and latest actor in
            `episodes` other episodes.

    Returns:
        True if this actor is now the shipped one, also if it was before; else False.

    Raises:
        ValueError: If the actor or its log is missing or damaged, or the shipped actor has another
            action frequency or was evaluated on more episodes.
        UsageError: If the folder cannot be written.
    """
    names = [name] if name else [BEST_FILE, LATEST_FILE]
    # A run without a whole evaluation has no best actor.
    files = [run / each for each in names if (run / each).is_file()] or [run / names[0]]
    info = checkpoint.read_info(files[0])
    progress = _read_log(run / PROGRESS_FILE)
    state = read_state(run / STATE_FILE) if (run / STATE_FILE).is_file() else None
    is_robust = info.config.get('recipe') == ROBUST
    target = actors / f'{shipped_name(info.task, ROBUST if is_robust else "")}.safetensors'
    _require_rate(target, info.control_hz)
    old = _read_evaluation(target.with_suffix('.json'))
    digest = sha256(b''.join(map(read_file, files)))
    if (old.get('run_sha256'), old.get('episodes')) == (digest, episodes):
        print(f'ship_actor: {target} is already this actor')
        return True
    if old and old['episodes'] > episodes:
        raise ValueError(
            f'{target} was evaluated on {old["episodes"]} episodes, more than {episodes}: '
            f'give --episodes {old["episodes"]} or more'
        )
    require_writable(target)
    # The evaluation repeats the disturbances of the training.
    disturbances = info.config.get('disturbances') or None
    simulation = Simulation(
        info.task,
        num_envs=min(num_envs, episodes),
        num_threads=threads,
        control_hz=info.control_hz,
        disturbances=disturbances,
    )
    # A closed terminal must not stop the copy.
    discard_unread_output()
    file = _better_file(files, simulation, episodes)
    actor, info = checkpoint.load(file)
    summary = summarize(evaluate(simulation, actor, episodes, FIRST_SEED))
    print_table({'policy': str(run), 'task': info.task, **summary})
    if old and [summary[key] for key in _BETTER] <= [old[key] for key in _BETTER]:
        print(f'ship_actor: {target} is at least as good; it stays')
        return False
    if (run / COMMAND_FILE).is_file():
        # Every command of the run in order, each once.
        commands = dict.fromkeys((run / COMMAND_FILE).read_text().splitlines())
        info = replace(info, command=' && '.join(commands))
    shipped = checkpoint.to_bytes(actor, replace(info, success=summary))
    report = {
        'actor': target.stem,
        'sha256': sha256(shipped),
        'run_sha256': digest,
        'checkpoint': file.name,
        'env_steps': info.env_steps,
        'command': info.command,
        'init_from': info.init_from,
        'source_revision': info.source_revision,
        **({'disturbances': disturbances} if disturbances else {}),
        **summary,
    }
    _write(target, shipped, report, state, progress, info)
    print(f'ship_actor: {target} is now the actor of {run}')
    return True


def _better_file(files: Sequence[Path], simulation: Simulation, episodes: int) -> Path:
    """Return the file of the best actor in `episodes` episodes that only choose; print them."""
    if len(files) == 1:
        return files[0]
    measures = {}
    for file in files:
        actor, _ = checkpoint.load(file)
        found = summarize(evaluate(simulation, actor, episodes, _CHOOSING_SEED))
        measures[file] = [found[key] for key in _BETTER]
        print(f'ship_actor: {file.name} succeeds in {measures[file][0]:.4g} of {episodes} episodes')
    return max(files, key=measures.__getitem__)


def _read_log(log: Path) -> list[dict[str, float]]:
    """Return the rows of `progress.csv`; raise ValueError if it cannot be read or has no row."""
    try:
        progress = read_progress(log)
    except OSError as error:
        raise ValueError(f'{log} cannot be read: {error.strerror}') from None
    if not progress:
        raise ValueError(f'{log} has no row')
    return progress


def _write(
    target: Path,
    actor: bytes,
    report: dict[str, Any],
    state: TrainingState | None,
    progress: list[dict[str, float]],
    info: ActorInfo,
) -> None:
    """Write the shipped actor with its critic, curve and evaluation `report`: all files or none.

    If `state` is None, the critic of the former actor is removed. A run without updates, such as
    a mean of several actors, does not replace an existing curve.
    """
    files = {target: actor}
    if state is not None:
        files[companion_file(target)] = _critic_bytes(state, sha256(actor))
    curve = target.with_suffix('.png')
    # A mean of networks has no curve of its own; the old one stays.
    if progress[-1].get('updates') or not curve.is_file():
        picture, recipe = BytesIO(), info.config.get('recipe', 'an unknown')
        draw_curve(progress, f'{info.task}, {recipe} recipe, seed {info.seed}', picture)
        files[curve] = picture.getvalue()
    # The last file: without it the actor is shipped again.
    files[target.with_suffix('.json')] = to_json(report)
    # Links stay links.
    write_files({path.resolve(): data for path, data in files.items()})
    if state is None:
        # Remove the critic of the former actor.
        companion_file(target).unlink(missing_ok=True)


def _critic_bytes(state: TrainingState, actor_sha256: str) -> bytes:
    """Return the file contents of the critic, for runs that start from the shipped actor.

    `actor_sha256` records to which actor file the critic belongs. Optimizers are not included.
    """
    tensors = {name: value for name, value in state.tensors.items() if name.startswith('critic.')}
    extra = {'config': state.extra['config'], 'actor_sha256': actor_sha256}
    return state_bytes(TrainingState(tensors, state.counters, extra))


def _require_rate(target: Path, control_hz: float) -> None:
    """Raise ValueError if the shipped actor `target` exists and has another action frequency."""
    if not target.is_file():
        return
    shipped = checkpoint.read_info(target).control_hz
    if shipped != control_hz:
        raise ValueError(
            f'{target} acts at {shipped:g} Hz, this actor at {control_hz:g} Hz: give another '
            'folder with --actors'
        )


def _read_evaluation(file: Path) -> dict[str, Any]:
    """Return the evaluation of a shipped actor from its JSON file; empty if the file is missing.

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
