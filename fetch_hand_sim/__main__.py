"""`python -m fetch_hand_sim <command>`."""

import sys

from fetch_hand_sim.commands.main import main

sys.exit(main())
