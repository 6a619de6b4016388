"""Which goals episodes are learnt from: hindsight, subgoals, and how well a goal is met."""
