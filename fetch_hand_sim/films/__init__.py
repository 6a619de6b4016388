"""Pictures and films of logged episodes."""
