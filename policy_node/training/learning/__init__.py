"""What learns: DDPG with hindsight experience replay."""
