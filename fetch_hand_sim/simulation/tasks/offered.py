"""What the task of another package must offer, looked at once, when it is made."""

from __future__ import annotations

import mujoco

from fetch_hand_sim.simulation.tasks.task import Task
from msgs_spec.observations import observed_topics
from msgs_spec.topics import sensor_topics


def require_offered(task: Task) -> None:
    """Refuses a task that would fail at the first tick or the first picture.

    Raises:
        ValueError: If a sensor or the joint of the object is missing, or the formulas read a topic
            that there is not; the message says which.
    """
    published = [topic.name for topic in sensor_topics(task.spec)]
    unknown = [name for name in observed_topics(task.spec) if name not in published]
    if unknown:
        raise ValueError(
            f'the formulas of {task.spec.name} read {_quoted(unknown)}; allowed: '
            f'{", ".join(published)}'
        )
    missing = [name for name in published if name not in task.sensors]
    if missing:
        raise ValueError(
            f'{task.spec.name} has no sensor for {", ".join(missing)}, which its robot publishes: '
            'add_sensor(name, function) of Task gives it one'
        )
    if task.spec.object_name is not None:
        _require_object(task, task.spec.object_name)


def _require_object(task: Task, name: str) -> None:
    """Whoever draws the object looks for its free joint."""
    model, joint = task.model, f'{name}:joint'
    free = mujoco.mjtJoint.mjJNT_FREE.value
    known = {model.joint(n).name: model.jnt_type[n] == free for n in range(model.njnt)}
    if not known.get(joint):
        frees = ', '.join(each for each, is_free in known.items() if is_free) or 'none'
        raise ValueError(
            f'{task.spec.name}: the object {name!r} needs a free joint {joint!r} in the model; '
            f'its free joints: {frees}'
        )


def _quoted(names: list[str]) -> str:
    return ', '.join(map(repr, names))
