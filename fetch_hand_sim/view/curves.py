"""Store what the page shows of the last ticks: curves, trail and the newest tick."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.simulation.scene import TRAIL_TICKS, Frame, tracked_position
from fetch_hand_sim.view.picture import Graphs, Picture, Series
from msgs_spec.arrays import Array

# Range of each finger of the Fetch, metres (`fetch/robot.xml`).
_FINGER_RANGE = 0.05


class Curves:
    """Stores goal distances, rewards, commands and joint positions of the last ticks.

    Args:
        metric: Computes the distance to the goal of its task.
        length: Number of ticks to store.
    """

    def __init__(self, metric: GoalMetric, length: int = 250) -> None:
        self._metric = metric
        robot = metric.spec.robot
        # Columns: time, distance, rotation, reward, commands, positions.
        self._rows: deque[Array] = deque(maxlen=length)
        self._fingers = [
            index for index, name in enumerate(robot.joints) if 'gripper_finger' in name
        ]
        # Another robot may have a gripper without such fingers.
        self._grippers = [
            index
            for index, part in enumerate(robot.command)
            if part.name == 'gripper' and self._fingers
        ]
        self._commanded = [
            robot.joints.index(part.name) if part.name in robot.joints else None
            for part in robot.command
        ]

    def add(self, time: float, frame: Frame, reward: float | None, command: Array | None) -> None:
        """Append a tick at `time`, simulated seconds; a reset has no reward and no command."""
        distance, rotation = self._metric.distances(frame.achieved_goal, frame.desired_goal)
        # The reference's angle between q and -q is 2 pi; the page shows the shorter way.
        rotation = np.minimum(rotation, 2.0 * np.pi - rotation)
        if command is None:
            command = np.full(len(self._commanded), np.nan)
        first = [time, distance, rotation, np.nan if reward is None else reward]
        self._rows.append(np.concatenate([first, command, self._positions(frame)]))

    def graphs(self, ticks: int | None = None) -> Graphs:
        """Return the curves of the oldest `ticks` stored ticks; None returns all."""
        spec, commands = self._metric.spec, len(self._commanded)
        rows = np.array(self._rows).reshape(-1, 4 + 2 * commands)[:ticks]

        def series(columns: int | slice) -> Series:
            return Series(rows[:, 0], rows[:, columns])

        return Graphs(
            distance=series(1) if spec.position_counts else None,
            rotation=None if spec.rotation_threshold is None else series(2),
            reward=series(3),
            commands=series(slice(4, 4 + commands)),
            positions=series(slice(4 + commands, None)),
        )

    def _positions(self, frame: Frame) -> Array:
        """Return the positions of the joints that the commands drive, (action size,).

        Joints are in rad; the fingers of Fetch go from -1 (closed) to 1 (open). Commands that move
        the gripper along an axis drive no single joint, so their position is NaN.
        """
        joints = frame.joint_position
        positions = np.array([np.nan if i is None else joints[i] for i in self._commanded])
        for index in self._grippers:
            # From -1 (closed) to 1 (open), like the command.
            positions[index] = 2.0 * np.mean(joints[self._fingers]) / _FINGER_RANGE - 1.0
        return positions


class History:
    """Stores a robot's newest tick with its trail (`picture`), and its past ticks (`curves`)."""

    def __init__(self, metric: GoalMetric) -> None:
        self.metric = metric
        self.picture = Picture(metric.spec.name)
        self.curves = Curves(metric)
        self._trail: deque[Array] = deque(maxlen=TRAIL_TICKS)

    def begin_episode(self) -> None:
        """Remove the trail of the last episode."""
        self._trail.clear()

    def add(self, stamp_ns: int, frame: Frame, reward: float | None, command: Array | None) -> None:
        """Append a tick; if its stamp is before the last one, first remove the old curves."""
        if stamp_ns < self.picture.stamp_ns:
            self.curves = Curves(self.metric)
        self._trail.append(tracked_position(frame))
        self.curves.add(stamp_ns * 1e-9, frame, reward, command)
        self.picture = Picture(
            self.picture.task, frame, stamp_ns, trail=tuple(self._trail), command=command
        )

    def show_goal(self, goal: Array) -> None:
        """Show another desired goal in the newest tick."""
        if self.picture.frame is not None:
            frame = replace(self.picture.frame, desired_goal=goal)
            self.picture = replace(self.picture, frame=frame)
