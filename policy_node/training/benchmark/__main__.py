"""`python -m policy_node.training.benchmark`."""

import sys

from policy_node.training.benchmark.command import main

sys.exit(main())
