"""Run the node with `python -m fetch_hand_sim.replay_node`."""

import sys

from fetch_hand_sim.replay_node import main

sys.exit(main())
