"""Policies of every format: load, run, export, and the files that contain them."""
