"""Whole episodes, and the transitions that are drawn from them."""
