"""Follow a robot or a replay over its topics."""
