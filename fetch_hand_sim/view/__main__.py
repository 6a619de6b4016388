"""Run the command with `python -m fetch_hand_sim.view`."""

from __future__ import annotations

import sys

from fetch_hand_sim.view import main

sys.exit(main())
