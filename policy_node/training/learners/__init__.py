"""The learners and their networks: DDPG and its variants, PPO."""
