"""A triangle surface of many worlds on a device: one topology, positions and a search tree per world."""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softwarp.render import raycast
from softwarp.render.surface import smooth_corners

Floats = NDArray[np.float64]


class Layer:
    """Triangles that the ray caster can hit, with smooth normals.

    Fill ``vertex_x`` for some worlds, then call ``surface``.

    Args:
        triangles: Vertex indices, shape (tri, 3); without any, one of no size stands in.
        rest: Positions [m] that decide where the surface has edges, shape (vertex, 3).
        crease: Angle between neighbouring faces that are shaded as an edge [degrees], one or one per triangle.
        device: Warp device.
    """

    def __init__(self, triangles: NDArray[Any], rest: Floats, crease: ArrayLike, device: str) -> None:
        if not len(triangles):
            triangles, rest = np.zeros((1, 3), dtype=np.int32), np.concatenate([rest, np.zeros((1, 3))])
            crease = 0.0
        tri_normal, normal_tri_start, normal_tri = smooth_corners(triangles, rest, crease)
        self.device = device
        with wp.ScopedDevice(device):
            self._tri_vertex = wp.array(triangles, dtype=int)
            self._tri_index = wp.array(triangles.ravel(), dtype=int)
            self._tri_normal = wp.array(tri_normal, dtype=int)
            self._normal_tri_start = wp.array(normal_tri_start, dtype=int)
            self._normal_tri = wp.array(normal_tri, dtype=int)
        self.vertex_count, self._normal_count = len(rest), len(normal_tri_start) - 1
        self._capacity = 0
        self._mesh: list[wp.Mesh] = []

    def reserve(self, count: int) -> wp.array:
        """Room for as many worlds; the array of vertex positions to fill, (world, vertex) of ``vec3``."""
        if self._capacity < count:
            self._mesh = []  # gives back the smaller ones first
            with wp.ScopedDevice(self.device):
                self.vertex_x = wp.zeros((count, self.vertex_count), dtype=wp.vec3)
                self._normal = wp.empty((count, self._normal_count), dtype=wp.vec3)
            self._capacity = count
        return self.vertex_x

    def put(self, points: Any, first: int = 0) -> None:
        """Positions of a run of vertices from ``first`` on [m], shape (world, n, 3)."""
        x = upload(points, self.device)
        if x.size:
            wp.launch(raycast._put, dim=x.shape, inputs=[x, first], outputs=[self.vertex_x], device=self.device)

    def surface(self, count: int, vertex_color: Floats) -> Any:
        """What kernels need to hit and shade the first ``count`` worlds.

        Args:
            count: Worlds whose positions have been filled.
            vertex_color: Linear-light colours, shape (1 or count, vertex, 3).
        """
        wp.launch(
            raycast._smooth_normals,
            dim=(count, self._normal_count),
            inputs=[self._tri_vertex, self._normal_tri_start, self._normal_tri, self.vertex_x],
            outputs=[self._normal],
            device=self.device,
        )
        for mesh in self._mesh[:count]:
            mesh.refit()
        for world in range(len(self._mesh), count):
            self._mesh.append(wp.Mesh(points=self.vertex_x[world], indices=self._tri_index))
        surface = raycast.Surface()
        surface.mesh = wp.array([mesh.id for mesh in self._mesh[:count]], dtype=wp.uint64, device=self.device)
        surface.tri_normal, surface.tri_vertex, surface.normal = self._tri_normal, self._tri_vertex, self._normal
        lacking = self.vertex_count - vertex_color.shape[1]  # the stand-in's
        surface.vertex_color = upload(np.pad(vertex_color, ((0, 0), (0, lacking), (0, 0))), self.device)
        return surface


def no_surface(device: str) -> Any:
    """A surface without triangles."""
    surface = raycast.Surface()
    with wp.ScopedDevice(device):
        surface.mesh = wp.empty(0, dtype=wp.uint64)
        surface.tri_normal = wp.empty((0, 0), dtype=int)
        surface.tri_vertex = wp.empty((0, 0), dtype=int)
        surface.normal = wp.empty((0, 0), dtype=wp.vec3)
        surface.vertex_color = wp.empty((0, 0), dtype=wp.vec3)
    return surface


def upload(values: Any, device: str, dtype: Any = wp.vec3) -> wp.array:
    """Vectors or poses as a Warp array of float32 ``dtype`` on a device; a tensor on that device stays there."""
    if hasattr(values, "detach"):
        values = values.detach()
        if device != "cpu" and values.is_cuda:
            values = values.to(device).float().contiguous()
            wp.synchronize_device(device)  # Torch wrote on a stream of its own
            return wp.from_torch(values, dtype=dtype)
        values = values.cpu().numpy()
    return wp.array(np.ascontiguousarray(values, dtype=np.float32), dtype=dtype, device=device)
