"""Run the node with `python -m fetch_hand_sim.sim_node`."""

import sys

from fetch_hand_sim.sim_node import main

sys.exit(main())
