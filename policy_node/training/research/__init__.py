"""Code that only studies use; other folders import only `registry.py`, which chooses it."""
