"""The robots: thirteen tasks on MuJoCo, from one batched simulation, and the ROS node around it."""

from fetch_hand_sim.gym_envs.registration import (
    make_vec,
    register_environments,
    register_gymnasium_robotics,
)

__all__ = ['make_vec', 'register_gymnasium_robotics']

register_environments()
