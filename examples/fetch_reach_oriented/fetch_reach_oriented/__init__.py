"""The Fetch arm brings its gripper to a point, turned as the goal says."""
