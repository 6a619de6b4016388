"""What a worker has seen, and the batches that a learner gets of it."""
