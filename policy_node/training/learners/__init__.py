"""The base class of learners, DDPG, and DDPG with imagined subgoals; more are in `research`."""
