"""Code that only studies use. Other folders import only `registry.py`, which selects it."""
