"""Find, compile and tune the MJCF models of the installed `gymnasium-robotics` package.

Only the assets of this package are used. The package is never imported, because the import with
MuJoCo >= 3.17 registers environments that do not start.

Tuning makes a model faster to step; trajectories stay the same, bit for bit. It disables stages
of a step whose results are unused. It also reduces the pairs of geoms that collision detection
tests; contacts and their order stay the same. `docs/simulation.md` lists the gains.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from importlib import util
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from msgs_spec.arrays import Array

Geoms = NDArray[np.integer[Any]]

# Default `rgba` of geoms in MuJoCo.
_NO_COLOR = np.array([0.5, 0.5, 0.5, 1.0])
# Fields of geoms from which MuJoCo mixes the parameters of a contact.
_OF_GEOMS = ('condim', 'friction', 'margin', 'gap', 'solref', 'solimp', 'solmix', 'priority')
# Pairs of Fetch bodies that pass the bounding tests at most steps but stay more than 1 cm apart,
# even 0.3 rad beyond the joint limits (`test_model_tuning.py` samples these positions). The limits
# are soft; overshoots of 0.13 rad have been measured.
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


def asset_path(relative: str) -> Path:
    """Return the path of an asset such as `fetch/reach.xml`; absolute paths are returned unchanged.

    Raises:
        FileNotFoundError: If the asset, or the package that contains it, is missing.
    """
    if Path(relative).is_absolute():
        return Path(relative)
    spec = util.find_spec('gymnasium_robotics')
    if spec is None or spec.origin is None:
        raise FileNotFoundError(
            'the robot models come with the Python package gymnasium-robotics, which is not '
            'installed: pip install gymnasium-robotics==1.4.2'
        )
    path = Path(spec.origin).parent / 'envs' / 'assets' / relative
    if not path.exists():
        raise FileNotFoundError(f'gymnasium-robotics has no asset {relative!r}: {path} is missing')
    return path


def load_spec(relative: str) -> mujoco.MjSpec:
    """Read an MJCF asset, such as `hand/reach.xml`, for editing and compiling."""
    return mujoco.MjSpec.from_file(str(asset_path(relative)))


def load_model(relative: str) -> mujoco.MjModel:
    """Compile an MJCF asset, such as `hand/reach.xml`, without changes for faster steps."""
    return load_spec(relative).compile()


def compiled_bytes(model: mujoco.MjModel) -> bytes:
    """Return the model in the binary format MJB, which only the same MuJoCo version reads."""
    buffer = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def find(model: mujoco.MjModel, kind: Any, name: str) -> int:
    """Return the index of element `name`, -1 if missing; `kind` is for example `mjOBJ_BODY`."""
    return int(mujoco.mj_name2id(model, kind.value, name))


def free_joint(model: mujoco.MjModel, body: str | None) -> tuple[slice, slice] | tuple[None, None]:
    """Return the qpos and qvel slices of the free joint `<body>:joint`; (None, None) without it."""
    number = find(model, mujoco.mjtObj.mjOBJ_JOINT, f'{body}:joint')
    if number < 0 or model.jnt_type[number] != mujoco.mjtJoint.mjJNT_FREE.value:
        return None, None
    qpos, qvel = int(model.jnt_qposadr[number]), int(model.jnt_dofadr[number])
    return slice(qpos, qpos + 7), slice(qvel, qvel + 6)


def geom_color(model: mujoco.MjModel, geom: int) -> Array:
    """Return the RGBA colour (4,), 0 ... 1, of a geom, or of its material if its own is default."""
    own = np.array(model.geom_rgba[geom], dtype=np.float64)
    material = int(model.geom_matid[geom])
    if material < 0 or not np.array_equal(own, _NO_COLOR):
        return own
    return np.array(model.mat_rgba[material], dtype=np.float64)


# Tuning


def exclude_body_pairs(spec: mujoco.MjSpec, pairs: Sequence[tuple[str, str]]) -> None:
    """Exclude pairs of bodies, by name, from collision tests; skip pairs with unknown bodies."""
    bodies = {body.name for body in spec.bodies}
    for first, second in pairs:
        if first in bodies and second in bodies:
            spec.add_exclude(bodyname1=first, bodyname2=second)


def list_geom_pairs(spec: mujoco.MjSpec) -> None:
    """Replace MuJoCo's search for geoms that may collide by `<pair>` elements, in place.

    All geoms must be in `spec` already. A list is cheaper than sorting bodies at every substep.
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
    """Return sorted pairs of geom indices that MuJoCo tests, except those of `<pair>` elements."""
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
    """Disable sensors of `model`, and constraint islands if it has a single kinematic tree."""
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR.value
    if model.ntree == 1:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND.value


def _masks_match(model: mujoco.MjModel, first: int, second: int) -> bool:
    contype, conaffinity = model.geom_contype, model.geom_conaffinity
    return bool(contype[first] & conaffinity[second] or contype[second] & conaffinity[first])


def _bodies_may_collide(model: mujoco.MjModel, first: int, second: int) -> bool:
    """Return whether the bodies of geoms `first` and `second` allow MuJoCo to test these geoms.

    MuJoCo skips bodies that are welded together, that are parent and child (unless the parent is
    the world), or that the model excludes.
    """
    bodies = sorted((int(model.geom_bodyid[first]), int(model.geom_bodyid[second])))
    if (bodies[0] << 16) + bodies[1] in model.exclude_signature:
        return False
    rigid = [int(model.body_weldid[body]) for body in bodies]
    parents = [int(model.body_weldid[model.body_parentid[body]]) for body in rigid]
    if rigid[0] == rigid[1]:
        return False
    return not (all(rigid) and (rigid[0] == parents[1] or rigid[1] == parents[0]))


def mix(model: mujoco.MjModel, first: Geoms, second: Geoms) -> dict[str, NDArray[Any]]:
    """Return the contact parameters (n, ...) of n pairs of geom indices, by names of `MjsPair`.

    The result equals that of `mj_contactParam`. The geom with the higher priority decides. The
    parameters of geoms with equal priority are mixed. Margins and gaps add up.
    """
    priority = model.geom_priority
    # A geom with the higher priority is mixed with itself.
    ahead = np.sign(priority[first] - priority[second])
    deciding = np.where(ahead < 0, second, first), np.where(ahead > 0, first, second)
    one, other = (
        {name: getattr(model, f'geom_{name}')[geoms] for name in _OF_GEOMS} for geoms in deciding
    )
    share = _share(one['solmix'], other['solmix'])[:, None]
    # Negative values are stiffness and damping, which MuJoCo does not average.
    is_direct = (one['solref'][:, :1] <= 0) | (other['solref'][:, :1] <= 0)
    averages = {
        name: share * one[name] + (1.0 - share) * other[name] for name in ('solref', 'solimp')
    }
    return {
        'condim': np.maximum(one['condim'], other['condim']),
        # Two sliding axes, one torsional, two rolling.
        'friction': np.maximum(one['friction'], other['friction'])[:, [0, 0, 1, 2, 2]],
        'margin': model.geom_margin[first] + model.geom_margin[second],
        'gap': model.geom_gap[first] + model.geom_gap[second],
        'solref': np.where(
            is_direct, np.minimum(one['solref'], other['solref']), averages['solref']
        ),
        'solimp': averages['solimp'],
    }


def _rows(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Reduce flags (n, ...) to (n,), True where any flag of the row is True."""
    return np.asarray(flags.any(axis=tuple(range(1, flags.ndim))))


def _share(one: NDArray[Any], other: NDArray[Any]) -> NDArray[Any]:
    """Return weights (n,), 0 ... 1, of first geoms in a mix; arguments are the `solmix` of both."""
    small_one, small_other = one < mujoco.mjMINVAL, other < mujoco.mjMINVAL
    weighed = one / np.where(small_one | small_other, 1.0, one + other)
    cases = [small_one & small_other, small_one, small_other]
    return np.select(cases, [0.5, 0.0, 1.0], weighed)


class ListedPairs:
    """Updates contact parameters of `<pair>` elements when parameters of their geoms change.

    A pair is never changed if its parameters differed from the mix of its geoms at construction.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._first, self._second = model.pair_geom1.copy(), model.pair_geom2.copy()
        mixed = mix(model, self._first, self._second)
        differing = [_rows(_of_pairs(model, name) != values) for name, values in mixed.items()]
        self._is_mixed = ~np.any(differing, axis=0)
        self.note(model)

    def note(self, model: mujoco.MjModel) -> None:
        """Store the geom parameters with which `follow` compares later ones."""
        self._geoms = {name: getattr(model, f'geom_{name}').copy() for name in _OF_GEOMS}

    def follow(self, model: mujoco.MjModel) -> None:
        """Recompute, in place, pairs whose geoms changed since the last `note` or `follow`."""
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
