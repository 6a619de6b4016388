"""Contact parameters of pairs of geoms, mixed of those of the geoms as MuJoCo mixes them.

A listed pair has parameters of its own, so that MuJoCo looks no more at those of its geoms. Who
writes these into a model that came from a list means the contacts all the same.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

Geoms = NDArray[np.integer[Any]]

# What is mixed, as `MjModel` and `MjsPair` name it, and what says how.
_OF_GEOMS = ('condim', 'friction', 'margin', 'gap', 'solref', 'solimp', 'solmix', 'priority')


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
    """Rows (n,) of flags (n, ...) in which there is one."""
    return np.asarray(flags.any(axis=tuple(range(1, flags.ndim))))


def _share(one: NDArray[Any], other: NDArray[Any]) -> NDArray[Any]:
    """What the first of two geoms contributes, by what both weigh."""
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
