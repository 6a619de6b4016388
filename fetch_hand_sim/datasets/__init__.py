"""Logged episodes as datasets that other libraries read."""
