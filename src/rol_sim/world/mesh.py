"""Triangle meshes with a material for each triangle.

World frame: x and y span the town's plane, z points up, metres. The ground lies near z = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np


class Material(IntEnum):
    """What a surface is made of; the sensors look up their own constants by it."""

    NONE = 0  # no surface: the ray left the town
    GROUND = 1  # carriageway
    PAVEMENT = 2  # footways and yards
    GRASS = 3  # gardens and verges
    KERB = 4  # the upright face of the kerb
    FACADE = 5  # brick and stone of houses
    GLASS = 6  # windows
    ROOF = 7  # tiles
    WALL = 8  # garden walls
    METAL = 9  # poles, signs, fences, bollards
    VEHICLE = 10  # bodies of parked and moving vehicles
    HEDGE = 11  # dense leaves: a closed, bumpy body
    TREE_CROWN = 12  # loose leaves: many separate flakes, a ray may pass between them
    TREE_TRUNK = 13  # wood
    PERSON = 14  # people on foot


GROUND_MATERIALS = (Material.GROUND, Material.PAVEMENT, Material.GRASS, Material.KERB)


@dataclass(frozen=True)
class Mesh:
    """Triangles, each with a material and the number of the object it belongs to.

    Attributes
    ----------
    vertices : array, shape (v, 3), float32
        Corners in the world frame [m].
    triangles : array, shape (t, 3), uint32
        Corner numbers of every triangle.
    materials : array, shape (t,), uint8
        `Material` of every triangle.
    objects : array, shape (t,), int32
        Object number of every triangle (one per house, car, tree, ...).
    """

    vertices: np.ndarray
    triangles: np.ndarray
    materials: np.ndarray
    objects: np.ndarray

    @property
    def normals(self) -> np.ndarray:
        """Unit normals of the triangles, shape (t, 3), float32; side by the order of the corners."""
        a, b, c = (self.vertices[self.triangles[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return (normals / np.maximum(length, 1e-12)).astype(np.float32)


def make_mesh(
    vertices: np.ndarray, triangles: np.ndarray, material: np.ndarray | int, object_id: np.ndarray | int = 0
) -> Mesh:
    """Put together a mesh; a single material or object number is repeated for every triangle.

    Parameters
    ----------
    vertices : array, shape (v, 3)
        Corners [m].
    triangles : array, shape (t, 3)
        Corner numbers.
    material : int or array, shape (t,)
        `Material` of the triangles.
    object_id : int or array, shape (t,)
        Object number of the triangles.

    Returns
    -------
    mesh : Mesh
        The mesh.

    Raises
    ------
    ValueError
        If shapes do not fit or a triangle names a corner that does not exist.
    """
    vertices = np.asarray(vertices, dtype=np.float32).reshape(-1, 3)
    triangles = np.asarray(triangles, dtype=np.uint32).reshape(-1, 3)
    if len(triangles) and int(triangles.max()) >= len(vertices):
        raise ValueError(f"mesh: a triangle names corner {int(triangles.max())} of {len(vertices)}")
    materials = np.broadcast_to(np.asarray(material, dtype=np.uint8), len(triangles)).copy()
    objects = np.broadcast_to(np.asarray(object_id, dtype=np.int32), len(triangles)).copy()
    return Mesh(vertices, triangles, materials, objects)


def merge_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """Join meshes into one; materials and object numbers are kept.

    Parameters
    ----------
    meshes : sequence of Mesh
        Any number of meshes, also none.

    Returns
    -------
    mesh : Mesh
        One mesh with all triangles in the order given.
    """
    if not meshes:
        return make_mesh(np.zeros((0, 3)), np.zeros((0, 3)), 0)
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.triangles + np.uint32(o) for m, o in zip(meshes, offsets, strict=True)]),
        np.concatenate([m.materials for m in meshes]),
        np.concatenate([m.objects for m in meshes]),
    )


def move_mesh(mesh: Mesh, pose: np.ndarray, z: float = 0.0, object_id: int | None = None) -> Mesh:
    """Turn a mesh about the vertical and set it down elsewhere.

    Parameters
    ----------
    mesh : Mesh
        Mesh in its own frame.
    pose : array-like, shape (3,)
        Pose of that frame in the plane (x, y, yaw) [m, m, rad].
    z : float
        Height added [m].
    object_id : int or None
        New object number, or None to keep the numbers.

    Returns
    -------
    mesh : Mesh
        The moved mesh.
    """
    x, y, yaw = pose
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    vertices = (mesh.vertices @ R.T + (x, y, z)).astype(np.float32)
    objects = mesh.objects if object_id is None else np.full_like(mesh.objects, object_id)
    return Mesh(vertices, mesh.triangles, mesh.materials, objects)
