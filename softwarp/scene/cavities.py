"""``ChamberBuilder``: the builder's methods for air chambers and membranes."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from softwarp import meshing
from softwarp.model.codes import CAVITY_CONTROLS
from softwarp.plan.cavities import MIDDLE_WEIGHTS
from softwarp.scene.frames import PartsBuilder
from softwarp.scene.parts import Cavity, CavitySpec, Handle, IntArray, MembraneSpec

ATMOSPHERE = 101325.0  # Pa
ON_NODE = 1e-9  # share of other nodes below which a vertex lies on a node


class ChamberBuilder(PartsBuilder):
    """Air chambers and membranes; part of ``ModelBuilder``."""

    def __init__(self) -> None:
        super().__init__()
        self.cavities: list[CavitySpec] = []
        self.membranes: list[MembraneSpec] = []

    def add_cavity(
        self,
        body: int,
        vertices: ArrayLike,
        triangles: ArrayLike,
        control: Literal["pressure", "volume", "gas"] = "pressure",
        *,
        min_pressure: float = -math.inf,
        max_pressure: float = math.inf,
        min_volume: float = 0.0,
        max_volume: float = math.inf,
        max_pressure_rate: float = math.inf,
        max_flow: float = math.inf,
        ambient: float = ATMOSPHERE,
        exponent: float = 1.0,
        anchored: ArrayLike = (),
        tolerance: float | None = None,
        name: str | None = None,
    ) -> Cavity:
        """Add an air chamber: a closed surface in a soft body that a pressure pushes outwards.

        Args:
            body: Soft body that carries the surface.
            vertices: Vertices at rest [m], shape (v, 3), inside or on the body. A vertex on a node moves with it alone.
                On quadratic elements pass all six nodes of a face and its four triangles, as ``surface`` of their
                linear mesh has them: the pressure on them is then that on the curved face.
            triangles: Corners, shape (t, 3), of a closed surface, outward from the air; inward as a whole is turned.
            control: ``pressure`` imposes a gauge pressure, ``volume`` a volume, ``gas`` an amount of gas, whose
                pressure follows p = ambient (gas / V)^exponent - ambient.
            min_pressure: Lower limit of the gauge pressure [Pa].
            max_pressure: Upper limit of the gauge pressure [Pa].
            min_volume: Lower limit of a commanded volume [m^3].
            max_volume: Upper limit of a commanded volume [m^3].
            max_pressure_rate: Largest change of a commanded pressure [Pa/s].
            max_flow: Largest change of a commanded volume or amount of gas [m^3/s].
            ambient: Absolute pressure outside [Pa].
            exponent: 1 for isothermal, 1.4 for adiabatic air.
            anchored: Indices of vertices that are fixed in space, as on planes of symmetry.
            tolerance: Distance [m] that a vertex may lie outside the body's faceted surface.
            name: For messages and exports.

        Returns:
            Handle, index of ``Simulation.cavity_volume`` and of the commands.

        Raises:
            MeshError: For a surface that is open, not oriented, or outside the body; the message names the place.
        """
        spec = self._soft(body)
        label = name or f"cavity{len(self.cavities)}"
        if label in [cavity.name for cavity in self.cavities]:
            raise ValueError(f"cavity {label!r} exists already; give every cavity its own name")
        if control not in CAVITY_CONTROLS:
            raise ValueError(f"cavity {label!r}: control must be one of {', '.join(CAVITY_CONTROLS)}, got {control!r}")
        outward = meshing.check_closed(vertices, triangles, name=label)
        points = np.asarray(vertices, dtype=np.float64)
        free = np.ones(len(points), dtype=bool)
        free[np.asarray(anchored, dtype=np.int64)] = False
        tets, weights = np.full(len(points), -1, dtype=np.int32), np.zeros((len(points), 4))
        if free.any():
            label_of = f"cavity {label!r}: vertex"
            tets[free], weights[free] = meshing.embed(
                spec.mesh.nodes, spec.mesh.tets, points[free], name=label_of, tolerance=tolerance
            )
        middles = np.full((len(points), 3), -1, dtype=np.int32)
        if spec.elements is not None:
            nodes = np.take_along_axis(spec.mesh.tets[tets], weights.argmax(axis=1)[:, None], axis=1)[:, 0]
            on_node = free & (np.abs(weights.max(axis=1) - 1.0) < ON_NODE)
            middles = meshing.surface_middles(spec.elements, np.where(on_node, nodes, -1), outward)
            is_middle = middles[:, 0] >= 0
            points = points.copy()
            points[is_middle] = np.einsum("k,vkc->vc", MIDDLE_WEIGHTS, spec.mesh.nodes[middles[is_middle]])
        limits = {
            "cavity_min_pressure": min_pressure,
            "cavity_max_pressure": max_pressure,
            "cavity_min_volume": min_volume,
            "cavity_max_volume": max_volume,
            "cavity_max_pressure_rate": max_pressure_rate,
            "cavity_max_flow": max_flow,
        }
        if any(math.isnan(value) for value in limits.values()):
            raise ValueError(f"cavity {label!r}: limits must be numbers, got {limits}")
        if min_pressure > max_pressure or min_volume > max_volume or max_pressure_rate < 0.0 or max_flow < 0.0:
            raise ValueError(f"cavity {label!r}: limits must be ordered and rates at least 0, got {limits}")
        if not (math.isfinite(ambient) and ambient > 0.0 and math.isfinite(exponent) and exponent > 0.0):
            raise ValueError(f"cavity {label!r}: ambient and exponent must be positive, got {ambient!r}, {exponent!r}")
        self.cavities.append(
            CavitySpec(
                name=label,
                body=int(body),
                vertices=points,
                triangles=outward,
                control=control,
                limits=limits,
                exponent=float(exponent),
                ambient=float(ambient),
                tets=tets,
                weights=weights,
                middles=middles,
            )
        )
        return Cavity(len(self.cavities) - 1)

    def add_membrane(
        self,
        body: int,
        triangles: ArrayLike,
        *,
        thickness: float | ArrayLike,
        youngs: float,
        nu: float = 0.45,
        density: float = 0.0,
        name: str | None = None,
    ) -> Handle:
        """Glue a thin elastic skin to nodes of a soft body; it resists stretching, not bending.

        Args:
            body: Soft body.
            triangles: Node indices within the body, shape (t, 3).
            thickness: Thickness [m], one or one per triangle.
            youngs: Young's modulus [Pa].
            nu: Poisson's ratio.
            density: Density [kg/m^3]; 0 for a skin without mass.
            name: For messages.

        Returns:
            Handle, index of ``params.membrane_youngs``.

        Raises:
            MeshError: For a triangle without area or a thickness that is not positive.
        """
        spec = self._soft(body)
        label = name or f"membrane{len(self.membranes)}"
        if not (math.isfinite(youngs) and youngs > 0.0 and math.isfinite(density) and density >= 0.0):
            raise ValueError(f"{label}: youngs must be positive and density at least 0, got {youngs!r}, {density!r}")
        if not -1.0 < nu <= 0.5:
            raise ValueError(f"{label}: Poisson's ratio must lie in (-1, 0.5], got {nu!r}")
        geometry = meshing.membrane_geometry(spec.mesh.nodes, triangles, thickness, name=label)
        chosen: IntArray = geometry.triangles
        self.membranes.append(
            MembraneSpec(label, int(body), chosen, float(youngs), float(nu), geometry.thickness, float(density))
        )
        return Handle(len(self.membranes) - 1)
