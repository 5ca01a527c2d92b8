"""Ray casting in the simulated world: the first hit of every ray, by Open3D's ray casting scene (Embree).

A `Scene` holds the big standing town and, apart from it, the few moving vehicles. `Scene.with_moving`
exchanges only the latter, which takes about a millisecond, while the search structure of the town is shared.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rol_sim.world.mesh import Mesh, merge_meshes

if TYPE_CHECKING:
    from open3d.core import Tensor

# Without it Open3D prints into every notebook.
os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")


@dataclass(frozen=True)
class Hits:
    """First hit of every ray.

    Attributes
    ----------
    t : array, shape (n,), float32
        Distance in lengths of the ray's direction vector [m for unit directions]; inf where nothing was hit.
    material : array, shape (n,), uint8
        `Material` of the surface; `Material.NONE` (0) where nothing was hit.
    normals : array, shape (n, 3), float32
        Unit normal of the surface on the side of the ray's origin; zero where nothing was hit.
    object_id : array, shape (n,), int32
        Object number; -1 where nothing was hit.
    cos_incidence : array, shape (n,), float32
        Cosine between the ray and the normal, 0 (grazing) .. 1 (head-on); 0 where nothing was hit.
    """

    t: np.ndarray
    material: np.ndarray
    normals: np.ndarray
    object_id: np.ndarray
    cos_incidence: np.ndarray


class _Part:
    """One mesh with its search structure."""

    def __init__(self, mesh: Mesh, threads: int) -> None:
        import open3d as o3d

        self.mesh, self.normals, self.threads = mesh, mesh.normals, threads
        self.caster = o3d.t.geometry.RaycastingScene(nthreads=threads)
        self.caster.add_triangles(o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.triangles))

    def first_hits(self, rays: Tensor) -> tuple[np.ndarray, np.ndarray]:
        found = self.caster.cast_rays(rays, nthreads=self.threads)
        return found["t_hit"].numpy(), found["primitive_ids"].numpy()


class Scene:
    """Static world and moving bodies, for ray casting.

    Parameters
    ----------
    meshes : Mesh or sequence of Mesh
        The static part.
    threads : int
        Threads for ray casting; 1 leaves the other cores to other sessions.

    Raises
    ------
    ValueError
        If the standing part has no triangle.
    """

    def __init__(self, meshes: Mesh | Sequence[Mesh], *, threads: int = 1) -> None:
        mesh = _as_one(meshes)
        if len(mesh.triangles) == 0:
            raise ValueError("scene: the standing part has no triangle")
        self._threads = threads
        self._parts = [_Part(mesh, threads)]

    @property
    def static_mesh(self) -> Mesh:
        """The static part."""
        return self._parts[0].mesh

    def with_moving(self, meshes: Mesh | Sequence[Mesh]) -> Scene:
        """Return a scene with the same static part and these moving bodies.

        Parameters
        ----------
        meshes : Mesh or sequence of Mesh
            Where the moving bodies are now; none leaves the standing part alone.

        Returns
        -------
        scene : Scene
            A new scene; this one is unchanged.
        """
        mesh = _as_one(meshes)
        scene = object.__new__(Scene)
        scene._threads = self._threads
        scene._parts = self._parts[:1] + ([_Part(mesh, self._threads)] if len(mesh.triangles) else [])
        return scene

    def cast(self, rays: np.ndarray) -> Hits:
        """Find the first surface on every ray.

        Parameters
        ----------
        rays : array, shape (n, 6), float32
            Origin and direction of every ray in the world frame [m].

        Returns
        -------
        hits : Hits
            One entry per ray.
        """
        rays, tensor = _as_rays(rays)
        n = len(rays)
        t, material = np.full(n, np.inf, dtype=np.float32), np.zeros(n, dtype=np.uint8)
        normals, object_id = np.zeros((n, 3), dtype=np.float32), np.full(n, -1, dtype=np.int32)
        for part in self._parts:
            t_part, triangle = part.first_hits(tensor)
            nearer = np.flatnonzero(t_part < t)
            triangle = triangle[nearer]
            t[nearer] = t_part[nearer]
            material[nearer], object_id[nearer] = part.mesh.materials[triangle], part.mesh.objects[triangle]
            normals[nearer] = part.normals[triangle]
        normals, cos_incidence = _face_origin(normals, rays[:, 3:])
        return Hits(t, material, normals, object_id, cos_incidence)


def _as_one(meshes: Mesh | Sequence[Mesh]) -> Mesh:
    return meshes if isinstance(meshes, Mesh) else merge_meshes(list(meshes))


def _as_rays(rays: np.ndarray) -> tuple[np.ndarray, Tensor]:
    import open3d as o3d

    rays = np.ascontiguousarray(rays, dtype=np.float32)
    if rays.ndim != 2 or rays.shape[1] != 6:
        raise ValueError(f"rays: expected shape (n, 6) for origin and direction, got {rays.shape}")
    return rays, o3d.core.Tensor.from_numpy(rays)


def _face_origin(normals: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turn normals against the rays; return also the cosine of incidence."""
    along = np.einsum("ij,ij->i", normals, directions)
    length = np.sqrt(np.einsum("ij,ij->i", directions, directions))
    cos_incidence = np.abs(along) / np.maximum(length, 1e-12)
    return np.where(along[:, None] > 0, -normals, normals), np.minimum(cos_incidence, 1.0).astype(np.float32)
