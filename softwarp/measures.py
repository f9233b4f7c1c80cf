"""What can be measured of the worlds of a simulation: forces, energies, momenta, stresses, stiffness."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

from softwarp import checks
from softwarp.model.model import Model
from softwarp.model.state import Parameters, State

if TYPE_CHECKING:
    import torch

    from softwarp.modal import Modes
    from softwarp.reactions import ReactionMeter, Reactions
    from softwarp.solvers.system import System
    from softwarp.stresses import ElementTensors


class Measures:
    """Part of ``Simulation``; see there."""

    model: Model
    _systems: list[System]
    _state: State
    _parameters: Parameters

    def make_systems(self, more_sides: int, *, exact: bool = False) -> list[tuple[slice, System]]:
        """See ``Simulation``."""
        raise NotImplementedError

    def internal_force(self) -> torch.Tensor:
        """Elastic force dE/dx [N] at the present positions, shape (world, node, 3)."""
        from softwarp import diagnostics

        return diagnostics.internal_force(self._systems)

    def elastic_energy(self) -> torch.Tensor:
        """Elastic energy of tets, rods and membranes [J], shape (world,); ``large`` bodies count as polar ones."""
        from softwarp import diagnostics

        return diagnostics.elastic_energy(self.model, self._state, self._parameters)

    def energy(self) -> torch.Tensor:
        """Elastic, kinetic and gravitational energy [J], shape (world,); without that of gas."""
        from softwarp import diagnostics

        arrays = (self.model, self._state, self._parameters)
        mass = diagnostics.node_mass(self._systems)
        elastic, kinetic = diagnostics.elastic_energy(*arrays), diagnostics.kinetic_energy(*arrays, mass)
        return elastic + kinetic + diagnostics.potential_energy(*arrays, mass)

    def kinetic_energy(self) -> torch.Tensor:
        """Kinetic energy of nodes, bodies and rods [J], shape (world,)."""
        from softwarp import diagnostics

        return diagnostics.kinetic_energy(self.model, self._state, self._parameters, self.mass)

    def momentum(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Linear [N s] and angular momentum about the origin [N m s], each of shape (world, 3)."""
        from softwarp import diagnostics

        return diagnostics.momentum(self.model, self._state, self._parameters, self.mass)

    def rod_resultants(self) -> torch.Tensor:
        """Force [N] and moment [N m] that every rod segment transmits, in its axes, shape (world, segment, 6)."""
        from softwarp import diagnostics

        return diagnostics.segment_resultants(self.model, self._state, self._parameters)

    def node_stress(self) -> torch.Tensor:
        """Von Mises Cauchy stress [Pa] averaged to nodes by volume, shape (world, node)."""
        from softwarp import diagnostics

        return diagnostics.node_stress(self.model, self._state, self._parameters)

    def element_stress(self, body: int | None = None) -> torch.Tensor:
        """Cauchy stress of every element [Pa], (world, element, 3, 3), of quadratic ones the mean of Gauss points.

        ``sw.von_mises`` makes one number of it. Bodies of the ``large`` rotation count as polar ones; damping, the
        Maxwell branch of ``relaxation`` and the guard against inversion are left out.

        Args:
            body: Soft body, whose elements come in the order of ``add_tets``; None takes all, body after body.

        Raises:
            ValueError: If there is no such body.
        """
        meter = self.element_meter
        return meter.measure(self._state, self._parameters)[0][:, meter.slice(body)]

    def element_strain(self, body: int | None = None) -> torch.Tensor:
        """Green-Lagrange strain (F'F - 1) / 2 of every element, shape (world, element, 3, 3), as ``element_stress``.

        Args:
            body: Soft body; None takes all, body after body.

        Raises:
            ValueError: If there is no such body.
        """
        meter = self.element_meter
        return meter.measure(self._state, self._parameters)[1][:, meter.slice(body)]

    @cached_property
    def element_meter(self) -> ElementTensors:
        """What measures stress and strain, with the rest volumes of elements and which belong to a body."""
        from softwarp.stresses import ElementTensors

        return ElementTensors(self.model)

    def reactions(self) -> Reactions:
        """Forces that fixed nodes, clamped rod nodes and held axes of rigid bodies need at the present positions.

        They balance elasticity, weight, loads (``add_point_load``, ``add_traction``, ``control.node_force`` and
        ``frame_force``), and what cables, chambers, joints and the contacts of rigid bodies exerted in the last step or
        static solve. Left out are momentum, damping, and contacts that press on held nodes of soft bodies and rods
        themselves; so the sum balances weight and loads at rest.
        """
        return self._reaction_meter.measure(self._systems, self._state)

    @cached_property
    def _reaction_meter(self) -> ReactionMeter:
        from softwarp.reactions import ReactionMeter

        return ReactionMeter(self.model, self._systems)

    def tangent_product(self, direction: torch.Tensor) -> torch.Tensor:
        """K d [N] of the free nodes at the present positions; ``direction`` has shape (world, node, 3).

        Raises:
            ValueError: For another shape, and in scenes with rods or rigid bodies.
        """
        from softwarp import diagnostics

        return diagnostics.tangent_product(self._systems, direction)

    def stiffness_matrix(self, world: int = 0) -> Any:
        """K of the free nodes of one world as a SciPy CSR matrix over all 3 node scalars [N/m].

        Raises:
            ValueError: If there is no such world, and in scenes with rods or rigid bodies.
        """
        from softwarp import diagnostics

        return diagnostics.stiffness_matrix(self._systems, world)

    def mass_matrix(self, world: int = 0) -> Any:
        """M of the free nodes of one world as a SciPy CSR matrix over all 3 node scalars [kg].

        That of quadratic tets is consistent, of linear ones lumped.

        Raises:
            ValueError: If there is no such world, and in scenes with rods or rigid bodies.
        """
        from softwarp import diagnostics

        return diagnostics.mass_matrix(self._systems, world)

    def modes(self, count: int = 10, world: int = 0) -> Modes:
        """Natural modes about the present state of one world: frequencies, shapes and damping ratios, slowest first.

        Stiffness is the exact tangent of the elements, with the stress that they bear; taut cables stiffen sideways and
        their lengths are free. Gas and contact are left out.

        Args:
            count: Number of modes.
            world: World of the batch.

        Raises:
            ValueError: If there is no such world, fewer coordinates are free, and in scenes with parts other than soft
                bodies and cables.
        """
        from softwarp import diagnostics, modal

        world = checks.count(world, f"world of {self.model.num_worlds}", low=0, high=self.model.num_worlds - 1)
        diagnostics.refuse_frames(self.model, "modes")
        if self.model.cable_elastic.any():
            raise ValueError("modes: cables that stretch are not known; leave their stiffness out")
        if not self._systems[0].has_exact_tangent:
            raise ValueError(
                "modes: soft bodies of tetrahedra, cables and chambers are known; this scene has other parts, build "
                "one without them (mesh hexahedra with add_tets(mesh.linear()))"
            )
        systems = self.make_systems(0, exact=True)
        worlds, system = next(part for part in systems if part[0].start <= world < part[0].stop)
        rayleigh = (self._parameters.rayleigh_mass.numpy()[world], self._parameters.rayleigh_stiffness.numpy()[world])
        return modal.natural_modes(system, world - worlds.start, count, rayleigh)

    @property
    def mass(self) -> torch.Tensor:
        """Lumped mass [kg], shape (world, node)."""
        from softwarp import diagnostics

        return diagnostics.node_mass(self._systems)
