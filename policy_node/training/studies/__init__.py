"""Studies: many trainings of several variants and seeds, their results, tables and figures."""
