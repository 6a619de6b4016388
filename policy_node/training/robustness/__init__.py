"""Measure how much of its success a policy keeps on a disturbed robot."""
