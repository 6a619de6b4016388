"""The contract between robots and policies: topics, units, orders and conversions.

Nothing in this package imports MuJoCo, torch or a node, so a policy on another machine, a log
reader or a controller of your own can depend on it alone.
"""
