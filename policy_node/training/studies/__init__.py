"""What compares: the paper's four arms, task by task, seed by seed."""
