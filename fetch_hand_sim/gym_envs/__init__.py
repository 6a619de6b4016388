"""The simulation as Gymnasium sees it."""
