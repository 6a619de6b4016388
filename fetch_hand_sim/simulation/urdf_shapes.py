"""What the links of a robot look like, and where they can be touched, in URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from fetch_hand_sim.simulation.models import geom_color
from msgs_spec.arrays import Array
from msgs_spec.rotations import quaternion_multiply, quaternion_to_matrix

_GEOM = mujoco.mjtGeom
# Groups that MuJoCo draws unless told otherwise.
_DRAWN_GROUPS = (0, 1, 2)


def numbers(values: ArrayLike) -> str:
    """Returns numbers as URDF writes them."""
    return ' '.join(f'{value:.12g}' for value in np.asarray(values, dtype=np.float64))


def add_shapes(
    link: ElementTree.Element, mjcf: mujoco.MjSpec, model: mujoco.MjModel, body: int
) -> None:
    """Adds `visual` and `collision` elements for the geoms of a body."""
    first = int(model.body_geomadr[body])
    for geom in range(first, first + int(model.body_geomnum[body])):
        touches = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
        is_drawn = int(model.geom_group[geom]) in _DRAWN_GROUPS
        for shape, position, quaternion in _shapes(mjcf, model, geom):
            for kind in [*(['visual'] if is_drawn else []), *(['collision'] if touches else [])]:
                element = ElementTree.SubElement(link, kind)
                add_origin(element, position, quaternion)
                ElementTree.SubElement(element, 'geometry').append(shape)
                if kind == 'visual':
                    _add_color(element, model, geom)


def _shapes(
    mjcf: mujoco.MjSpec, model: mujoco.MjModel, geom: int
) -> Iterator[tuple[ElementTree.Element, Array, Array]]:
    """The shapes of a geom with their poses in the body; URDF knows no capsule."""
    position, quaternion = model.geom_pos[geom].copy(), model.geom_quat[geom].copy()
    size = model.geom_size[geom]
    kind = int(model.geom_type[geom])
    if kind == _GEOM.mjGEOM_MESH.value:
        yield _mesh(mjcf, model, int(model.geom_dataid[geom]), position, quaternion)
    elif kind == _GEOM.mjGEOM_BOX.value:
        yield ElementTree.Element('box', size=numbers(2.0 * size)), position, quaternion
    elif kind == _GEOM.mjGEOM_SPHERE.value:
        yield _sphere(size[0]), position, quaternion
    elif kind in (_GEOM.mjGEOM_CYLINDER.value, _GEOM.mjGEOM_CAPSULE.value):
        length = {'radius': f'{size[0]:.9g}', 'length': f'{2.0 * size[1]:.9g}'}
        yield ElementTree.Element('cylinder', length), position, quaternion
        if kind == _GEOM.mjGEOM_CAPSULE.value:
            along = quaternion_to_matrix(quaternion)[:, 2] * size[1]
            yield _sphere(size[0]), position + along, quaternion
            yield _sphere(size[0]), position - along, quaternion


def _sphere(radius: float) -> ElementTree.Element:
    return ElementTree.Element('sphere', radius=f'{radius:.9g}')


def _mesh(
    mjcf: mujoco.MjSpec, model: mujoco.MjModel, mesh: int, position: Array, quaternion: Array
) -> tuple[ElementTree.Element, Array, Array]:
    """The file of a mesh, posed: MuJoCo has moved its points to the centre and axes of inertia."""
    source: Any = mjcf.mesh(model.mesh(mesh).name)
    path = (Path(mjcf.modelfiledir) / mjcf.meshdir / source.file).resolve()
    back = np.array([1.0, -1.0, -1.0, -1.0]) * model.mesh_quat[mesh]
    turn = quaternion_multiply(quaternion, back)
    place = position - quaternion_to_matrix(turn) @ model.mesh_pos[mesh]
    element = ElementTree.Element('mesh', filename=path.as_uri(), scale=numbers(source.scale))
    return element, place, turn


def _add_color(element: ElementTree.Element, model: mujoco.MjModel, geom: int) -> None:
    named = ElementTree.SubElement(element, 'material', name=f'geom{geom}')
    ElementTree.SubElement(named, 'color', rgba=numbers(geom_color(model, geom)))


def add_origin(element: ElementTree.Element, position: ArrayLike, quaternion: ArrayLike) -> None:
    """Adds an `origin` with URDF's roll, pitch and yaw."""
    ElementTree.SubElement(
        element, 'origin', xyz=numbers(position), rpy=numbers(roll_pitch_yaw(quaternion))
    )


def roll_pitch_yaw(quaternion: ArrayLike) -> Array:
    """URDF's angles (3,), radians, of a unit quaternion wxyz: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    m = quaternion_to_matrix(quaternion)
    cosine = np.hypot(m[0, 0], m[1, 0])
    if cosine > 1e-9:
        roll, yaw = np.arctan2(m[2, 1], m[2, 2]), np.arctan2(m[1, 0], m[0, 0])
    else:
        roll, yaw = np.arctan2(-m[1, 2], m[1, 1]), 0.0
    return np.array([roll, np.arctan2(-m[2, 0], cosine), yaw])
