"""The base of the hand tasks (20 position actuators, 24 joints, 5 fingertips), and HandReach.

Trajectories of HandReach equal those of `reach.py` of Gymnasium-Robotics 1.4.2.
"""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation.models import list_geom_pairs, load_spec, skip_unread_stages
from fetch_hand_sim.simulation.tasks.task import (
    BatchConfig,
    Generators,
    Ids,
    Task,
    integration_state,
)
from msgs_spec.arrays import Array
from msgs_spec.robots import FINGERTIPS, command_from_action
from msgs_spec.tasks import TaskSpec


def load_hand_model(asset: str) -> mujoco.MjModel:
    """Compile an MJCF asset such as `hand/reach.xml`, tuned for speed with equal trajectories."""
    mjcf = load_spec(asset)
    list_geom_pairs(mjcf)
    model = mjcf.compile()
    skip_unread_stages(model)
    return model


def fingertip_sites(model: mujoco.MjModel) -> NDArray[np.intp]:
    """Return the site indices of the fingertips, in the order in which a goal lists them."""
    return np.array([model.site(f'robot0:S_{name}').id for name in FINGERTIPS], dtype=np.intp)


class HandTask(Task):
    """Base of HandReach and the manipulation tasks; converts actions, measures fingertip poses."""

    def __init__(self, spec: TaskSpec, model: mujoco.MjModel, batch: BatchConfig) -> None:
        super().__init__(spec, model, batch)
        self._ctrl: Array = self.batch.bind('ctrl')
        self._scaled_robot = spec.robot
        self._compiled_ranges = model.actuator_ctrlrange.copy()
        self._site_xpos: Array = self.output('site_xpos')
        self._xquat = self.output('xquat')
        self._fingertip_sites = fingertip_sites(model)
        self._fingertip_bodies = model.site_bodyid[self._fingertip_sites]
        self._sensors['fingertip_poses'] = HandTask._fingertip_poses

    def follow_model(self) -> None:
        """Use the changed `model` from now on.

        If the user has changed its `actuator_ctrlrange`, actions in [-1, 1] span the new range.
        """
        super().follow_model()
        ranges = self.model.actuator_ctrlrange
        self._scaled_robot = self.spec.robot
        if (ranges != self._compiled_ranges).any():
            parts = zip(self.spec.robot.command, ranges.tolist(), strict=True)
            command = tuple(replace(part, lower=low, upper=high) for part, (low, high) in parts)
            self._scaled_robot = replace(self.spec.robot, command=command)

    def commands_from_actions(self, actions: NDArray[np.floating]) -> NDArray[np.floating]:
        """Map actions (N, 20) in [-1, 1] linearly to the range of joint angles (N, 20), rad."""
        return command_from_action(self._scaled_robot, actions)

    def apply_commands(self, commands: NDArray[np.floating]) -> None:
        """Set the targets of the position actuators to joint angles (N, 20), rad."""
        self._ctrl[:] = commands

    def resting_commands(self) -> Array:
        """Return the present targets of the position actuators, (N, 20), rad."""
        return self._ctrl.copy()

    def _fingertip_poses(self) -> Array:
        """Return the fingertip poses in the world, (N, 35), five times position, m, and wxyz."""
        positions = self._site_xpos[:, self._fingertip_sites]
        quaternions = self._xquat[:, self._fingertip_bodies]
        return np.concatenate([positions, quaternions], axis=2).reshape(self.batch.nsim, -1)


# Meeting point of the fingers relative to the palm, and its standard deviation, m.
_MEETING_OFFSET = np.array([0.0, -0.09, 0.05])
_MEETING_SCATTER = 0.005
# Distance of each fingertip to the meeting point, so that goals do not overlap, m.
_MEETING_GAP = 0.005
_PROBABILITY_OF_INITIAL_POSE = 0.1

# Initial joint positions, rad (`DEFAULT_INITIAL_QPOS` of the reference).
_INITIAL_QPOS = {
    'robot0:WRJ1': -0.16514339750464327,
    'robot0:WRJ0': -0.31973286565062153,
    'robot0:FFJ3': 0.14340512546557435,
    'robot0:FFJ2': 0.32028208333591573,
    'robot0:FFJ1': 0.7126053607727917,
    'robot0:FFJ0': 0.6705281001412586,
    'robot0:MFJ3': 0.000246444303701037,
    'robot0:MFJ2': 0.3152655251085491,
    'robot0:MFJ1': 0.7659800313729842,
    'robot0:MFJ0': 0.7323156897425923,
    'robot0:RFJ3': 0.00038520700007378114,
    'robot0:RFJ2': 0.36743546201985233,
    'robot0:RFJ1': 0.7119514095008576,
    'robot0:RFJ0': 0.6699446327514138,
    'robot0:LFJ4': 0.0525442258033891,
    'robot0:LFJ3': -0.13615534724474673,
    'robot0:LFJ2': 0.39872030433433003,
    'robot0:LFJ1': 0.7415570009679252,
    'robot0:LFJ0': 0.704096378652974,
    'robot0:THJ4': 0.003673823825070126,
    'robot0:THJ3': 0.5506291436028695,
    'robot0:THJ2': -0.014515151997119306,
    'robot0:THJ1': -0.0015229223564485414,
    'robot0:THJ0': -0.7894883021600622,
}


class HandReachTask(HandTask):
    """HandReach, the task of moving the fingertips to given positions.

    Attributes:
        start_fingertips: (5, 3) positions of the fingertips in the initial pose, m, world.
        palm: (3,) position of the palm in the initial pose, m, world.
    """

    ASSET = 'hand/reach.xml'

    def __init__(self, spec: TaskSpec, batch: BatchConfig) -> None:
        model = load_hand_model(self.ASSET)
        data = mujoco.MjData(model)
        for joint, value in _INITIAL_QPOS.items():
            data.joint(joint).qpos = value
        self.start_state = integration_state(model, data)
        mujoco.mj_forward(model, data)
        self.start_fingertips: Array = data.site_xpos[fingertip_sites(model)].copy()
        self.palm = data.body('robot0:palm').xpos.copy()
        super().__init__(spec, model, batch)
        self.batch.state[:] = self.start_state

    def reset(self, ids: Ids, generators: Generators) -> Array:
        """Restore the initial pose of the simulations `ids`, (n,); return new goals (n, 15), m."""
        self.batch.state[ids] = self.start_state
        self.batch.forward(ids)
        return self.sample_goals(ids, generators)

    def sample_goal(self, index: int, generator: np.random.Generator) -> Array:
        """Draw a goal (15,), m, world, in which the thumb and a random finger meet.

        The other fingertips keep their initial positions. With probability 0.1, all keep them.
        """
        fingers, thumb = list(FINGERTIPS[:-1]), len(FINGERTIPS) - 1
        finger = fingers.index(str(generator.choice(fingers)))
        meeting = self.palm + _MEETING_OFFSET
        meeting += generator.normal(scale=_MEETING_SCATTER, size=3)
        goal = self.start_fingertips.copy()
        for index in (thumb, finger):
            direction = meeting - goal[index]
            direction /= np.linalg.norm(direction)
            goal[index] = meeting - _MEETING_GAP * direction
        if generator.uniform() < _PROBABILITY_OF_INITIAL_POSE:
            goal = self.start_fingertips
        return goal.flatten()
