"""Export logged episodes as datasets that other libraries read."""
