"""`python -m policy_node.training.benchmark`."""

import sys

from policy_node.training.commands import benchmark

sys.exit(benchmark())
