"""A task in a line, for somebody who sees it for the first time."""

from __future__ import annotations

from msgs_spec.tasks import GoalKind, TaskSpec


def introduction(spec: TaskSpec) -> str:
    """What the robot is about to do."""
    what = {
        'FetchReach': 'The arm brings its gripper to the red ball.',
        'FetchPush': 'The arm pushes the box to the red ball on the table.',
        'FetchSlide': 'The arm hits the puck so that it slides to the red ball, out of its reach.',
        'FetchPickAndPlace': 'The arm picks the box up and holds it at the red ball.',
        'HandReach': 'The hand brings its fingertips to the red balls: thumb and finger meet.',
    }.get(spec.name)
    things = (word for word in ('Block', 'Egg', 'Pen') if f'HandManipulate{word}' in spec.name)
    if spec.formulas is None and (thing := next(things, '').lower()):
        how = ' and moves it there' if spec.position_counts else ''
        what = f'The hand turns the {thing} until it looks like the tinted ghost{how}.'
    what = what or f'{spec.name} is a task of another package.'
    return f'{what} The goal turns green when it is reached.'


def drag_hint(spec: TaskSpec) -> str:
    """What dragging a goal does."""
    if spec.goal is not GoalKind.POSE:
        return 'Drag the goal'
    if not spec.position_counts:
        return 'Drag to turn the goal'
    return 'Drag to turn the goal, with Shift to move it'
