"""What only studies use, chosen in `registry.py`; no other module imports the rest."""
