"""Thirteen robot tasks in a batched MuJoCo simulation, and the ROS nodes around it."""

from node_runtime.signals import guard_loading

# First, because the imports below take long.
guard_loading()

from fetch_hand_sim.mujoco_import import import_mujoco  # noqa: E402

import_mujoco()

from fetch_hand_sim.gym_envs.registration import (  # noqa: E402
    make,
    make_vec,
    register_environments,
    register_gymnasium_robotics,
)

__all__ = ['make', 'make_vec', 'register_gymnasium_robotics']

register_environments()
