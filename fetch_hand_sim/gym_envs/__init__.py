"""Gymnasium environments of the simulation."""
