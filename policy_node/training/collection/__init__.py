"""Episodes collected: the simulations, and noise on what the actor does there."""
