"""Networks of the learners, and the statistics of their inputs."""
