"""What learns: DDPG, on-policy PPO, two levels of it."""
