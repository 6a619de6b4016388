"""Run the node with `python -m fetch_hand_sim.visualization_node`."""

import sys

from fetch_hand_sim.visualization_node import main

sys.exit(main())
