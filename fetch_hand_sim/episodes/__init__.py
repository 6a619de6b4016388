"""Run episodes, log them, and check the logs."""
