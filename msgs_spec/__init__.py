"""The contract between robots and policies: topics, units, orders and conversions.

This package imports neither MuJoCo nor torch nor a node. A policy on another machine, a log reader
or your own controller can depend on it alone.
"""
