"""What a run has: processors, devices, memory, other workers."""
