"""Where frames are, from transforms alone."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from fetch_hand_sim.simulation.urdf import ROOT, Pose


def tree(messages: Iterable[Any]) -> dict[str, Pose]:
    """Where every frame is in the root; AssertionError unless the transforms are one tree."""
    poses = {ROOT: Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))}
    waiting = list(messages)
    while waiting:
        known = [each for each in waiting if each.header.frame_id in poses]
        assert known, [each.child_frame_id for each in waiting]
        for each in known:
            assert each.child_frame_id not in poses, 'two parents'
            t, r = each.transform.translation, each.transform.rotation
            pose = Pose(np.array([t.x, t.y, t.z]), np.array([r.w, r.x, r.y, r.z]))
            poses[each.child_frame_id] = poses[each.header.frame_id] @ pose
        waiting = [each for each in waiting if each not in known]
    return poses
