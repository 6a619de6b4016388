"""Success rate of policies over new episodes."""
