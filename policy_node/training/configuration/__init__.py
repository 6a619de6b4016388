"""The configuration of a run: fields, rules, recipes and command-line options."""
