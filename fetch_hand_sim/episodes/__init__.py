"""Episodes: how they run, how they are logged, checked and exported."""
