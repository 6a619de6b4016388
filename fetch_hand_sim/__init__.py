"""The robots: thirteen tasks on MuJoCo, from one batched simulation, and the ROS node around it."""
