"""Runs the command."""

import sys

from policy_node.training.robustness.command import main

if __name__ == '__main__':
    sys.exit(main())
