"""Processes of this project: command lines, exit codes, signals, rclpy start and stop.

It depends on the contract (`msgs_spec`), but neither on the simulation nor on policies.
"""
