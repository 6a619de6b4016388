"""DDPG with hindsight experience replay on the batched simulation, and its evaluation."""
