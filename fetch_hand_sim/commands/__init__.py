"""The commands `episodes ...` and `demo`, and the child processes in which nodes run."""
