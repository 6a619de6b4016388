"""The machine of a run: processor, device, memory, other workers."""
