"""Commands for episodes and the demo, and their node processes."""
