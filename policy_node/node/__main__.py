"""Entry point of `python -m policy_node.node`."""

import sys

from policy_node.node import main

sys.exit(main())
