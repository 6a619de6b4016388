"""Curves of the last seconds: distances, reward, commands and what they move."""

from __future__ import annotations

import numpy as np

from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.simulation.scene import Frame
from fetch_hand_sim.view.picture import Graphs, Series
from msgs_spec.arrays import Array
from msgs_spec.tasks import TaskSpec

# How far each finger of the Fetch slides, metres (`fetch/robot.xml`).
_FINGER_RANGE = 0.05


class Curves:
    """The latest ticks as curves.

    Args:
        spec: The task.
        metric: Measures how far its goals are.
        length: Ticks that are kept.

    Attributes:
        metric: As given.
    """

    def __init__(self, spec: TaskSpec, metric: GoalMetric, length: int = 250) -> None:
        self._spec = spec
        self.metric = metric
        commands = spec.robot.action_size
        # Columns: time, distance, rotation, reward, commands, positions.
        self._rows = np.full((length, 4 + 2 * commands), np.nan)
        self._count = 0
        self._fingers = [
            index for index, name in enumerate(spec.robot.joints) if 'gripper_finger' in name
        ]
        self._grippers = [
            index for index, part in enumerate(spec.robot.command) if part.name == 'gripper'
        ]
        self._commanded = [
            spec.robot.joints.index(part.name) if part.name in spec.robot.joints else None
            for part in spec.robot.command
        ]

    def add(self, time: float, frame: Frame, reward: float | None, command: Array | None) -> None:
        """Appends a tick.

        Args:
            time: Simulated seconds.
            frame: The tick.
            reward: Its reward; None at a reset.
            command: (action size,) what was applied; None at a reset.
        """
        distance, rotation = self.metric.distances(frame.achieved_goal, frame.desired_goal)
        nothing = np.full(len(self._commanded), np.nan)
        row = self._rows[self._count % len(self._rows)]
        row[:4] = time, distance, rotation, np.nan if reward is None else reward
        row[4:] = np.concatenate([nothing if command is None else command, self._positions(frame)])
        self._count += 1

    def graphs(self) -> Graphs:
        """What is kept, in the order of time."""
        commands = len(self._commanded)
        return Graphs(
            distance=self._series(1) if self._spec.position_counts else None,
            rotation=None if self._spec.rotation_threshold is None else self._series(2),
            reward=self._series(3),
            commands=self._series(slice(4, 4 + commands)),
            positions=self._series(slice(4 + commands, None)),
        )

    def _positions(self, frame: Frame) -> Array:
        """What the commands move; the axes of a gripper's path are no joints and stay out."""
        joints = frame.joint_position
        positions = np.array([np.nan if i is None else joints[i] for i in self._commanded])
        for index in self._grippers:
            # From -1 to 1, as the command closes and opens.
            positions[index] = 2.0 * np.mean(joints[self._fingers]) / _FINGER_RANGE - 1.0
        return positions

    def _series(self, columns: int | slice) -> Series:
        size = len(self._rows)
        order = np.arange(max(0, self._count - size), self._count) % size
        rows = self._rows[order]
        return Series(rows[:, 0].copy(), rows[:, columns].copy())
