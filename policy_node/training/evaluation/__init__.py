"""What measures: success of policies over fresh episodes."""
