"""Simulate the thirteen tasks with MuJoCo, any number of copies at once, without ROS."""

from fetch_hand_sim.simulation.simulation import Observation, Simulation, StepResult
from fetch_hand_sim.simulation.task_check import check_task

__all__ = ['Observation', 'Simulation', 'StepResult', 'check_task']
