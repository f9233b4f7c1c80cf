"""Objects that can touch, their features and targets, and the pairs between them, as arrays for the device."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import meshing
from softwarp.model.codes import BALL_RANKS, CORNER, EDGE, ENDLESS, FACE, FLAT, SUM_OF_POINTS, WORLD, Carrier, Target
from softwarp.model.contact import CollisionScene, Couple, Entity
from softwarp.shapes.base import FloatArray, Kind, Shape, rotation_matrix
from softwarp.shapes.mesh import Mesh
from softwarp.shapes.one_of import OneOf

IntArray = NDArray[np.integer[Any]]
ANY = CORNER | EDGE | FACE | FLAT
INSET = 0.02  # of a corner or an edge into its body, relative to the smallest extent (rigid) or to an edge (soft)
DEPTH = 0.5  # penetration that still counts, relative to the smallest extent of a mesh
ROUND = (Kind.PLANE, Kind.SPHERE, Kind.CAPSULE, Target.CHAIN)  # what has no corners
RANKS = 3  # contacts of one point with a surface that is not convex


class CollisionBuilder(CollisionScene):
    """A collision scene that is being filled.

    Every ``add_...`` returns the number of the new object. ``pair`` names the objects that may touch each other; its
    number is the row of the pair's parameters.
    """

    def add_shape(
        self,
        frame: int,
        shape: Shape,
        position: ArrayLike = (0.0, 0.0, 0.0),
        quaternion: ArrayLike = (0.0, 0.0, 0.0, 1.0),
        *,
        name: str = "shape",
        number: int | None = None,
    ) -> int:
        """A rigid shape on a frame.

        Args:
            frame: Frame that carries it, or ``WORLD``.
            shape: Any shape but a compound; add its ``parts()`` one by one.
            position: Origin of the shape in the frame [m].
            quaternion: Its orientation (x, y, z, w).
            name: What messages call it.
            number: Of the choice of a shape that is one of several; None counts on.

        Raises:
            ValueError: For a compound.
        """
        if shape.kind == Kind.COMPOUND:
            raise ValueError(f"{name}: a compound is added part by part: for part in shape.parts(): add_shape(...)")
        x, R = np.asarray(position, dtype=np.float64), rotation_matrix(quaternion)
        if shape.kind == Kind.PLANE:
            centre, extent = np.zeros(3), np.full(3, ENDLESS)
        else:
            low, high = shape.reach if isinstance(shape, OneOf) else shape.bounds
            centre, extent = R @ (0.5 * (low + high)) + x, np.abs(R) @ (0.5 * (high - low))
        depth = 0.5 * float(np.min(shape.bounds[1] - shape.bounds[0]))
        first_face = len(self.faces)
        points, edges = self._shape_features(frame, shape, x, R, INSET * 2.0 * depth)
        faces, target = (first_face, len(self.faces)), len(self.targets)
        if shape.kind == Kind.MESH:  # its corners are points in the frame
            self._add_target(int(shape.kind), frame, np.zeros(3), (0, 0, 0, 1), shape.size, depth, faces)
        elif shape.kind == Kind.GRID:
            self._add_target(int(shape.kind), frame, x, quaternion, shape.size, grid=shape)
        else:
            self._add_target(int(shape.kind), frame, x, quaternion, shape.size)
        choice: dict[str, int] = {}
        if isinstance(shape, OneOf):
            choice = {"choice": self.choice_count if number is None else number, "choices": len(shape.alternatives)}
            self.choice_count = max(self.choice_count, choice["choice"] + 1)
            for mesh in shape.alternatives[1:]:
                self._add_alternative(frame, mesh, x, R)
        convex = shape.kind not in (Kind.MESH, Kind.GRID) or bool(getattr(shape, "convex", False))
        if isinstance(shape, Mesh) and not convex:
            choice["sheet"] = shape.sheet
        rest = (convex, centre, extent, depth)
        return self._add(Entity(name, frame, points, edges, target, int(shape.kind), *rest, **choice))  # type: ignore[arg-type]

    def _add_alternative(self, frame: int, mesh: Shape, x: FloatArray, R: FloatArray) -> None:
        """Another mesh that an object may have as its target; nothing but faces of it is ever searched."""
        depth = 0.5 * float(np.min(mesh.bounds[1] - mesh.bounds[0]))
        first_face = len(self.faces)
        self._shape_features(frame, mesh, x, R, INSET * 2.0 * depth)
        faces = (first_face, len(self.faces))
        self._add_target(int(mesh.kind), frame, np.zeros(3), (0, 0, 0, 1), mesh.size, depth, faces)

    def add_soft_surface(
        self, triangles: ArrayLike, rest: ArrayLike, *, skin: float = 0.0, name: str = "soft body"
    ) -> int:
        """The outer surface of a soft body.

        Args:
            triangles: Corners, node numbers, counter-clockwise from outside, shape (t, 3).
            rest: Rest positions of all nodes [m], shape (node, 3).
            skin: Radius of the balls and capsules around vertices and edges [m].
            name: What messages call it.
        """
        corner = np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
        x = np.asarray(rest, dtype=np.float64).reshape(-1, 3)
        nodes, corner = np.unique(corner, return_inverse=True)
        corner = corner.reshape(-1, 3)
        used = x[nodes]
        edge_length = meshing.mean_edge(used, corner)
        first = len(self.points)
        for node in nodes:
            self._add_point(Carrier.NODE, int(node), inset=(INSET * edge_length, 0.0, 0.0), radius=skin, rest=x[node])
        first_face = len(self.faces)
        edges = self._add_surface(first, corner, INSET * edge_length, skin)
        faces, target = (first_face, len(self.faces)), len(self.targets)
        extent = 0.5 * (used.max(axis=0) - used.min(axis=0))
        still, depth = (0.0, 0.0, 0.0, 1.0), DEPTH * 2.0 * float(extent.min())
        self._add_target(Target.SOFT, WORLD, np.zeros(3), still, (0.0, 0.0, 0.0), depth, faces)
        points = (first, len(self.points))
        entity = Entity(
            name,
            SUM_OF_POINTS,
            points,
            edges,
            target,
            Target.SOFT,
            False,
            np.zeros(3),
            extent,
            float(extent.min()),
            edge_length,
        )
        return self._add(entity)

    def add_soft_points(self, nodes: ArrayLike, rest: ArrayLike, *, name: str = "soft body") -> int:
        """Points of a soft body that touch shapes, surfaces and rods, but that nothing can touch between them.

        Args:
            nodes: Numbers of nodes or embedded points.
            rest: Rest positions of all nodes and embedded points [m], shape (node, 3).
            name: What messages call it.
        """
        x = np.asarray(rest, dtype=np.float64).reshape(-1, 3)
        first = len(self.points)
        for node in np.asarray(nodes):
            self._add_point(Carrier.NODE, int(node), rest=x[node])
        extent = 0.5 * np.ptp(x[np.asarray(nodes)], axis=0)
        points, none = (first, len(self.points)), (len(self.edges), len(self.edges))
        radius = float(extent.min())
        return self._add(
            Entity(name, SUM_OF_POINTS, points, none, -1, Target.POINTS, False, np.zeros(3), extent, radius)
        )

    def add_rod(self, frames: ArrayLike, radius: ArrayLike, rest: ArrayLike, *, name: str = "rod") -> int:
        """A rod: a chain of capsules between the origins of consecutive frames.

        Args:
            frames: Frames along the rod, shape (n,).
            radius: Radius of every segment [m], a number or shape (n - 1,).
            rest: Start positions of the frames' origins [m], shape (n, 3).
            name: What messages call it.
        """
        chain = np.asarray(frames, dtype=np.int64).reshape(-1)
        radii = np.array(np.broadcast_to(np.asarray(radius, dtype=np.float64), len(chain) - 1))
        x = np.asarray(rest, dtype=np.float64).reshape(-1, 3)
        around = np.concatenate([radii[:1], np.maximum(radii[1:], radii[:-1]), radii[-1:]])
        first, first_edge = len(self.points), len(self.edges)
        for frame, r, place in zip(chain, around, x, strict=True):
            self._add_point(Carrier.FRAME, int(frame), radius=float(r), rest=place)
        first_face = len(self.faces)
        for k, r in enumerate(radii):
            two, edge = (first + k, first + k + 1), len(self.edges)
            self.edges.add(point=two, radius=float(r), face=(-1, -1), inset=np.zeros(3))
            self.faces.add(corner=(*two, -1), beside=(-1, -1, -1), edge=(edge, -1, -1), radius=float(r))
        faces, target = (first_face, len(self.faces)), len(self.targets)
        self._add_target(Target.CHAIN, WORLD, np.zeros(3), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), faces=faces)
        points, edges = (first, len(self.points)), (first_edge, len(self.edges))
        extent = 0.5 * (x.max(axis=0) - x.min(axis=0)) + float(radii.max())
        clear = max(float(np.linalg.norm(np.diff(x, axis=0), axis=1).mean()), 4.0 * float(radii.max()))
        entity = Entity(
            name,
            SUM_OF_POINTS,
            points,
            edges,
            target,
            Target.CHAIN,
            False,
            np.zeros(3),
            extent,
            float(radii.min()),
            clear,
        )
        return self._add(entity)

    def pair(self, a: int | Iterable[int], b: int | Iterable[int]) -> int:
        """Let objects of two bodies touch; each body may consist of several objects. a = b means self-contact.

        Returns:
            Number of the pair.

        Raises:
            ValueError: If nothing of the two can touch: two planes, two objects fixed in the world.
        """
        pair = self.pair_count
        before = len(self.couples)
        left, right = _several(a), _several(b)
        if left == right:
            for k, i in enumerate(left):
                for j in left[k:]:
                    self._couple(i, j, pair)
        else:
            for i in left:
                for j in right:
                    self._couple(i, j, pair)
        if len(self.couples) == before:
            names = " and ".join(self.entities[ids[0]].name for ids in (left, right))
            raise ValueError(f"contact of {names}: nothing of the two can touch each other; leave the pair out")
        self.pair_count += 1
        return pair

    # Features

    def _add(self, entity: Entity) -> int:
        self.entities.append(entity)
        return len(self.entities) - 1

    def _add_point(
        self,
        kind: int,
        index: int,
        local: ArrayLike = (0.0, 0.0, 0.0),
        inset: ArrayLike = (0.0, 0.0, 0.0),
        axis: ArrayLike = (0.0, 0.0, 0.0),
        radius: float = 0.0,
        quarter: int = 0,
        rest: ArrayLike = (0.0, 0.0, 0.0),
    ) -> int:
        self.points.add(
            kind=kind, index=index, local=local, inset=inset, axis=axis, radius=radius, quarter=quarter, rest=rest
        )
        return len(self.points) - 1

    def _add_target(
        self,
        kind: int,
        frame: int,
        x: FloatArray,
        quaternion: ArrayLike,
        size: Sequence[float],
        depth: float = ENDLESS,
        faces: tuple[int, int] = (0, 0),
        grid: Any = None,
    ) -> None:
        nodes, origin, spacing, start = (0, 0, 0), np.zeros(3), 1.0, 0
        if grid is not None:
            start = sum(len(values) for values in self.grid_values)
            self.grid_values.append(np.asarray(grid.values).reshape(-1))
            nodes, origin, spacing = grid.values.shape, np.asarray(grid.origin), float(grid.spacing)
        self.targets.add(
            kind=kind,
            frame=frame,
            x=x,
            q=np.asarray(quaternion, float),
            size=size,
            depth=depth,
            faces=faces,
            grid=(start, *nodes),
            origin=origin,
            spacing=spacing,
        )

    def _shape_features(
        self, frame: int, shape: Shape, x: FloatArray, R: FloatArray, inset: float
    ) -> tuple[tuple[int, int], tuple[int, int]]:
        """Points and edges of a shape, in the coordinates of its frame."""
        first, first_edge = len(self.points), len(self.edges)
        if shape.kind == Kind.CYLINDER:
            self._cylinder_features(frame, shape, x, R, inset)
        elif shape.kind in (Kind.BOX, Kind.MESH):
            vertices, triangles = shape.surface()
            place = vertices @ R.T + x
            for p, n in zip(place, _vertex_normals(place, triangles), strict=True):
                self._add_point(Carrier.FRAME, frame, local=p, inset=-inset * n)
            angle = float(getattr(shape, "feature_angle", 5.0))
            self._add_surface(first, np.asarray(triangles, np.int64), inset, 0.0, place, angle)
        else:
            features = shape.features().moved(x, _quaternion(R))
            for p, r in zip(features.points, features.point_radius, strict=True):
                self._add_point(Carrier.FRAME, frame, local=p, radius=float(r))
            last = len(self.points)
            for ends, r in zip(features.edges, features.edge_radius, strict=True):
                two = [self._add_point(Carrier.FRAME, frame, local=p, radius=float(r)) for p in ends]
                self.edges.add(point=two, radius=float(r), face=(-1, -1), inset=np.zeros(3))
            return (first, last), (first_edge, len(self.edges))
        last = len(self.points)
        if shape.kind == Kind.CYLINDER:
            last -= 2  # the ends of the axis carry the edge and do not touch themselves
        return (first, last), (first_edge, len(self.edges))

    def _cylinder_features(self, frame: int, shape: Shape, x: FloatArray, R: FloatArray, inset: float) -> None:
        """Four points of each rim, found anew at every step, and the axis as a round edge."""
        radius, length = shape.size[0], shape.size[1]
        ends = []
        for side in (-0.5, 0.5):
            centre = x + R @ (0.0, 0.0, side * length)
            ends.append(centre)
            for quarter in range(4):
                depth = R @ (0.0, 0.0, -np.sign(side) * inset)
                axis = R @ (0.0, 0.0, radius)
                self._add_point(Carrier.RIM, frame, local=centre, inset=depth, axis=axis, quarter=quarter)
        two = [self._add_point(Carrier.FRAME, frame, local=p, radius=radius) for p in ends]
        self.edges.add(point=two, radius=radius, face=(-1, -1), inset=np.zeros(3))

    def _add_surface(
        self,
        first: int,
        corner: IntArray,
        inset: float,
        skin: float,
        place: FloatArray | None = None,
        angle: float = 0.0,
    ) -> tuple[int, int]:
        """Faces of a surface whose vertices are the points from ``first`` on, and its edges.

        Of a rigid surface (``place`` gives its vertices) only the edges become features along which it protrudes by
        more than ``angle`` [degree].
        """
        first_face, first_edge = len(self.faces), len(self.edges)
        beside, pairs = _neighbours(corner)
        own = np.full(corner.shape, -1, dtype=np.int64)
        normals = None if place is None else _normals(place, corner)
        for (f, k), (g, _) in pairs:
            i, j = corner[f, k], corner[f, (k + 1) % 3]
            direction = np.array([inset, 0.0, 0.0])
            if place is not None and normals is not None:
                m = normals[f] + (normals[g] if g >= 0 else 0.0)
                direction = -inset * m / max(float(np.linalg.norm(m)), 1e-12)
                if g >= 0:
                    opposite = place[corner[g]].sum(axis=0) - place[i] - place[j]
                    bend = np.degrees(np.arccos(np.clip(normals[f] @ normals[g], -1.0, 1.0)))
                    if bend <= angle or normals[f] @ (opposite - place[i]) >= 0.0:
                        continue
            own[f, k] = len(self.edges)
            faces = (first_face + f, first_face + g if g >= 0 else -1)
            self.edges.add(point=(first + i, first + j), radius=skin, face=faces, inset=direction)
        for f, corners in enumerate(corner):
            across = [first_face + g if g >= 0 else -1 for g in beside[f]]
            self.faces.add(corner=first + corners, beside=across, edge=own[f], radius=skin)
        return first_edge, len(self.edges)

    # Pairs

    def _couple(self, i: int, j: int, pair: int) -> None:
        """Couples of two objects: enough to find every way in which they can touch, each of them once.

        The second object is the one with more dimensions: points and edges of balls, capsules and rods against it
        find everything. Where both have faces, corners of the second against faces of the first are added. What a
        corner touches at a corner is found from one side only.
        """
        a, b = self.entities[i], self.entities[j]
        for one, other in ((a, b), (b, a)):
            if one.choice >= 0 and other.kind != Kind.SPHERE:
                raise ValueError(
                    f"contact of {one.name} and {other.name}: only balls can touch a shape that is one of several; "
                    f"give {other.name} the shape of a Sphere, or {one.name} a single mesh"
                )
            if one.sheet >= 0 and other.kind not in ROUND:
                raise ValueError(
                    f"contact of {one.name} and {other.name}: triangle {one.sheet} of {one.name} lies on another one "
                    "that faces the other way; such a sheet without thickness holds balls, capsules and rods, but "
                    "corners pass it; give it a thickness"
                )
        if i == j:
            self._couple_own(i, pair)
            return
        if a.frame == b.frame and a.frame >= WORLD:
            return
        if Target.POINTS in (a.kind, b.kind):
            self._couple_points(i, j, pair)
            return
        if (_rank(a), -len(range(*a.edges))) > (_rank(b), -len(range(*b.edges))):
            a, b, i, j = b, a, j, i
        ranks = RANKS if b.kind == Kind.MESH and not b.convex else 1
        if b.kind == Kind.PLANE:
            self._add_couple(Couple(i, j, pair, False, ANY))
        elif a.kind == Kind.SPHERE:
            ranks = BALL_RANKS if ranks > 1 else 1
            self._add_couple(Couple(i, j, pair, False, FACE | EDGE if b.kind == Target.SOFT else ANY, ranks))
            if b.kind in (Target.SOFT, Target.CHAIN):
                self._add_couple(Couple(j, i, pair, False, ANY))
            if b.kind == Target.CHAIN:
                self.couples.pop(-2)
                self._add_couple(Couple(j, i, pair, True, ANY, 2))
        elif a.kind == Kind.CAPSULE:
            self._couple_capsule(i, j, pair, ranks)
        elif a.kind == Target.CHAIN:
            self._add_couple(Couple(i, j, pair, False, ANY, RANKS if b.kind == Target.SOFT else ranks))
            self._couple_edges(i, j, pair, ANY)
            if b.kind in (Target.SOFT, Target.CHAIN, Kind.MESH):
                self._add_couple(Couple(j, i, pair, False, EDGE))
        else:
            self._couple_solids(i, j, pair, ranks)

    def _couple_capsule(self, i: int, j: int, pair: int, ranks: int) -> None:
        b = self.entities[j]
        if b.kind == Target.CHAIN:
            self._add_couple(Couple(j, i, pair, False, ANY))
            self._couple_edges(j, i, pair, ANY)
        elif b.kind == Target.SOFT:
            self._add_couple(Couple(i, j, pair, False, FACE | EDGE))
            self._add_couple(Couple(j, i, pair, False, ANY))
            self._couple_edges(j, i, pair, EDGE)
        else:
            self._add_couple(Couple(i, j, pair, False, ANY, ranks))
            self._couple_edges(i, j, pair, EDGE if b.kind == Kind.CAPSULE else ANY)
            if b.kind in (Kind.CAPSULE, Kind.MESH):
                self._add_couple(Couple(j, i, pair, False, EDGE))

    def _couple_solids(self, i: int, j: int, pair: int, ranks: int) -> None:
        """Two objects with faces; cylinders come last but for grids, as nothing is sharper than their mantle."""
        a, b = self.entities[i], self.entities[j]
        self._add_couple(Couple(i, j, pair, False, ANY, ranks))
        self._couple_edges(i, j, pair, ANY)
        both_surfaces = b.kind in (Target.SOFT, Kind.MESH)
        ranks = RANKS if a.kind == Kind.MESH and not a.convex and b.kind == Target.SOFT else 1
        self._add_couple(Couple(j, i, pair, False, FACE | EDGE if both_surfaces else FACE, ranks))

    def _couple_points(self, i: int, j: int, pair: int) -> None:
        """Points without a surface against another object, which takes them at its faces, edges and corners."""
        if self.entities[i].kind != Target.POINTS:
            i, j = j, i
        b = self.entities[j]
        if b.kind == Target.POINTS:
            return
        ranks = RANKS if b.kind == Target.SOFT or (b.kind == Kind.MESH and not b.convex) else 1
        self._add_couple(Couple(i, j, pair, False, ANY, ranks))

    def _couple_own(self, i: int, pair: int) -> None:
        """A soft surface or a rod against itself."""
        entity = self.entities[i]
        if entity.kind in (Target.SOFT, Target.CHAIN):
            self._add_couple(Couple(i, i, pair, False, ANY, own=True))
            self._add_couple(Couple(i, i, pair, True, ANY, own=True))

    def _couple_edges(self, i: int, j: int, pair: int, mask: int) -> None:
        """Edges of i against j; where an edge runs parallel to a shape, both ends of that part count."""
        searched = self.entities[j].kind in (Target.SOFT, Target.CHAIN, Kind.MESH)
        self._add_couple(Couple(i, j, pair, True, mask, 2 if mask == ANY and not searched else 1))

    def _add_couple(self, couple: Couple) -> None:
        if self.keys(couple):
            self.couples.append(couple)


def _rank(entity: Entity) -> int:
    """Order in which an object stands in a couple, by the dimension of what it can touch with."""
    order: tuple[int, ...] = (
        Kind.SPHERE,
        Kind.CAPSULE,
        Target.CHAIN,
        Target.SOFT,
        Kind.MESH,
        Kind.BOX,
        Kind.CYLINDER,
        Kind.GRID,
    )
    return order.index(entity.kind) if entity.kind in order else len(order)


def _several(ids: int | Iterable[int]) -> list[int]:
    return [int(ids)] if isinstance(ids, int | np.integer) else [int(i) for i in ids]


def _quaternion(R: FloatArray) -> FloatArray:
    from softwarp.shapes.base import quaternion_of

    return quaternion_of(R)


def _normals(x: FloatArray, corner: IntArray) -> FloatArray:
    """Unit normals of triangles, shape (t, 3)."""
    a, b, c = (x[corner[:, k]] for k in range(3))
    n = np.cross(b - a, c - a)
    return np.asarray(n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-300))


def _vertex_normals(x: FloatArray, corner: IntArray) -> FloatArray:
    """Unit normals at vertices: the mean of the adjacent triangles, by angle."""
    n = np.zeros_like(x)
    for k in range(3):
        p, q, r = (x[corner[:, (k + m) % 3]] for m in range(3))
        e, f = q - p, r - p
        cosine = np.sum(e * f, axis=1) / (np.linalg.norm(e, axis=1) * np.linalg.norm(f, axis=1))
        np.add.at(n, corner[:, k], np.arccos(np.clip(cosine, -1.0, 1.0))[:, None] * _normals(x, corner))
    return np.asarray(n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-300))


def _neighbours(corner: IntArray) -> tuple[IntArray, list[tuple[tuple[int, int], tuple[int, int]]]]:
    """Triangle across every side, -1 for none, and the sides pair by pair: ((f, k), (g, l)), g = -1 at a border."""
    beside = np.full(corner.shape, -1, dtype=np.int64)
    seen: dict[tuple[int, int], tuple[int, int]] = {}
    pairs: dict[tuple[int, int], tuple[tuple[int, int], tuple[int, int]]] = {}
    for f, corners in enumerate(corner):
        for k in range(3):
            i, j = int(corners[k]), int(corners[(k + 1) % 3])
            other = seen.pop((j, i), None)
            if other is None:
                seen[i, j] = (f, k)
                pairs[i, j] = ((f, k), (-1, -1))
            else:
                g, m = other
                beside[f, k], beside[g, m] = g, f
                pairs[j, i] = ((g, m), (f, k))
    return beside, list(pairs.values())
