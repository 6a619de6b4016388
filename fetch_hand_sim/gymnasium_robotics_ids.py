"""Register the ids of Gymnasium-Robotics on import, also in worker processes.

Gymnasium imports the module before the colon:
`gymnasium.make('fetch_hand_sim.gymnasium_robotics_ids:FetchReach-v4')`.
"""

from fetch_hand_sim import register_gymnasium_robotics

register_gymnasium_robotics(override=True)
