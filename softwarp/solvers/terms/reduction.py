"""Soft bodies that move in modes. Equations: docs/theory/reduction.md."""

from __future__ import annotations

import warp as wp

from softwarp.kernels.elements import mode_places, reduction, samples, tensor_sums
from softwarp.kernels.frames import momentum
from softwarp.model.reduction import ReductionModel
from softwarp.solvers.subspace import each_load
from softwarp.solvers.terms.floating import FloatingFrames
from softwarp.solvers.terms.term import Term
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


class ReductionTerm(Term):
    """Reduced bodies of one shard. Their elements that count are tets and membranes like others; nodes follow modes.

    Args:
        shard: Worlds.
        model: Modes.
    """

    refreshes = True

    def __init__(self, shard: Shard, model: ReductionModel) -> None:
        super().__init__(shard)
        self.model = model
        self.k, self.k_sample = reduction.kernels(shard.variant), samples.kernels(shard.variant)
        self.k_place = mode_places.kernels(shard.variant) if shard.variant.world_fastest else None
        self.k_state = momentum.kernels(shard.variant)
        self.blocks, self.pairs = model.count // 3, int(model.pair_block.size)
        floating = model.floating
        self.frames = None if floating is None else FloatingFrames(shard, model, floating)
        self.takes_stored = floating is None and not model.tet_turned.numpy().any()
        self.tets, self.tris = int(model.tet_samples[-1]), int(model.tri_samples[-1])
        self.is_near = tensor_sums.serves(shard.device, shard.model.precision, model.widest)
        self.fragments = self._split() if self.is_near else []

    def load(self) -> None:
        """Amplitudes, and the nodes that a step needs."""
        s, i, w = self.shard, self.shard.input, self.shard.work
        w.mode_q.copy_from(i["mode_q0"])
        w.mode_v.copy_from(i["mode_v0"])
        for name in ("mode_q0", "mode_v0"):
            s.check_finite(i[name], self.model.count)
        if self.frames is None:
            if not s.is_settled:
                self._start()
            return
        self.frames.start()
        if s.is_settled:
            self._widen(w.mode_q, w.wide_q)
        else:
            self._place(self.model.active_count)
        self.frames.start_moments()
        self.frames.hold()

    def start_over(self) -> None:
        """Frames of the start of the step, which rows go by; a look at contacts has turned them on."""
        w, i = self.shard.work, self.shard.input
        w.mode_q.copy_from(i["mode_q0"])
        w.mode_v.copy_from(i["mode_v0"])
        if self.frames is not None:
            self.frames.turn(0.0)

    def _start(self) -> None:
        """Nodes that a step needs, where somebody moved them or their amplitudes since the last one."""
        s, m, w, state = self.shard, self.model, self.shard.work, self.shard.state
        if s.variant.world_fastest:
            self._place(m.active_count)
            return
        self._widen(w.mode_q, w.wide_q)
        inputs = [m.active_count, s.lanes, *self._basis(), m.node_rest]
        inputs += [state.mode_q, state.good_mode_q, state.node_x, state.good_x, w.wide_q.S]
        s.each_world(self.k.start_positions, inputs, [w.x.S])

    def tangent(self, h: float) -> None:
        """Blocks of A between modes."""
        s, m, w, i = self.shard, self.model, self.shard.work, self.shard.input
        if s.variant.world_fastest:
            self.sample()
            self._gather()
        else:
            if not self.takes_stored:
                self.sample()
            inputs = [m.chunk_room, self.takes_stored, m.body_number, m.tet_sample, m.tri_sample]
            inputs += [m.body_modes, m.body_stride, m.body_chunk, m.chunk_rows, m.chunk_basis]
            inputs += [m.chunk_tets, m.chunk_tris, m.tet_list, m.tri_list, m.chunk_modes]
            own = (w.tet_stiffness, w.membrane_stiffness)
            inputs += [k.S for k in (own if self.takes_stored else (w.sample_stiffness, w.thin_stiffness))]
            s.each_world(self.k_sample.mode_stiffness, [*inputs, w.body_stiffness.S], [w.mode_strip.S, w.mode_sum.S])
        inputs = [m.pair_block, m.pair_row, m.pair_col, m.pair_stiffness, m.pair_stride, m.pair_volume, m.block_body]
        inputs += [w.body_mass.S, i["density"].S, w.mode_sum.S]
        s.each(self.k.mode_tangent, self.pairs, inputs, [w.a.S])
        if self.frames is not None:
            self.frames.tangent()

    def sample(self) -> None:
        """Stiffness of the elements that count, and in floating frames what damping does where a body turns."""
        self.take_samples()
        if self.frames is not None:
            self.frames.turn_stiffness()
            self.frames.drag()

    def take_samples(self) -> None:
        """Stiffness of the elements that count, in the world's axes."""
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [m.tet_sample, m.tet_turned, s.model.tet_body, w.body_mu.S, w.body_lam.S, w.body_stiffness.S]
        inputs += [w.tet_gradient.S, w.tet_stiffness.S]
        s.each(self.k_sample.tet_stiffness, self.tets, inputs, [w.sample_stiffness.S])
        if s.model.membranes is not None:
            inputs = [m.tri_sample, s.model.membranes.element_body, w.body_stiffness.S, w.membrane_stiffness.S]
            s.each(self.k_sample.tri_stiffness, self.tris, inputs, [w.thin_stiffness.S])

    def _gather(self) -> None:
        """Their sum on a GPU."""
        if self.is_near:
            self._gather_near()
            return
        s, m, w, k = self.shard, self.model, self.shard.work, self.k_sample
        each = m.stride // samples.TILE
        most, squares = int(each.max()), int((each * (each + 1) // 2).sum())
        kinds = [(k.half_tet, self.tets, (m.tet_stride, m.tet_first, m.tet_basis), w.sample_stiffness)]
        kinds += [(k.half_tri, self.tris, (m.tri_stride, m.tri_first, m.tri_basis), w.thin_stiffness)]
        places = [(samples.TET, m.body_tets, m.body_tet_basis, w.mode_strip)]
        places += [(samples.TRI, m.body_tris, m.body_tri_basis, w.mode_strip_thin)]
        more = False
        for (half, count, arrays, stiffness), (size, ranges, first, strip) in zip(kinds, places, strict=True):
            if count or not more:
                s.each(half, most * count, [most, *arrays, stiffness.S], [strip.S])
                inputs = [size, squares, more, m.body_stride, ranges, first, arrays[-1], strip.S]
                s.each(k.whole_product, squares, inputs, [w.mode_sum.S])
            more = True

    def _split(self) -> list[tuple[list[float], list[wp.array]]]:
        """What tensor cores take of each body's samples: numbers and arrays, of tets and then of triangles."""
        m, device, found = self.model, self.shard.device, []
        first = [0, 0]
        for body, modes in enumerate(m.stride.tolist()):
            numbers: list[float] = []
            arrays: list[wp.array] = []
            for kind, (size, samples_of, basis) in enumerate(
                ((samples.TET, m.tet_samples, m.tet_basis), (samples.TRI, m.tri_samples, m.tri_basis))
            ):
                count = int(samples_of[body + 1] - samples_of[body])
                rows = basis.numpy()[first[kind] : first[kind] + count * size * modes]
                parts = tensor_sums.fragments(rows.reshape(count, size, modes))
                numbers += [parts.most, parts.back]
                arrays.append(wp.array(parts.halves, dtype=wp.int32, device=device))
                first[kind] += rows.size
            found.append((numbers, arrays))
        return found

    def _gather_near(self) -> None:
        """The same on tensor cores, body after body."""
        s, m, w = self.shard, self.model, self.shard.work
        sum_first, tet_at, tri_at = 0, 0, 0
        for body, modes in enumerate(m.stride.tolist()):
            tet, tri = int(m.tet_samples[body]), int(m.tri_samples[body])
            tets, tris = int(m.tet_samples[body + 1]) - tet, int(m.tri_samples[body + 1]) - tri
            numbers, arrays = self.fragments[body]
            inputs = [tets, tet_at, samples.TET**2 * tet, tris, tri_at, samples.TRI**2 * tri, sum_first, *numbers]
            inputs += [m.tet_basis, m.tri_basis, *arrays, w.sample_stiffness.S, w.thin_stiffness.S]
            kernel, groups = tensor_sums.kernels(s.variant, modes).stiffness, -(-s.width // tensor_sums.GROUP)
            dim, block = (groups, tensor_sums.THREADS), tensor_sums.THREADS
            wp.launch(kernel, dim, inputs, [w.mode_sum.S], device=s.device, block_dim=block)
            sum_first, tet_at = sum_first + modes**2, tet_at + samples.TET * modes * tets
            tri_at += samples.TRI * modes * tris

    def right_hand_side(self, f_scale: float, inertia: bool, moving: bool) -> None:
        """Rows of b that belong to modes, from the forces of nodes."""
        s, m, w, i = self.shard, self.model, self.shard.work, self.shard.input
        inputs = [m.wide_mode, m.wide_body, m.body_number, m.heft, i["density"].S, i["gravity"].S]
        s.each(self.k.mode_weight, m.wide_count, inputs, [w.wide_force.S])
        inputs = [m.node, w.node_internal.S, w.node_external.S]
        s.each(self.k.node_balance, s.variant.parts(int(m.node.size)), inputs, [w.listed_force.S])
        if self.frames is not None:
            self.frames.turn_loads()
        inputs = [m.body_node, m.order, m.node_basis, m.node_body, m.body_wide, m.body_stride, m.wide_body, m.basis]
        each_load(s, self.k.add_forces, m.wide_count, len(m.body), [*inputs, w.listed_force.S], [w.wide_force.S])
        if self.frames is not None:
            self.frames.rigid_loads()
        s.each(self.k.narrow, m.count, [m.mode_wide, w.wide_force.S], [w.mode_force.S])
        model = s.model
        inputs = [m.mode_dof, m.block_body, m.block_first, m.block_modes, m.block_volume, m.volume]
        inputs += [model.neighbour_start, model.neighbour, model.neighbour_block]
        inputs += [w.body_mass.S, w.body_damping.S, i["density"].S, w.mode_force.S, i["mode_v0"].S, w.mode_v.S]
        inputs += [w.a.S, w.dof_v.S, f_scale, 1.0 if inertia else 0.0, moving]
        s.each(self.k.right_hand_side, self.blocks, inputs, [w.b.S])
        if self.frames is not None and inertia:
            self.frames.momentum(moving)

    def sides(self, y: Rows) -> None:
        """Entries of rows at modes."""
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [m.row_body, m.row_point, m.row_points, m.row_basis, m.row_wide, m.wide_row, m.body_stride]
        gradient = w.point_gradient.S if self.frames is None else self.frames.gradients()
        modes, rows = int(m.wide_row.size), int(m.row_body.size)
        each_load(s, self.k.mode_rows, modes, rows, [*inputs, m.point_basis, gradient], [w.wide_row.S])
        if self.frames is not None:
            self.frames.rows()
        inputs = [s.model.dof_count, m.entry, m.entry_wide, s.model.entry_dof, s.model.entry_row, w.wide_row.S]
        s.each(self.k.mode_entries, int(m.entry.size), inputs, [w.row.S, y.S])

    def norms(self, f_scale: float) -> None:
        """Add the size of forces on modes."""
        s, w = self.shard, self.shard.work
        s.each_world(self.k.force_norms, [self.model.count, w.mode_force.S, f_scale], [w.norm.S])

    def move(self, x_scale: float) -> None:
        """Trial amplitudes, and the nodes that a step needs."""
        self._amplitudes(x_scale)
        self._place(self.model.active_count)
        if self.frames is not None:
            self.frames.hold()

    def peek(self, x_scale: float) -> None:
        """Trial amplitudes, and the nodes that may touch something."""
        s, m, w = self.shard, self.model, self.shard.work
        self._amplitudes(x_scale)
        self._widen(w.mode_q, w.wide_q)
        inputs = [m.touch_listed, *self._basis(), m.node_rest, w.wide_q.S]
        s.each(self.k.touch_positions, int(m.touch_stride.size), inputs, [w.x.S])
        if self.frames is not None:
            self.frames.place_touching()

    def arrive(self, x_scale: float) -> None:
        """Amplitudes, and all nodes with their velocities."""
        self._amplitudes(x_scale)
        if self.frames is not None:
            w = self.shard.work
            self._widen(w.mode_q, w.wide_q)
            self._widen(w.mode_v, w.wide_v)
            self.frames.turn_on(x_scale)
        self._place_all()

    def _amplitudes(self, x_scale: float) -> None:
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [m.mode_dof, s.input["mode_q0"].S, w.dof_v.S, x_scale]
        s.each(self.k.trial_amplitude, self.blocks, inputs, [w.mode_q.S, w.mode_v.S])
        if self.frames is not None:
            self.frames.turn(x_scale)

    def check(self, h: float) -> None:
        """Flags for amplitudes that are not finite."""
        s, w = self.shard, self.shard.work
        for values in (w.mode_q, w.mode_v):
            s.check_finite(values, self.model.count)
        if self.frames is not None:
            s.check_finite(w.mode_turn, 4 * self.frames.count)

    def write(self) -> None:
        """Amplitudes and nodes of good worlds."""
        s, w, state = self.shard, self.shard.work, self.shard.state
        outputs = [(w.mode_q, state.mode_q, state.good_mode_q), (w.mode_v, state.mode_v, state.good_mode_v)]
        if self.frames is not None:
            outputs.append((w.mode_turn, state.mode_turn, state.good_mode_turn))
        for value, target, good in outputs:
            parts = s.variant.parts(target.shape[1])
            s.each_real(self.k_state.commit_state, parts, [s.lanes, w.flag.real, value.real], [target, good])
        self._write_nodes()

    def refresh(self) -> None:
        """Nodes, where amplitudes were written by hand; both become the last good ones, which ``_start`` goes by."""
        self._place_all()
        s, w, good = self.shard, self.shard.work, self.shard.state.good_mode_q
        inputs = [s.lanes, w.flag.real, w.mode_q.real]
        s.each_real(self.k_state.commit_state, s.variant.parts(good.shape[1]), inputs, [good, good])
        self._write_nodes()

    def _write_nodes(self) -> None:
        s, w, state = self.shard, self.shard.work, self.shard.state
        m = self.model
        inputs = [m.node, m.body_begin, m.body_end, s.lanes, w.flag.real, w.x.real, w.reduced_v.real]
        outputs = [state.node_x, state.node_v, state.good_x, state.good_v]
        s.each_real(self.k.commit_nodes, s.variant.parts(int(m.node.size)), inputs, outputs)

    def _basis(self) -> list[wp.array]:
        """Nodes and their modes, as kernels take them."""
        m = self.model
        return [m.node, m.node_body, m.node_basis, m.body_wide, m.body_stride, m.basis]

    def _widen(self, values: Rows, wide: Rows) -> None:
        """Amplitudes, or their velocities, each body's up to its stride."""
        s, m = self.shard, self.model
        s.each(self.k.widen, m.wide_count, [m.wide_mode, values.S], [wide.S])
        if self.frames is not None and wide is s.work.wide_q:
            self.frames.unit()

    def _place(self, count: int) -> None:
        """Positions of the first listed nodes."""
        s, m, w = self.shard, self.model, self.shard.work
        self._widen(w.mode_q, w.wide_q)
        inputs = [*self._basis(), m.node_rest, w.wide_q.S]
        if self.k_place is not None:
            s.each(self.k_place.node_positions, -(-count // mode_places.NODES), [count, *inputs], [w.x.S])
        else:
            s.each(self.k.node_positions, count, inputs, [w.x.S])
        if self.frames is not None:
            self.frames.place(count)

    def place_both(
        self, rest: wp.array, one: Rows, other: Rows, first: Rows, second: Rows, count: int | None = None
    ) -> None:
        """Two sums of modes at listed nodes.

        Args:
            rest: What is added to the first sum, (listed, 3).
            one: Factors of wide modes.
            other: Likewise.
            first: Receives the sum by nodes of one.
            second: Of the other.
            count: Of the first nodes of the list; None takes all.
        """
        s, inputs = self.shard, [*self._basis(), rest, one.S, other.S]
        count = int(self.model.node.size) if count is None else count
        if self.k_place is not None:
            items = -(-count // mode_places.NODES)
            s.each(self.k_place.node_states, items, [count, *inputs], [first.S, second.S])
        else:
            s.each(self.k.node_states, count, inputs, [first.S, second.S])

    def _place_all(self) -> None:
        """Positions and velocities of all listed nodes."""
        m, w = self.model, self.shard.work
        self._widen(w.mode_q, w.wide_q)
        self._widen(w.mode_v, w.wide_v)
        self.place_both(m.node_rest, w.wide_q, w.wide_v, w.x, w.reduced_v)
        if self.frames is not None:
            self.frames.place(int(m.node.size))
            self.frames.velocities()
