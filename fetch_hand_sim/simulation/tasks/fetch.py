"""The four Fetch tasks: a mocap-driven gripper, with or without an object.

Trajectories equal those of `fetch_env.py` of Gymnasium-Robotics 1.4.2 bit for bit. Poses of bodies
and sites therefore lag the state by one substep, except in tasks with a blocked gripper, where a
forward pass updates them. Velocities combine the Jacobian of these poses with the newest qvel. Each
action moves the mocap body relative to the lagged gripper pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation.models import (
    FETCH_NEVER_TOUCHING,
    exclude_body_pairs,
    load_spec,
    skip_unread_stages,
)
from fetch_hand_sim.simulation.tasks.task import (
    BatchConfig,
    Generators,
    Ids,
    SiteMotion,
    Task,
    integration_state,
)
from msgs_spec.arrays import Array
from msgs_spec.robots import GRIPPER_STEP
from msgs_spec.rotations import quaternion_multiply
from msgs_spec.tasks import DEFAULT_CONTROL_HZ, TaskSpec

# Unnormalised orientation of the gripper, which `fetch_env.py` adds to the mocap quaternion.
_GRIPPER_ROTATION = np.array([1.0, 0.0, 1.0, 0.0])
# Start of the gripper relative to its place in the compiled model, m.
_GRIPPER_START = np.array([-0.498, 0.005, -0.431])
_SETTLING_SUBSTEPS = 200
# Time constant of the weld between mocap body and gripper (`fetch/shared.xml`), s.
_TIME_CONSTANT = 0.02
# Smallest distance between gripper and object at the start, m.
_OBJECT_CLEARANCE = 0.1


@dataclass(frozen=True, slots=True)
class FetchConfig:
    """Differences between the Fetch tasks; lengths in m.

    Attributes:
        asset: MJCF file, below the assets folder of Gymnasium-Robotics.
        start: Initial positions of the joints robot0:slide0, slide1 and slide2.
        object_start: Initial qpos (7,) of the object; None without an object.
        block_gripper: Whether each step shuts the fingers. At the reset they are open by less than
            1 mm, as in Gymnasium-Robotics.
        gripper_extra_height: Added to the start height of the gripper.
        object_range: Half width of the square in which the object starts.
        target_range: Half width of the cube around the gripper's start in which goals are drawn.
        target_offset: Vector that is added to goals of tasks with an object.
        target_in_the_air: Whether half of the goals are above the table, by up to 0.45 m.
    """

    asset: str
    start: tuple[float, float, float]
    object_start: tuple[float, ...] | None
    block_gripper: bool
    gripper_extra_height: float
    object_range: float = 0.15
    target_range: float = 0.15
    target_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    target_in_the_air: bool = False

    def __post_init__(self) -> None:
        # The corners of the square have the largest distance.
        if self.object_start is not None and self.object_range <= _OBJECT_CLEARANCE / np.sqrt(2.0):
            raise ValueError(
                f'object_range {self.object_range:g} m leaves no place {_OBJECT_CLEARANCE} m away '
                'from the gripper'
            )


_BOX_START = (1.25, 0.53, 0.4, 1.0, 0.0, 0.0, 0.0)
_PUCK_START = (1.7, 1.1, 0.41, 1.0, 0.0, 0.0, 0.0)

FETCH_CONFIGS = {
    'FetchReach': FetchConfig(
        asset='fetch/reach.xml',
        start=(0.4049, 0.48, 0.0),
        object_start=None,
        block_gripper=True,
        gripper_extra_height=0.2,
    ),
    'FetchPush': FetchConfig(
        asset='fetch/push.xml',
        start=(0.405, 0.48, 0.0),
        object_start=_BOX_START,
        block_gripper=True,
        gripper_extra_height=0.0,
    ),
    'FetchSlide': FetchConfig(
        asset='fetch/slide.xml',
        start=(0.05, 0.48, 0.0),
        object_start=_PUCK_START,
        block_gripper=True,
        gripper_extra_height=-0.02,
        object_range=0.1,
        target_range=0.3,
        target_offset=(0.4, 0.0, 0.0),
    ),
    'FetchPickAndPlace': FetchConfig(
        asset='fetch/pick_and_place.xml',
        start=(0.405, 0.48, 0.0),
        object_start=_BOX_START,
        block_gripper=False,
        gripper_extra_height=0.2,
        target_in_the_air=True,
    ),
}


class FetchTask(Task):
    """FetchReach, FetchPush, FetchSlide, FetchPickAndPlace.

    The constructor moves the robot to its start pose; every episode starts from that state.

    Attributes:
        gripper_start: (3,) position of the gripper at a reset, m, world.
        object_height: Height of the object's centre at a reset, m; only with an object.
        gripper_rotation: (N, 4) present rotation of the gripper, wxyz; a read-only view.
        lead_scale: Result of the function `lead_scale`; 1 if `timing` of the batch is `ticks`.
    """

    def __init__(
        self, spec: TaskSpec, batch: BatchConfig, config: FetchConfig | None = None
    ) -> None:
        self.config = config or FETCH_CONFIGS[spec.name]
        mjcf = load_spec(self.config.asset)
        exclude_body_pairs(mjcf, FETCH_NEVER_TOUCHING)
        model = mjcf.compile()
        skip_unread_stages(model)
        self._settle(model, spec)
        super().__init__(spec, model, batch)
        stages = mujoco.mjtStage
        self._last_stage = (stages.mjSTAGE_ACC if batch.keeps_data else stages.mjSTAGE_POS).value
        self.lead_scale = 1.0
        if batch.timing == 'seconds':
            self.lead_scale = lead_scale(1.0 / self.tick_duration)
        sites = {'end_effector': 'robot0:grip'}
        if spec.has_object:
            sites['object'] = 'object0'
        for name, site in sites.items():
            self._add_site(name, model.site(site).id)
        self._fingers = self.joint_qpos[-2:]
        self._ctrl = self.batch.bind('ctrl')
        self._mocap_pos = self.batch.bind('mocap_pos')
        self._mocap_quat = self.batch.bind('mocap_quat')
        gripper_body = model.body('robot0:gripper_link').id
        self._gripper_xpos = self.output('xpos')[:, gripper_body]
        self.gripper_rotation = self.output('xquat')[:, gripper_body]
        self.batch.state[:] = self.start_state

    def _add_site(self, name: str, site: int) -> None:
        """Add sensors `<name>_pose` (N, 7) and `<name>_twist` (N, 6; linear first) of a site."""
        turn = self.model.site_quat[site].copy()
        is_aligned = bool((turn == [1.0, 0.0, 0.0, 0.0]).all())
        position: Array = self.output('site_xpos')[:, site]
        body_quaternion: Array = self.output('xquat')[:, int(self.model.site_bodyid[site])]
        motion, qvel = SiteMotion(self, site), self._qvel

        def pose(_: Task) -> Array:
            quaternion = body_quaternion
            if not is_aligned:
                quaternion = quaternion_multiply(quaternion, turn)
            return np.concatenate([position, quaternion], axis=1)

        def twist(_: Task) -> Array:
            return np.concatenate(motion.twist(motion.dofs, qvel[:, motion.dofs]), axis=1)

        self._sensors |= {f'{name}_pose': pose, f'{name}_twist': twist}

    def _settle(self, model: mujoco.MjModel, spec: TaskSpec) -> None:
        """Move the gripper to its start position; store the state in which episodes start."""
        config = self.config
        data = mujoco.MjData(model)
        for joint, value in zip(spec.robot.joints[:3], config.start, strict=True):
            data.joint(joint).qpos = value
        if config.object_start is not None:
            data.joint('object0:joint').qpos = config.object_start
        model.eq_data[model.eq_type == mujoco.mjtEq.mjEQ_WELD, :7] = [0, 0, 0, 0, 0, 0, 1]
        mujoco.mj_forward(model, data)
        target = _GRIPPER_START + np.array([0.0, 0.0, config.gripper_extra_height])
        data.mocap_pos[0] = target + data.site('robot0:grip').xpos
        data.mocap_quat[0] = _GRIPPER_ROTATION
        mujoco.mj_step(model, data, nstep=_SETTLING_SUBSTEPS)
        self.gripper_start: Array = data.site('robot0:grip').xpos.copy()
        if spec.has_object:
            self.object_height = float(data.site('object0').xpos[2])
        time, qpos, qvel = data.time, data.qpos.copy(), data.qvel.copy()
        mujoco.mj_resetData(model, data)
        data.time, data.qpos[:], data.qvel[:] = time, qpos, qvel
        self.start_state = integration_state(model, data)

    @property
    def asset(self) -> str:
        """Path of the MJCF file below the assets folder of Gymnasium-Robotics."""
        return self.config.asset

    def reset(self, ids: Ids, generators: Generators) -> Array:
        """Restore the start state of simulations `ids`, place objects and return goals (n, 3)."""
        self.batch.state[ids] = self.start_state
        if self.object_qpos is not None:
            places = [self._sample_object_place(generator) for generator in generators]
            start = self.object_qpos.start
            self._qpos[ids, start : start + 2] = places
        self.batch.forward(ids)
        return self.sample_goals(ids, generators)

    def _sample_object_place(self, generator: np.random.Generator) -> Array:
        reach = self.config.object_range
        center = self.gripper_start[:2]
        place = center
        while np.linalg.norm(place - center) < _OBJECT_CLEARANCE:
            place = center + generator.uniform(-reach, reach, size=2)
        return place

    def sample_goal(self, index: int, generator: np.random.Generator) -> Array:
        """Draw a goal (3,), m, near the gripper's start; with an object, on or above the table."""
        config = self.config
        reach = config.target_range
        goal = self.gripper_start + generator.uniform(-reach, reach, size=3)
        if self.spec.has_object:
            goal += config.target_offset
            goal[2] = self.object_height
            if config.target_in_the_air and generator.uniform() < 0.5:
                goal[2] += generator.uniform(0, 0.45)
        return np.asarray(goal)

    def apply_commands(self, commands: NDArray[np.floating]) -> None:
        """Set the mocap target and the finger actuators for commands (N, 4).

        One unit moves the target 0.05 m at 25 Hz. The offset is scaled in the floating type of the
        command, as in Gymnasium-Robotics.
        """
        offset = commands[:, :3] * commands.dtype.type(GRIPPER_STEP * self.lead_scale)
        if self.model.nu:
            fingers = 0.0 if self.config.block_gripper else commands[:, 3:]
            self._ctrl[:] = self._finger_controls(fingers)
        self.move_gripper(offset, self.gripper_rotation + _GRIPPER_ROTATION)

    def move_gripper(self, offset: NDArray[np.floating], rotation: Array) -> None:
        """Set the mocap target: gripper position plus `offset` (N, 3), m, and `rotation` (N, 4)."""
        self._mocap_pos[:, 0] = self._gripper_xpos + offset
        self._mocap_quat[:, 0] = rotation

    def resting_commands(self) -> Array:
        """Return zeros (N, action size), for which gripper and fingers stay where they are."""
        return np.zeros((self.batch.nsim, self.spec.robot.action_size))

    def _finger_controls(self, fingers: NDArray[np.floating] | float) -> Array:
        """Return actuator controls (N, actuators) for finger commands (N, 1), or for one command.

        A position actuator gets the command plus the present finger position, others the command.
        """
        model = self.model
        controls = np.broadcast_to(fingers, self._ctrl.shape).astype(np.float64)
        relative = np.flatnonzero(model.actuator_biastype != mujoco.mjtBias.mjBIAS_NONE)
        joints = model.actuator_trnid[relative, 0]
        controls[:, relative] += self._qpos[:, model.jnt_qposadr[joints]]
        return controls

    def step(self) -> None:
        """Advance one tick; then shut the fingers of a blocked gripper and run a forward pass.

        The pass updates poses; in a batch with `keeps_data`, it updates all derived values. Efforts
        need no pass, because models with a blocked gripper have no actuators.
        """
        try:
            super().step()
        finally:
            # Also after a divergence, because the other simulations continue.
            if self.config.block_gripper:
                self._qpos[:, self._fingers] = 0.0
                self.batch.forward(stage=self._last_stage)


def lead_scale(control_hz: float) -> float:
    """Return the factor on gripper offsets that gives the gripper the same speed as at 25 Hz."""
    return _steady_speed(DEFAULT_CONTROL_HZ) / _steady_speed(control_hz)


def _steady_speed(control_hz: float) -> float:
    """Return the mean speed of the gripper per metre of offset, 1/s, for constant commands.

    The weld to the mocap body is a critically damped spring of frequency w. A tick of duration T
    starts at distance 1 with speed w u towards the mocap body; at its end, the distance is
    (1 - (u - 1) x) exp(-x), x = w T. In the steady state, u is equal at both ends of a tick.
    """
    x = 1.0 / (control_hz * _TIME_CONSTANT)
    decay = math.exp(-x)
    u = x * decay / (1.0 - (1.0 - x) * decay)
    return (1.0 - (1.0 - (u - 1.0) * x) * decay) * control_hz
