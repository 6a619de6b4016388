"""`python -m policy_node.training.studies`."""

import sys

from policy_node.training.commands import benchmark

sys.exit(benchmark())
