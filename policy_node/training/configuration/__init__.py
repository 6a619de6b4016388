"""What a run is told: fields, their rules, recipes, and options of a command line."""
