"""How the processes of this package run: command lines, exit codes, signals, rclpy start and stop.

Commands and nodes of both sides use it. It knows the contract (`msgs_spec`), but neither the
simulation nor the policies.
"""
