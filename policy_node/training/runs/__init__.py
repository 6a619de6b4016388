"""One run: its training loop, its folder and files, and its initial networks."""
