"""Makes a model faster to step without changing a bit of any trajectory.

What is computed and never read is switched off, and collision detection looks at fewer pairs of
geoms while it finds the same contacts in the same order. `docs/simulation.md` has the gains and
what was tried in vain.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

Geoms = NDArray[np.integer[Any]]

# Contact parameters that two geoms combine, with the fields that decide how.
_OF_GEOMS = ('condim', 'friction', 'margin', 'gap', 'solref', 'solimp', 'solmix', 'priority')
# Pairs of Fetch bodies that pass the bounding tests at most steps and stay more than 1 cm apart for
# all positions of the joints between them, even 0.3 rad beyond the limits, which are soft and were
# seen to give way by 0.13 rad (`test_model_tuning.py` samples these positions).
FETCH_NEVER_TOUCHING = (
    ('robot0:base_link', 'table0'),
    ('robot0:laser_link', 'table0'),
    ('robot0:base_link', 'robot0:shoulder_pan_link'),
    ('robot0:head_pan_link', 'robot0:torso_fixed_link'),
    ('robot0:head_pan_link', 'robot0:shoulder_pan_link'),
    ('robot0:head_pan_link', 'robot0:shoulder_lift_link'),
    ('robot0:head_tilt_link', 'robot0:shoulder_pan_link'),
    ('robot0:head_tilt_link', 'robot0:shoulder_lift_link'),
    ('robot0:shoulder_pan_link', 'robot0:torso_fixed_link'),
    ('robot0:shoulder_lift_link', 'robot0:elbow_flex_link'),
    ('robot0:elbow_flex_link', 'robot0:wrist_flex_link'),
)


def exclude_body_pairs(spec: mujoco.MjSpec, pairs: Sequence[tuple[str, str]]) -> None:
    """Keeps MuJoCo from testing pairs of bodies for contact; those the model lacks are ignored."""
    bodies = {body.name for body in spec.bodies}
    for first, second in pairs:
        if first in bodies and second in bodies:
            spec.add_exclude(bodyname1=first, bodyname2=second)


def list_geom_pairs(spec: mujoco.MjSpec) -> None:
    """Replaces the search for pairs of geoms that may collide by the list of these pairs.

    With few such pairs the list is cheaper than sorting all bodies along an axis at every substep.
    Contact parameters are mixed as MuJoCo mixes them.
    """
    model = spec.compile()
    geoms = {geom.id: geom for geom in spec.geoms}
    for index, geom in geoms.items():
        geom.name = geom.name or f'geom{index}'
    candidates = np.array(collision_candidates(model), dtype=np.intp).reshape(-1, 2)
    mixed = mix(model, candidates[:, 0], candidates[:, 1])
    for number, (first, second) in enumerate(candidates.tolist()):
        pair = spec.add_pair(geomname1=geoms[first].name, geomname2=geoms[second].name)
        for name, values in mixed.items():
            setattr(pair, name, values[number])
    for geom in geoms.values():
        geom.contype = geom.conaffinity = 0


def collision_candidates(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """The pairs of geoms that MuJoCo's filters let collide, ascending, without explicit pairs."""
    listed = set(zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True))
    return [
        (first, second)
        for first, second in itertools.combinations(range(model.ngeom), 2)
        if _masks_match(model, first, second)
        and _bodies_may_collide(model, first, second)
        and (first, second) not in listed
        and (second, first) not in listed
    ]


def skip_unread_stages(model: mujoco.MjModel) -> None:
    """Switches off sensors, which nobody reads, and islands where there is only one."""
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR.value
    if model.ntree == 1:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND.value


def _masks_match(model: mujoco.MjModel, first: int, second: int) -> bool:
    contype, conaffinity = model.geom_contype, model.geom_conaffinity
    return bool(contype[first] & conaffinity[second] or contype[second] & conaffinity[first])


def _bodies_may_collide(model: mujoco.MjModel, first: int, second: int) -> bool:
    """False for one rigid body, parent and child (unless one is the world) and excluded bodies."""
    bodies = sorted((int(model.geom_bodyid[first]), int(model.geom_bodyid[second])))
    if (bodies[0] << 16) + bodies[1] in model.exclude_signature:
        return False
    rigid = [int(model.body_weldid[body]) for body in bodies]
    parents = [int(model.body_weldid[model.body_parentid[body]]) for body in rigid]
    if rigid[0] == rigid[1]:
        return False
    return not (all(rigid) and (rigid[0] == parents[1] or rigid[1] == parents[0]))


def mix(model: mujoco.MjModel, first: Geoms, second: Geoms) -> dict[str, NDArray[Any]]:
    """Contact parameters (n, ...) of pairs of geoms, by the names of `MjsPair`.

    As `mj_contactParam` has them: of the geom with the higher priority, else of both; margins and
    gaps add up.

    Args:
        model: Of the geoms.
        first: (n,) their numbers.
        second: Likewise.
    """
    priority = model.geom_priority
    # Where priorities differ, the geom with the higher one decides: it is mixed with itself.
    ahead = np.sign(priority[first] - priority[second])
    deciding = np.where(ahead < 0, second, first), np.where(ahead > 0, first, second)
    one, other = (
        {name: getattr(model, f'geom_{name}')[geoms] for name in _OF_GEOMS} for geoms in deciding
    )
    share = _share(one['solmix'], other['solmix'])[:, None]
    # Stiffness and damping instead of a time constant are no averages.
    is_direct = (one['solref'][:, :1] <= 0) | (other['solref'][:, :1] <= 0)
    averages = {
        name: share * one[name] + (1.0 - share) * other[name] for name in ('solref', 'solimp')
    }
    return {
        'condim': np.maximum(one['condim'], other['condim']),
        # Along two axes, about one, about two.
        'friction': np.maximum(one['friction'], other['friction'])[:, [0, 0, 1, 2, 2]],
        'margin': model.geom_margin[first] + model.geom_margin[second],
        'gap': model.geom_gap[first] + model.geom_gap[second],
        'solref': np.where(
            is_direct, np.minimum(one['solref'], other['solref']), averages['solref']
        ),
        'solimp': averages['solimp'],
    }


def _rows(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which rows (n,) of flags (n, ...) contain a True."""
    return np.asarray(flags.any(axis=tuple(range(1, flags.ndim))))


def _share(one: NDArray[Any], other: NDArray[Any]) -> NDArray[Any]:
    """Return the weight of the first of two geoms, from both values of `solmix`."""
    small_one, small_other = one < mujoco.mjMINVAL, other < mujoco.mjMINVAL
    weighed = one / np.where(small_one | small_other, 1.0, one + other)
    cases = [small_one & small_other, small_one, small_other]
    return np.select(cases, [0.5, 0.0, 1.0], weighed)


class ListedPairs:
    """The pairs of a model whose parameters are those of their geoms, and stay so.

    Args:
        model: As it was compiled. Pairs whose parameters are their own are left alone.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._first, self._second = model.pair_geom1.copy(), model.pair_geom2.copy()
        mixed = mix(model, self._first, self._second)
        differing = [_rows(_of_pairs(model, name) != values) for name, values in mixed.items()]
        self._is_mixed = ~np.any(differing, axis=0)
        self.note(model)

    def note(self, model: mujoco.MjModel) -> None:
        """Takes pairs and geoms of a model as they are."""
        self._geoms = {name: getattr(model, f'geom_{name}').copy() for name in _OF_GEOMS}

    def follow(self, model: mujoco.MjModel) -> None:
        """Mixes the parameters anew of pairs whose geoms have changed."""
        changed = np.zeros(model.ngeom, dtype=np.bool_)
        for name, before in self._geoms.items():
            changed |= _rows(getattr(model, f'geom_{name}') != before)
        if not changed.any():
            return
        pairs = np.flatnonzero(self._is_mixed & (changed[self._first] | changed[self._second]))
        for name, values in mix(model, self._first[pairs], self._second[pairs]).items():
            _of_pairs(model, name)[pairs] = values
        self.note(model)


def _of_pairs(model: mujoco.MjModel, name: str) -> NDArray[Any]:
    field: NDArray[Any] = getattr(model, 'pair_dim' if name == 'condim' else f'pair_{name}')
    return field
