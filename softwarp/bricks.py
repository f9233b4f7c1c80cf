"""Soft bodies of hexahedra: part of ``ModelBuilder``."""

from __future__ import annotations

from typing import Any, Literal

from numpy.typing import ArrayLike

from softwarp import meshing
from softwarp.model.handles import SoftBody
from softwarp.scene import bodies
from softwarp.scene.materials import Corotational
from softwarp.scene.parts import Scene


class Bricks:
    """Part of ``ModelBuilder``; see there."""

    scene: Scene

    def add_hexes(
        self,
        nodes: ArrayLike | meshing.HexMesh,
        hexes: ArrayLike | None = None,
        *,
        material: Corotational,
        density: float | None = None,
        total_mass: float | None = None,
        lumping: Literal["volume", "uniform"] = "volume",
        rayleigh: tuple[float, float] = (0.0, 0.0),
        stiffness: ArrayLike | None = None,
        contact_surface: Any = None,
        thin: bool | ArrayLike = False,
        name: str | None = None,
    ) -> SoftBody:
        """Add a soft body of hexahedra with incompatible modes, which bend and do not lock near nu = 0.5.

        One brick through the thickness of a plate or leg bends as a beam does. Everything that takes a soft body takes
        this one; on its boundary every quadrilateral counts as two triangles. Reductions, natural modes, and gradients
        of equilibria and by rest shapes do not know hexahedra yet.

        Args:
            nodes: Rest positions [m], shape (n, 3), or a ``HexMesh`` (``meshing.brick``).
            hexes: Corners in the order of VTK, shape (m, 8): the lower face counter-clockwise from above, then the
                upper one; omitted for a mesh.
            material: ``Corotational`` law of method ``warped``; the rotation is that of the mean deformation of an
                element, and so is the volume ratio that its guard against inversion looks at.
            density: Density [kg/m^3]; exactly one of ``density`` and ``total_mass``, unless the material has one.
            total_mass: Mass of the body [kg].
            lumping: ``volume`` gives a node the integral of its shape functions, ``uniform`` the same mass to every
                node.
            rayleigh: Damping factors (mass [1/s], stiffness [s]).
            stiffness: Factors of the modulus, positive, one an element, (m,).
            contact_surface: As for ``add_tets``.
            thin: Whether elements are the whole thickness of a wall, from its lower to its upper face: six more modes
                then let them bend under moments that change along them, and coarser ones do. Where a body has walls and
                solid parts, one flag an element, (m,).
            name: For messages and exports.

        Returns:
            Index of the body.

        Raises:
            MeshError: If the mesh is empty, inside out, degenerate or otherwise broken.
            ValueError: For a material with another law or method.
        """
        options: dict[str, Any] = {"material": material, "density": density, "name": name, "total_mass": total_mass}
        options |= {"lumping": lumping, "rayleigh": rayleigh, "stiffness": stiffness}
        return bodies.add_hexes(self.scene, nodes, hexes, contact_surface=contact_surface, thin=thin, **options)
