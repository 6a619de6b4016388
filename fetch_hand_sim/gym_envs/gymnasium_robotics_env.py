"""Environments with the interface of Gymnasium-Robotics 1.4.2.

Names, types and defaults are those of Gymnasium-Robotics: `robot_env.py`, `fetch_env.py`,
`reach.py` and `manipulate.py`. A subclass may override `_sample_goal`, `_get_obs`, `_is_success`
and other methods. `docs/gymnasium_robotics.md` lists these methods and the differences.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.gym_envs.env import FetchHandEnv
from fetch_hand_sim.gym_envs.gymnasium_robotics_parts import (
    depth_in_metres,
    import_goal_env,
    mujoco_renderer,
    mujoco_utils,
)
from fetch_hand_sim.gym_envs.pictures import Image
from fetch_hand_sim.gym_envs.vector_env import FetchHandVectorEnv
from fetch_hand_sim.simulation import Observation
from fetch_hand_sim.simulation.models import asset_path, find
from fetch_hand_sim.simulation.tasks.fetch import FETCH_CONFIGS, FetchTask
from fetch_hand_sim.simulation.tasks.hand import HandReachTask, fingertip_sites
from fetch_hand_sim.simulation.tasks.hand_manipulate import (
    MANIPULATE_CONFIGS,
    TARGET_RANGE,
    HandManipulateTask,
)
from msgs_spec.arrays import Array, Flags
from msgs_spec.tasks import GoalKind, task_spec
from msgs_spec.text import one_of

if TYPE_CHECKING:
    GoalEnv = gymnasium.Env[Observation, NDArray[np.float32]]
else:
    GoalEnv = import_goal_env()


# Pixels, and the cameras of `fetch_env.py` and `hand_env.py`.
SIZE = 480
CAMERAS: dict[str, dict[str, Any]] = {
    'fetch': {
        'distance': 2.5,
        'azimuth': 132.0,
        'elevation': -14.0,
        'lookat': np.array([1.3, 0.75, 0.55]),
    },
    'shadow_hand': {
        'distance': 0.5,
        'azimuth': 55.0,
        'elevation': -25.0,
        'lookat': np.array([1.0, 0.96, 0.14]),
    },
}


def _pictures(task: str, camera: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the arguments `width`, `height` (pixels) and `default_camera_config` for a task.

    The values are those of Gymnasium-Robotics; entries of `camera` replace camera attributes.
    """
    view = {**CAMERAS[task_spec(task).robot.name], **(camera or {})}
    return {'width': SIZE, 'height': SIZE, 'default_camera_config': view}


def as_reference(reward: Any, reward_type: str) -> Any:
    """Convert sparse rewards to float32, as Gymnasium-Robotics does; keep dense ones unchanged."""
    return reward.astype(np.float32) if reward_type == 'sparse' else reward


class RobotEnv(FetchHandEnv, GoalEnv):
    """Base of the Fetch and hand environments, with the attributes of `robot_env.py`.

    Attributes:
        n_substeps: Physics steps per action.
        initial_time: Simulated time at which episodes start, s.
        initial_qpos: `qpos` (nq,) at the start of an episode, before random draws; read-only.
        initial_qvel: `qvel` (nv,) at the start of an episode; read-only.
        fullpath: The MJCF file.
    """

    # Hooks of Gymnasium-Robotics.
    _uncalled = (
        *('_env_setup', '_initialize_simulation', '_mujoco_step'),
        *('_reset_sim', '_set_action', '_step_callback'),
    )
    _hint = (
        'what may be overridden: _sample_goal, _get_obs, _is_success, compute_terminated, '
        'compute_truncated, compute_reward, _render_callback'
    )

    def __init__(
        self,
        task: str,
        default_camera_config: Mapping[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        """Compile the model of a task; `arguments` are those of `FetchHandEnv`."""
        self._mujoco_renderer: Any = None
        pictures = _pictures(task, default_camera_config)
        self._camera = pictures['default_camera_config']
        super().__init__(task, **pictures | arguments)
        physics = self.simulation.task
        self._target_sites = _sites(physics.model, 'target')
        self._finger_sites = _sites(physics.model, 'finger')
        start = physics.new_data(physics.start_state)
        self._state(
            n_substeps=physics.substeps,
            initial_time=float(start.time),
            initial_qpos=start.qpos.copy(),
            initial_qvel=start.qvel.copy(),
            fullpath=str(asset_path(physics.asset)),
        )

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute; raise AttributeError if it is read-only, such as `initial_qpos`."""
        if name in self.__dict__.get('_stated', ()):
            raise AttributeError(
                f'{name} of {self.spec_of_task.name} is fixed; for other values write a task of '
                'your own (docs/own_task.md)'
            )
        super().__setattr__(name, value)

    @property
    def stated(self) -> frozenset[str]:
        """Names of the read-only attributes."""
        own: frozenset[str] = self.__dict__['_stated']
        return own | {'has_object'}

    def _state(self, **facts: Any) -> None:
        """Set read-only attributes of the task; arrays among them become read-only, too."""
        stated: frozenset[str] = self.__dict__.get('_stated', frozenset())
        for fact in facts.values():
            for array in fact if isinstance(fact, tuple) else (fact,):
                if isinstance(array, np.ndarray):
                    array.flags.writeable = False
        self.__dict__.update(facts)
        self.__dict__['_stated'] = stated | facts.keys()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; `options` is ignored, as in Gymnasium-Robotics."""
        started = super().reset(seed=seed)
        self._show_goal()
        return started

    def step(self, action: Any) -> tuple[Observation, Any, bool, bool, dict[str, Any]]:
        """Advance one step; sparse rewards and `is_success` are float32 as in `robot_env.py`."""
        observation, reward, terminated, truncated, info = super().step(action)
        self._show_goal()
        if not self.overrides('_is_success'):
            info['is_success'] = np.float32(info['is_success'])
        if not self.overrides('compute_reward'):
            reward = as_reference(np.float64(reward), self.reward_type)
        return observation, reward, terminated, truncated, info

    def compute_reward(self, achieved_goal: ArrayLike, goal: ArrayLike, info: Any = None) -> Any:
        """Return rewards (...) of goals (..., goal size); sparse rewards are float32."""
        reward = super().compute_reward(achieved_goal, goal, info)[()]
        return as_reference(reward, self.reward_type)

    @property
    def has_object(self) -> bool:
        """True if the task has an object."""
        return self.spec_of_task.has_object

    def render(self) -> Image | None:
        """Call `_render_callback`, draw and return a picture; None in mode `human` or without mode.

        By default `FetchHandEnv.render` draws the picture. Gymnasium's renderer draws it if
        `_render_callback` is overridden, or after the first read of `mujoco_renderer`.
        """
        if self.render_mode is None:
            return None
        self._render_callback()
        if self._mujoco_renderer is None and not self.overrides('_render_callback'):
            return super().render()
        picture = self.mujoco_renderer.render(self.render_mode)
        is_depth = self.render_mode == 'depth_array'
        drawn: Image | None = depth_in_metres(self.model, picture) if is_depth else picture
        return drawn

    @property
    def data(self) -> Any:
        """The `mujoco.MjData`, with markers at the goal; the next method call applies changes."""
        data = super().data
        self._show_goal()
        return data

    @property
    def mujoco_renderer(self) -> Any:
        """Gymnasium's `MujocoRenderer` for `model` and `data`, created at the first read."""
        if self._mujoco_renderer is None:
            size = self.width, self.height
            self._mujoco_renderer = mujoco_renderer(self.model, self.data, self._camera, *size)
        return self._mujoco_renderer

    @mujoco_renderer.setter
    def mujoco_renderer(self, renderer: Any) -> None:
        self._mujoco_renderer = renderer

    @property
    def _mujoco(self) -> Any:
        return mujoco

    @property
    def _utils(self) -> Any:
        return mujoco_utils()

    @property
    def _model_names(self) -> Any:
        return self._utils.MujocoModelNames(self.model)

    def close(self) -> None:
        """Close renderers and window."""
        super().close()
        if self._mujoco_renderer is not None:
            self._mujoco_renderer.close()
            self._mujoco_renderer = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for `pickle`, without Gymnasium's renderer."""
        return super().__getstate__() | {'_mujoco_renderer': None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state; make the arrays of read-only attributes read-only again."""
        self.__dict__.update(state)
        self._state(**{name: state[name] for name in state['_stated']})

    def _render_callback(self) -> None:
        """Move the goal markers in `model` and `data`; do nothing before a user reads either."""
        if self._physics.is_shared:
            self._show_goal()
            self._keep_goal()

    def _show_goal(self) -> None:
        if self._physics.shares_data and self.simulation.is_started[0]:
            self._draw_goal(self._physics.data)

    def _draw_goal(self, data: Any) -> None:
        """Move the target sites to the goal; these sites do not affect the physics."""
        data.site_xpos[self._target_sites] = self.goal.reshape(-1, 3)

    def _keep_goal(self) -> None:
        model = self.simulation.model
        sites = [*self._target_sites, *self._finger_sites]
        bodies = model.body_pos[model.site_bodyid[sites]]
        self._physics.move_sites(sites, self.data.site_xpos[sites] - bodies)

    def _get_achieved_goal(self) -> Array:
        return self._get_obs()['achieved_goal']

    def _is_success(self, achieved_goal: ArrayLike, desired_goal: ArrayLike) -> Any:
        return super()._is_success(achieved_goal, desired_goal).astype(np.float32)[()]


class FetchEnv(RobotEnv):
    """FetchReach, FetchPush, FetchSlide and FetchPickAndPlace, with the names of `fetch_env.py`.

    Attributes:
        initial_gripper_xpos: (3,) start position of the gripper, m.
        height_offset: Height of the resting object's centre, m; only with an object.
        gripper_extra_height: Added to the start height of the gripper, m.
        block_gripper: Whether the fingers are locked shut.
        target_in_the_air: Whether goals may be above the table.
        target_offset: Added to goals: (3,) m, or the number 0 if there is no offset.
        obj_range: Half width of the square in which the object starts, m.
        target_range: Half width of the square (FetchReach: cube) in which goals lie, m.
    """

    def __init__(self, task: str, **arguments: Any) -> None:
        super().__init__(task, **arguments)
        physics = self.simulation.task
        assert isinstance(physics, FetchTask)
        config = FETCH_CONFIGS[task]
        offset = np.array(config.target_offset)
        if self.has_object:
            self._state(height_offset=np.float64(physics.object_height))
        self._state(
            initial_gripper_xpos=physics.gripper_start.copy(),
            gripper_extra_height=config.gripper_extra_height,
            block_gripper=config.block_gripper,
            target_in_the_air=config.target_in_the_air or not self.has_object,
            target_offset=offset if offset.any() else 0.0,
            obj_range=config.object_range,
            target_range=config.target_range,
        )

    def _get_gripper_xpos(self) -> Array:
        return np.asarray(self.data.body('robot0:gripper_link').xpos)


class HandReachEnv(RobotEnv):
    """HandReach, with the names of `shadow_dexterous_hand/reach.py`.

    Attributes:
        initial_goal: (15,) fingertip positions in the initial pose, m.
        palm_xpos: (3,) position of the palm, m.
        relative_control: Always False.
    """

    def __init__(self, task: str = 'HandReach', **arguments: Any) -> None:
        super().__init__(task, **arguments)
        physics = self.simulation.task
        assert isinstance(physics, HandReachTask)
        self._fingertip_sites = fingertip_sites(physics.model)
        self._state(
            initial_goal=physics.start_fingertips.flatten(),
            palm_xpos=physics.palm.copy(),
            relative_control=False,
        )

    def _draw_goal(self, data: Any) -> None:
        super()._draw_goal(data)
        data.site_xpos[self._finger_sites] = data.site_xpos[self._fingertip_sites]


class ManipulateEnv(RobotEnv):
    """The tasks with block, egg and pen, with the names of `shadow_dexterous_hand/manipulate.py`.

    Args:
        target_position: `random` or `ignore`; None for the task's own.
        target_rotation: `z`, `parallel` or `xyz`; None for the task's own.

    Attributes:
        target_position: `random` if the position counts, else `ignore`.
        target_rotation: Rotations of goals: `z`, `parallel` or `xyz`.
        target_position_range: (3, 2) limits of the goal position relative to the object, m.
        parallel_quats: The 24 rotations that map a cube to itself, wxyz.
        ignore_z_target_rotation: Whether rotations about the object's own z axis do not count.
        randomize_initial_position: Always True.
        randomize_initial_rotation: Whether the object starts with a random rotation.
        relative_control: Always False.

    Raises:
        ValueError: If no task with this object has such goals; the message lists the allowed ones.
    """

    def __init__(
        self,
        task: str,
        target_position: str | None = None,
        target_rotation: str | None = None,
        **arguments: Any,
    ) -> None:
        task = task_with_goals(task, target_position, target_rotation)
        super().__init__(task, **arguments)
        physics = self.simulation.task
        assert isinstance(physics, HandManipulateTask)
        position, rotation = _goal_kind(task)
        self._target_geom = physics.model.geom('target').id
        self._state(
            target_position=position,
            target_rotation=rotation,
            target_position_range=TARGET_RANGE.copy(),
            parallel_quats=tuple(physics.parallel_quaternions.copy()),
            ignore_z_target_rotation=self.spec_of_task.ignores_z_rotation,
            randomize_initial_position=True,
            randomize_initial_rotation=physics.config.randomizes_rotation,
            relative_control=False,
        )

    def compute_reward(self, achieved_goal: ArrayLike, goal: ArrayLike, info: Any = None) -> Any:
        """Return rewards as `RobotEnv` does; sparse rewards follow an overridden `_is_success`."""
        if self.reward_type == 'sparse' and self.overrides('_is_success'):
            success = np.asarray(self._is_success(achieved_goal, goal), dtype=np.float32)
            return (success - np.float32(1.0))[()]
        return super().compute_reward(achieved_goal, goal, info)

    def _draw_goal(self, data: Any) -> None:
        """Move the target geom to the goal; this geom does not affect the physics."""
        pose = self._shown_goal()
        geom = self._target_geom
        data.geom_xpos[geom] = pose[:3]
        mujoco.mju_quat2Mat(data.geom_xmat[geom], pose[3:])

    def _keep_goal(self) -> None:
        mujoco_utils().set_joint_qpos(self.model, self.data, 'target:joint', self._shown_goal())
        mujoco_utils().set_joint_qvel(self.model, self.data, 'target:joint', np.zeros(6))

    def _shown_goal(self) -> Array:
        """Return the goal pose (7,) to draw, beside the hand if the task ignores goal positions."""
        goal = self.goal.copy()
        if not self.spec_of_task.position_counts:
            goal[0] += 0.15
        return goal

    def _goal_distance(self, goal_a: ArrayLike, goal_b: ArrayLike) -> tuple[Any, Any]:
        distance, rotation = self.simulation.metric.distances(goal_a, goal_b)
        return distance[()], rotation[()]


def make_env(task: str, **arguments: Any) -> RobotEnv:
    """Return an environment of a task; `arguments` are those of its class, such as `FetchEnv`."""
    spec = task_spec(task)
    if task in FETCH_CONFIGS:
        return FetchEnv(task, **arguments)
    is_reach = spec.goal is GoalKind.FINGERTIPS
    return (HandReachEnv if is_reach else ManipulateEnv)(task, **arguments)


# `gymnasium.make` looks here for what it can make lists of.
make_env.metadata = RobotEnv.metadata  # type: ignore[attr-defined]


def _sites(model: mujoco.MjModel, prefix: str) -> list[int]:
    """Return the indices of the sites `<prefix>0`, `<prefix>1`, ... of a model."""
    found = (find(model, mujoco.mjtObj.mjOBJ_SITE, f'{prefix}{i}') for i in itertools.count())
    return list(itertools.takewhile(lambda site: site >= 0, found))


def _goal_kind(task: str) -> tuple[str, str]:
    """Return `target_position` and `target_rotation` of a task, such as ('ignore', 'xyz')."""
    position = 'random' if task_spec(task).position_counts else 'ignore'
    return position, MANIPULATE_CONFIGS[task].target_rotation


def task_with_goals(task: str, position: str | None, rotation: str | None) -> str:
    """Return the name of the task with the object of `task` and the given kinds of goals.

    `position` and `rotation` are `target_position` and `target_rotation` of `ManipulateEnv`; None
    keeps those of `task`. A combination without a task raises ValueError.
    """
    one_of(task, list(MANIPULATE_CONFIGS), 'task')
    own, asset = _goal_kind(task), MANIPULATE_CONFIGS[task].asset
    wanted = (position or own[0], rotation or own[1])
    kinds = {
        _goal_kind(name): name
        for name, config in MANIPULATE_CONFIGS.items()
        if config.asset == asset
    }
    if wanted not in kinds:
        allowed = ', '.join(' and '.join(kind) for kind in kinds)
        raise ValueError(
            f'target_position {wanted[0]!r} and target_rotation {wanted[1]!r}; allowed: {allowed}'
        )
    return task if wanted == own else kinds[wanted]


class GymnasiumRoboticsVectorEnv(FetchHandVectorEnv):
    """N copies of a task; results equal those of Gymnasium-Robotics in a `SyncVectorEnv`."""

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        target_position: str | None = None,
        target_rotation: str | None = None,
        default_camera_config: Mapping[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        if task in MANIPULATE_CONFIGS:
            task = task_with_goals(task, target_position, target_rotation)
        elif target_position is not None or target_rotation is not None:
            raise TypeError(f'{task} takes neither target_position nor target_rotation')
        pictures = _pictures(task, default_camera_config)
        super().__init__(task, num_envs=num_envs, **pictures | arguments)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Start episodes; options other than `reset_mask` are ignored, as in Gymnasium-Robotics."""
        known = None
        if isinstance(options, dict) and 'reset_mask' in options:
            known = {'reset_mask': options['reset_mask']}
        return super().reset(seed=seed, options=known)

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, Array, Flags, Flags, dict[str, Any]]:
        """Step as `FetchHandVectorEnv` does; `is_success` is float32, as in Gymnasium-Robotics."""
        observation, reward, terminated, truncated, info = super().step(actions)
        for each in (info, info.get('final_info', {})):
            if 'is_success' in each:
                each['is_success'] = each['is_success'].astype(np.float32)
        return observation, reward, terminated, truncated, info

    def compute_reward(self, achieved_goal: ArrayLike, goal: ArrayLike, info: Any = None) -> Any:
        """Return rewards (...) of goals (..., goal size); sparse rewards are float32."""
        reward = super().compute_reward(achieved_goal, goal, info)[()]
        return as_reference(reward, self.reward_type)

    def attributes(self, name: str) -> tuple[Any, ...]:
        """Return the N values of an attribute; read-only ones such as `initial_qpos`, too."""
        try:
            return super().attributes(name)
        except AttributeError:
            if name not in self._single.stated:
                raise
            return (getattr(self._single, name),) * self.num_envs

    @cached_property
    def _single(self) -> RobotEnv:
        """A single environment, from which the batch reads attributes such as `initial_qpos`."""
        return make_env(self.spec_of_task.name, control_hz=self.simulation.control_hz)
