"""Common parts of all processes: command lines, exit codes, signals, start and stop of rclpy.

This package depends on `msgs_spec`, but neither on the simulation nor on policies.
"""
