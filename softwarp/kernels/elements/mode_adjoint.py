"""Adjoint of a step of reduced bodies: between gradients by nodes and by modes. Theory: docs/theory/adjoint.md.

Nodes are at X + Phi q with the velocities Phi v, so that gradients by them count as Phi' y for modes, and elements and
rows have p of nodes Phi p. Mass and weight are those of modes, per density:

    by v0: rho M p,   by gravity: h rho W' p,   by density: p . (M (v0 - (1 + h alpha) v) + h W g).

State arrays are ``[world, row]``, workspace arrays ``[pack, row, lane]``; wide modes as in ``reduction``.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import packs
from softwarp.kernels.algebra.lanes import Variant, single_worlds


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type and memory order."""
    real, world_fastest = variant.real, variant.world_fastest
    module = variant.module("adjoint.modes")
    take_of_pack = packs.functions(real).take_nodes

    @wp.kernel(module=module, enable_backward=False)
    def take_nodes(
        # Model
        node: wp.array(dtype=wp.int32),
        # State out
        bar_out: wp.array2d(dtype=real),
        # Workspace out
        listed_out: wp.array3d(dtype=real),
    ):
        """Gradient by one listed node, which modes take over: the node's own is 0 afterwards.

        On a CPU a thread has its share of the nodes of a pack.
        """
        pack, part, lane = wp.tid()
        if wp.static(world_fastest):
            for c in range(3):
                listed_out[pack, 3 * part + c, lane] = bar_out[lane, 3 * node[part] + c]
                bar_out[lane, 3 * node[part] + c] = real(0.0)
        else:
            lanes = listed_out.shape[2]
            count = node.shape[0]
            first = lane * count / lanes
            take_of_pack(node, pack, first, (lane + 1) * count / lanes, bar_out, listed_out)

    @wp.kernel(module=module, enable_backward=False)
    def add_modes(
        lanes: int,
        # Model
        mode_wide: wp.array(dtype=wp.int32),
        # Workspace in
        wide_in: wp.array3d(dtype=real),
        # State out
        bar_out: wp.array2d(dtype=real),
    ):
        """Add to the gradient by one mode."""
        pack, mode, lane = wp.tid()
        world = pack * lanes + lane
        if world < bar_out.shape[0]:
            bar_out[world, mode] = bar_out[world, mode] + wide_in[pack, mode_wide[mode], lane]

    @wp.kernel(module=module, enable_backward=False)
    def seed(
        h: real,
        lanes: int,
        # Model
        mode_dof: wp.array(dtype=wp.int32),
        # State
        q_bar_in: wp.array2d(dtype=real),
        v_bar_in: wp.array2d(dtype=real),
        # Workspace out
        seed_out: wp.array3d(dtype=real),
        y_out: wp.array3d(dtype=real),
    ):
        """y_v + h y_q of three modes at their dof, twice. Lanes past the last world repeat it."""
        pack, block, lane = wp.tid()
        world = wp.min(pack * lanes + lane, q_bar_in.shape[0] - 1)
        for c in range(3):
            mode = 3 * block + c
            row = 3 * mode_dof[block] + c
            value = v_bar_in[world, mode] + h * q_bar_in[world, mode]
            seed_out[pack, row, lane] = value
            y_out[pack, row, lane] = value

    @wp.kernel(module=module, enable_backward=False)
    def velocities(
        lanes: int,
        # Model
        block_body: wp.array(dtype=wp.int32),
        # Workspace in
        density_in: wp.array3d(dtype=real),
        mass_p_in: wp.array3d(dtype=real),
        # State out
        v_bar_out: wp.array2d(dtype=real),
    ):
        """Gradient by the velocities of three modes at the start of the step."""
        pack, block, lane = wp.tid()
        world = pack * lanes + lane
        if world < v_bar_out.shape[0]:
            for row in range(3 * block, 3 * block + 3):
                v_bar_out[world, row] = density_in[pack, block_body[block], lane] * mass_p_in[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def bodies(
        h: real,
        lanes: int,
        # Model
        body_number: wp.array(dtype=wp.int32),
        mode_start: wp.array(dtype=wp.int32),
        mode_wide: wp.array(dtype=wp.int32),
        heft: wp.array2d(dtype=real),
        # Workspace in
        density_in: wp.array3d(dtype=real),
        body_mass_in: wp.array3d(dtype=real),
        gravity_in: wp.array3d(dtype=real),
        mode_v0_in: wp.array3d(dtype=real),
        wide_v_in: wp.array3d(dtype=real),
        wide_p_in: wp.array3d(dtype=real),
        mass_p_in: wp.array3d(dtype=real),
        # State out
        density_bar_out: wp.array2d(dtype=real),
        rayleigh_mass_bar_out: wp.array2d(dtype=real),
        gravity_bar_out: wp.array2d(dtype=real),
    ):
        """Add the gradients by density, by Rayleigh's alpha and by gravity that all reduced bodies have."""
        pack, lane = wp.tid()
        world = pack * lanes + lane
        if world < density_bar_out.shape[0]:
            for k in range(body_number.shape[0]):
                body = body_number[k]
                density = density_in[pack, body, lane]
                scale = body_mass_in[pack, body, lane]
                by_density = real(0.0)
                by_alpha = real(0.0)
                for mode in range(mode_start[k], mode_start[k + 1]):
                    p = wide_p_in[pack, mode_wide[mode], lane]
                    v = wide_v_in[pack, mode_wide[mode], lane]
                    mass_p = mass_p_in[pack, mode, lane]
                    for c in range(3):
                        weight = h * heft[mode, c] * p
                        by_density += weight * gravity_in[pack, c, lane]
                        gravity_bar_out[world, c] = gravity_bar_out[world, c] + density * weight
                    by_density += mass_p * (mode_v0_in[pack, mode, lane] - scale * v)
                    by_alpha -= h * density * mass_p * v
                density_bar_out[world, body] = density_bar_out[world, body] + by_density
                rayleigh_mass_bar_out[world, body] = rayleigh_mass_bar_out[world, body] + by_alpha

    return SimpleNamespace(take_nodes=take_nodes, add_modes=add_modes, seed=seed, velocities=velocities, bodies=bodies)


@cache
def element_kernels(variant: Variant) -> SimpleNamespace:
    """Kernels on the elements of a variant, (w, row)."""
    S, real, world_fastest = variant.S, variant.real, variant.world_fastest
    module = variant.module("adjoint.mode_elements")

    @wp.kernel(module=module, enable_backward=False)
    def masses(
        # Model
        block_first: wp.array(dtype=wp.int32),
        block_modes: wp.array(dtype=wp.int32),
        block_volume: wp.array(dtype=wp.int32),
        volume: wp.array(dtype=real),
        mode_wide: wp.array(dtype=wp.int32),
        # Workspace in
        wide_p_in: wp.array2d(dtype=S),
        # Workspace out
        mass_p_out: wp.array2d(dtype=S),
    ):
        """M p per density of three modes."""
        w, block = wp.tid()
        if wp.static(world_fastest):
            block, w = wp.tid()
        count = block_modes[block]
        for r in range(3):
            total = S(real(0.0))
            for k in range(count):
                share = volume[block_volume[block] + r * count + k]
                total += wide_p_in[w, mode_wide[block_first[block] + k]] * share
            mass_p_out[w, 3 * block + r] = total

    return SimpleNamespace(masses=masses)
