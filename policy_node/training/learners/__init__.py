"""Learners: their base class, DDPG, and DDPG with imagined subgoals; more are in `research`."""
