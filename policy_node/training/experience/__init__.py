"""Collect episodes, store them, relabel their goals and draw batches."""
