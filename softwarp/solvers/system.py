"""The linearised system of a range of worlds: load state, evaluate forces and tangents, solve with multipliers, commit.

``ImplicitEuler`` and ``QuasiStatic`` are sequences of these operations. Equations: docs/theory/implicit_euler.md.
"""

from __future__ import annotations

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements import assembly, corotational, hyperelastic, warped
from softwarp.kernels.frames import prescribed
from softwarp.kernels.rows import cable, cable_block, delassus
from softwarp.kernels.step import newton, transfer
from softwarp.model.codes import FAR, TURNED
from softwarp.model.fields import declarations
from softwarp.model.model import Model
from softwarp.model.state import Control, Parameters, State
from softwarp.solvers.collision import contact_list
from softwarp.solvers.linear.cholesky import LinearSolver
from softwarp.solvers.multipliers import ContactResponse
from softwarp.solvers.options import Options
from softwarp.solvers.terms.cavities import CavitySystem, MembraneSystem
from softwarp.solvers.terms.contact import ContactSystem
from softwarp.solvers.terms.frames import FrameSystem
from softwarp.solvers.terms.joints import JointSystem
from softwarp.solvers.terms.quadratic import QuadraticSystem
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.launches import Launches
from softwarp.solvers.workspace.rows import Rows

Index = dict[str, wp.array]


class System(Launches):
    """Workspace and launches for the worlds of one shard.

    Args:
        model: Scene.
        index: Device arrays of the symbolic structure.
        variant: Scalar type and memory order.
        state, control, parameters: The shard's worlds.
        options: Solver options.
        more_sides: Right-hand sides of the linear solver besides those of the model's rows, for rows of the caller.
    """

    def __init__(
        self,
        model: Model,
        index: Index,
        variant: Variant,
        state: State,
        control: Control,
        parameters: Parameters,
        options: Options,
        more_sides: int = 0,
    ) -> None:
        self.model, self.variant, self.options = model, variant, options
        self.index = index
        self.state, self.control, self.parameters = state, control, parameters
        self.device = model.device
        self.world_count = int(state.node_x.shape[0])
        self.packs, self.lanes = rows.shape(variant, self.world_count)
        self.rows_count = model.row_count  # multiplier rows besides contacts
        sides = 1 + self.rows_count + more_sides
        shape = (self.world_count, sides, self.device, options.gpu_path)
        self.linear = LinearSolver(model.symbolic, index, variant, *shape)
        self.width = self.linear.width
        self.k = assembly.kernels(variant)
        self.k_cable = cable.kernels(variant)
        self.k_constraint = delassus.kernels(variant)
        self.k_state = transfer.kernels(variant)
        self.k_prescribed = prescribed.kernels(variant)
        self.dof_rows = 3 * model.dof_count
        self._bind_inputs()
        self._allocate()
        self.frames = FrameSystem(self) if model.frames is not None else None
        self.cavities = CavitySystem(self, model.cavities) if model.cavities is not None else None
        self.membranes = MembraneSystem(self, model.membranes) if model.membranes is not None else None
        first = 12 * (model.tet_count + membrane_triangles(model))
        self.quadratic = QuadraticSystem(self, model.quadratic, first) if model.quadratic is not None else None
        self.joints = JointSystem(self, model.joints) if model.joints is not None else None
        self.contact = ContactSystem(self, model.contact) if model.contact is not None else None
        self.response = self._make_response()
        is_measuring = self.contact is not None and options.newton_iterations == 1
        self.contact_passes = options.contact_passes if is_measuring else 0
        none = rows.allocate(self.variant, self.world_count, 1, self.device, wp.int32)
        self.overflow = none if self.contact is None else self.contact.contacts.overflow

    def with_options(
        self, options: Options, model: Model | None = None, index: Index | None = None, more_sides: int = 0
    ) -> System:
        """The same worlds with other options, perhaps another structure of A, and a workspace of their own."""
        worlds = (self.state, self.control, self.parameters)
        return System(model or self.model, index or self.index, self.variant, *worlds, options, more_sides)

    def _bind_inputs(self) -> None:
        """State, commands and parameters as workspace arrays: the same memory, or copies interleaved by ``load``."""
        self.interleaved: list[tuple[wp.array, Rows]] = []
        sources = {"x0": self.state.node_x, "v0": self.state.node_v, "tension": self.state.cable_tension}
        sources |= {
            "pressure": self.state.cavity_pressure,
            "pose0": self.state.frame_pose,
            "twist0": self.state.frame_twist,
        }
        names = ("held_pose", "seen_pose", "joint_position", "joint_reference", "joint_multiplier")
        sources |= {name: getattr(self.state, name) for name in names}
        sources |= {f"command_{name}": getattr(self.control, name) for name in declarations(Control)}
        sources |= {name: getattr(self.parameters, name) for name in declarations(Parameters)}
        self.input: dict[str, Rows] = {}
        for name, array in sources.items():
            if array.shape[1] == 0:
                self.input[name] = self._rows(1)
            elif self.variant.lanes > 1:
                self.input[name] = self._rows(array.shape[1])
                self.interleaved.append((array, self.input[name]))
            else:
                self.input[name] = rows.alias(self.variant, array)

    def _allocate(self) -> None:
        model, r = self.model, self._rows
        self.x, self.dof_v = r(max(3 * model.node_count, 1)), r(self.dof_rows)
        parts = model.body_count + model.rod_count + model.rigid_count
        self.body = {name: r(parts) for name in ("mu", "lam", "mass", "stiffness", "damping")}
        self.node_mass = r(model.node_count)
        self.node_internal, self.node_external = r(3 * model.node_count), r(3 * model.node_count)
        self.tet_force = r(12 * (model.tet_count + membrane_triangles(model)) + 30 * model.quadratic_count)
        self.turned = [law for law in model.law_tets if law in TURNED]
        self.stored = [law for law in model.law_tets if law not in TURNED]
        self.tet_gradient = r(12 * model.tet_count if self.turned else 1)
        self.tet_stiffness = r(90 * model.tet_count if self.stored else 1)
        self.a = r(9 * len(model.symbolic.a_row))
        self.b, self.u, self.dof_v0 = r(self.dof_rows), r(self.dof_rows), r(self.dof_rows)
        self.prescribed_v, self.prescribed_change = r(self.dof_rows), r(self.dof_rows)
        count = max(self.rows_count, 1)
        points = max(len(model.point_node), 1)
        self.point_x, self.point_gradient = r(3 * points), r(3 * points)
        self.displacement, self.target, self.lower_bound, self.upper_bound = (r(count) for _ in range(4))
        self.multiplier, self.change, self.gap, self.compliance = (r(count) for _ in range(4))
        self.floor, self.ceiling = r(count), r(count)
        self.floor.real.fill_(-FAR)
        self.ceiling.real.fill_(FAR)
        self.row = r(3 * max(model.entry_dof.size, 1))
        self.is_coupled = model.coupling_point.size > 0  # whether A has room for the stiffness of taut cables
        self.segment = r(6 * model.point_count if self.is_coupled else 1)
        self.delassus = r(count * count)
        self.constraint_residual, self.newton = r(1), r(newton.ROWS)
        self.norm = r(2)
        self.commanded = r(1)  # how far commands carry kinematic bodies in a step [m]
        self.flag = rows.allocate(self.variant, self.world_count, 2, self.device, wp.int32)

    def _make_response(self) -> ContactResponse | None:
        """Solver of multipliers with compliance and contact; cables alone have a simpler one."""
        m = self.model
        if m.cavities is None and self.contact is None and self.joints is None:
            return None
        none = contact_list.allocate(self.variant, self.world_count, 0, self.device)
        contacts = none if self.contact is None else self.contact.contacts
        response = ContactResponse(
            m.symbolic,
            self.index,
            m.dof_free,
            self.variant,
            self.world_count,
            self.rows_count,
            contacts,
            self.device,
            unbounded=() if self.joints is None else self.joints.unbounded,
            panels=self.linear.panels,
        )
        response.compliance, self.constraint_residual = self.compliance, response.residual
        response.floor, response.ceiling = self.floor, self.ceiling
        return response

    # Stages

    def load(self) -> None:
        """Bring state, commands and parameters into the workspace; raise flags for commands that are not finite."""
        for array, target in self.interleaved:
            inputs = [array, self.world_count, self.lanes]
            self.each_real(self.k_state.interleave, None, inputs, [target.real])
        self.flag.zero()
        self.x.copy_from(self.input["x0"])
        self.dof_v.zero()
        self.place(self.input["tension"], self.model.cable_count, self.multiplier, 0)
        if self.cavities is not None:
            self.cavities.load()
        if self.contact is not None:
            self.contact.load()
            laws = [values.real for values in vars(self.contact.pairs).values()]
            self.each_real(self.k_state.check_pairs, self.contact.model.count, laws, [self.flag.real])
        if self.joints is not None:
            self.joints.load()
        names = ["cable_displacement", "cable_tension", "node_force", "cavity_pressure", "cavity_volume", "cavity_gas"]
        for name in names:
            values, count = self.input[f"command_{name}"].real, getattr(self.control, name).shape[1]
            self.check_finite(values, count)
        if self.frames is not None:
            self.frames.load()

    def check_finite(self, values: wp.array, count: int) -> None:
        """Raise the flags of worlds where one of the first rows of ``values``, in the view ``real``, is not finite."""
        self.each_real(self.k_state.check_rows, self.variant.parts(count), [count, values], [self.flag.real])

    def scale(self, h: float) -> None:
        """Moduli and matrix factors of every body; ``h`` = 0 selects the quasi-static mode."""
        self.tangent_scale = h * h if h > 0.0 else 1.0  # of forces without damping, in A
        self.is_moving = h > 0.0
        i, b = self.input, self.body
        inputs = [i["youngs"].S, i["nu"].S, i["rayleigh_mass"].S, i["rayleigh_stiffness"].S, h]
        outputs = [b["mu"].S, b["lam"].S, b["mass"].S, b["stiffness"].S, b["damping"].S]
        self.each(self.k.body_moduli, self.model.body_count, inputs, outputs)
        if self.frames is not None:
            self.frames.scale(h)

    def measure_rows(self) -> None:
        """Points, displacements (of chambers: volumes) and gradients of all rows at the trial positions."""
        m = self.model
        inputs = [m.cable_point_start_device, m.point_node, m.point_weight, m.point_anchor]
        inputs += [m.cable_rest_length, m.cable_closing_length, self.x.S]
        outputs = [self.point_x.S, self.point_gradient.S, self.displacement.S]
        self.each(self.k_cable.cable_geometry, m.cable_count, inputs, outputs)
        if self.cavities is not None:
            self.cavities.measure()
        if self.joints is not None:
            self.joints.measure()

    def command(self, h: float) -> None:
        """Targets and bounds of the multiplier rows from commands, limits and measured displacements."""
        i = self.input
        names = ("min_displacement", "max_displacement", "min_tension", "max_tension", "max_rate")
        inputs = [self.model.cable_force_control]
        inputs += [i["command_cable_displacement"].S, i["command_cable_tension"].S]
        inputs += [*(i[f"cable_{name}"].S for name in names), self.displacement.S, h]
        outputs = [self.target.S, self.lower_bound.S, self.upper_bound.S]
        self.each(self.k_cable.cable_command, self.model.cable_count, inputs, outputs)
        self.compliance.zero()  # of cables; chambers set theirs
        if self.cavities is not None:
            self.cavities.command(h)
        self.row_laws()
        if self.joints is not None:
            self.joints.command(h)
            self.joints.predict(h)
        if self.frames is not None:
            self.frames.command(h)

    def row_laws(self) -> None:
        """Laws of rows at the present displacements; needs ``measure_rows``."""
        if self.cavities is not None:
            self.cavities.law()

    def find_contacts(self, h: float, moving: bool, falling: bool = True) -> None:
        """Contacts at the trial positions; ``moving`` says that velocities have been found in this step."""
        if self.contact is not None:
            self.contact.find(h, moving, falling)

    def clamp_multipliers(self) -> None:
        """Bring the multipliers within the bounds of new commands."""
        inputs = [self.lower_bound.S, self.upper_bound.S]
        self.each(self.k_constraint.clamp_rows, self.rows_count, inputs, [self.multiplier.S])

    def check_velocities(self) -> None:
        """Raise flags for start velocities that are not finite; Newton's step control would hide them."""
        names = ("v0",) if self.frames is None else ("v0", "twist0")
        for velocity in (self.input[name].real for name in names):
            self.check_finite(velocity, velocity.shape[1])

    def forces(self) -> None:
        """Element forces, then elastic and external force of every node, at the trial positions."""
        m, b, i = self.model, self.body, self.input
        for law, tets in m.law_tets.items():
            shared = [tets, m.tet_node, m.tet_body, m.tet_gradient, m.tet_volume]
            if law in TURNED:
                kernel = (corotational if law == "large" else warped).kernels(self.variant).tet_force
                inputs = [*shared, m.tet_frame, b["mu"].S, b["lam"].S, self.x.S]
                self.each(kernel, tets.size, inputs, [self.tet_gradient.S, self.tet_force.S])
            else:
                kernels = hyperelastic.kernels(self.variant, law, self.options.project_tangent)
                inputs = [*shared, b["mu"].real, b["lam"].real, self.x.real]
                self.each_real(kernels.tet_force, tets.size, inputs, [self.tet_force.real])
        if self.membranes is not None:
            self.membranes.forces()
        if self.quadratic is not None:
            self.quadratic.forces()
        inputs = [
            m.node_body,
            m.node_volume,
            m.node_load,
            m.corner_start,
            m.corner,
            i["density"].S,
            i["gravity"].S,
            i["command_node_force"].S,
            self.tet_force.S,
        ]
        outputs = [self.node_mass.S, self.node_internal.S, self.node_external.S]
        self.each(self.k.node_forces, m.body_node_count, inputs, outputs)
        if self.quadratic is not None:
            self.quadratic.weigh()
        if self.frames is not None:
            self.frames.segments()
            self.frames.forces()

    def tangent(self) -> None:
        """A = m_scale M + k_scale K at the trial positions; needs ``forces``."""
        m, b = self.model, self.body
        blocks = len(m.symbolic.a_row)
        inputs = [m.dof_count, m.node_count, m.dof_node, m.node_body, b["mass"].S, self.node_mass.S]
        self.each(self.k.block_mass, blocks, inputs, [self.a.S])
        if self.turned:
            inputs = [corotational.TURNED_ROWS, corotational.TURNED_BITS]
            inputs += [m.tet_body, m.large_entry_start, m.large_entry]
            inputs += [b["mu"].S, b["lam"].S, b["stiffness"].S, self.tet_gradient.S]
            self.each(corotational.kernels(self.variant).block_stiffness, blocks, inputs, [self.a.S])
        for law in self.stored:
            kernels = hyperelastic.kernels(self.variant, law, self.options.project_tangent)
            tets = m.law_tets[law]
            inputs = [tets, m.tet_node, m.tet_body, m.tet_gradient, m.tet_volume]
            inputs += [b["mu"].real, b["lam"].real, self.x.real]
            self.each_real(kernels.tet_stiffness, tets.size, inputs, [self.tet_stiffness.real])
        if self.stored:
            inputs = [m.tet_body, m.stored_entry_start, m.stored_entry, b["stiffness"].S, self.tet_stiffness.S]
            self.each(hyperelastic.gather_kernels(self.variant).block_stiffness, blocks, inputs, [self.a.S])
        if self.membranes is not None:
            self.membranes.tangent()
        if self.quadratic is not None:
            self.quadratic.tangent(self.is_moving)
        if self.frames is not None:
            self.frames.tangent()

    def cable_tangent(self) -> None:
        """Add the stiffness of taut cables to A; needs ``measure_rows`` and a coupled model."""
        m = self.model
        inputs = [m.cable_point_start_device, m.point_cable, m.cable_closing_length]
        inputs += [self.point_x.S, self.multiplier.S]
        self.each(self.k_cable.segment_stiffness, m.point_count, inputs, [self.segment.S])
        inputs = [m.coupling_start, m.coupling_point, m.coupling_weight, self.segment.S]
        self.each(self.k_cable.block_stiffness, len(m.symbolic.a_row), inputs, [self.a.S])

    def right_hand_side(self, f_scale: float, inertia: bool, moving: bool) -> None:
        """b of ``kernels.elements.assembly``; needs ``forces`` and ``tangent``. Completes A with the tangent of loads.

        That comes after b, because damping is proportional to the stiffness of elements only.
        """
        m, b = self.model, self.body
        inputs = [m.node_count, m.dof_node, m.node_body, m.neighbour_start, m.neighbour, m.neighbour_block]
        inputs += [b["mass"].S, b["damping"].S, self.node_mass.S, self.node_internal.S, self.node_external.S]
        inputs += [self.input["v0"].S, self.a.S, self.dof_v.S, f_scale, 1.0 if inertia else 0.0, moving]
        self.each(self.k.right_hand_side, m.dof_count, inputs, [self.b.S])
        if self.quadratic is not None and inertia:
            self.quadratic.momentum()
        if self.frames is not None:
            self.frames.right_hand_side(f_scale, 1.0 if inertia else 0.0, moving)
        if self.joints is not None:
            self.joints.gyrate(f_scale, moving)
        if self.cavities is not None and self.options.pressure_tangent:
            self.cavities.tangent()
        if self.joints is not None and self.options.pressure_tangent:
            self.joints.tangent()
        self.prescribe()

    def prescribe(self) -> None:
        """Eliminate prescribed scalars from A u = b."""
        m, k = self.model, self.k_prescribed
        if m.prescribed_dof.size == 0:
            return
        inputs = [m.prescribed_dof, m.dof_free, self.prescribed_v.S, self.dof_v.S]
        self.each(k.prescribed_change, m.prescribed_dof.size, inputs, [self.prescribed_change.S])
        inputs = [m.touched_dof, m.dof_free, m.neighbour_start, m.neighbour, m.neighbour_block]
        inputs += [self.a.S, self.prescribed_change.S]
        self.each(k.known_to_right, m.touched_dof.size, inputs, [self.b.S])
        inputs = [m.masked_block, m.block_row, m.block_col, m.dof_free]
        self.each(k.mask_blocks, m.masked_block.size, inputs, [self.a.S])

    def solve(self, f_scale: float, x_scale: float) -> None:
        """Unknowns ``u`` and multipliers of ``A u = b + f_scale H' multiplier`` with the rows' laws."""
        m, linear = self.model, self.linear
        y = linear.y
        linear.factor(self.a)
        is_corrected = self.joints is not None and self.options.newton_iterations == 1
        passes = max(self.options.refinement, int(is_corrected), self.contact_passes)
        for refinement in range(1 + passes):
            is_first = refinement == 0
            if is_first:
                y.zero()
                self.rows_into_sides()
                self.each(self.k.accumulate, self.dof_rows, [self.b.S], [y.S])
                self._start_unknowns(y)
            else:
                if self.joints is not None and is_corrected:
                    self.joints.correct(x_scale)
                inputs = [m.neighbour_start, m.neighbour, m.neighbour_block, self.a.S, self.b.S, self.u.S]
                self.each(self.k.residual, m.dof_count, inputs, [y.S])
            if self.response is not None:
                self._respond(self.response, refinement, f_scale, x_scale)
            elif self.rows_count:
                self.add_row_forces(y, f_scale)
                linear.forward(1 + self.rows_count if is_first else 1)
                self._multipliers(y, f_scale, x_scale, is_first)
            else:
                linear.forward(1)
            if linear.panels is not None:
                linear.panels.backward(self.u)
            else:
                linear.backward()
                self.each(self.k.accumulate, self.dof_rows, [y.S], [self.u.S])

    def rotation_step(self, x_scale: float) -> None:
        """Make changes of rotation in ``u`` changes of angular velocity; needs ``solve`` at the present velocities."""
        if self.frames is not None:
            self.frames.rotation_step(x_scale)

    def _start_unknowns(self, y: Rows) -> None:
        """Unknowns start from what is prescribed, which the right-hand side then need not bring about."""
        m = self.model
        if m.prescribed_dof.size == 0:
            self.u.zero()
            return
        self.u.copy_from(self.prescribed_change)
        self.each(self.k_prescribed.clear_known, m.prescribed_dof.size, [m.prescribed_dof, m.dof_free], [y.S])

    def _respond(self, response: ContactResponse, refinement: int, f_scale: float, x_scale: float) -> None:
        """Forward substitution with the multipliers of static rows and contacts."""
        y, linear, o = self.linear.y, self.linear, self.options
        is_first = refinement == 0
        if self.rows_count:
            self.add_row_forces(y, f_scale)
        response.add_forces(y, f_scale)
        if is_first:
            response.sides(linear)
        linear.forward(1 + self.rows_count if is_first else 1)
        if is_first:
            response.delassus(y, f_scale * x_scale)
        if self.rows_count:
            self._free_gaps(y, x_scale, response.gap)
        end = None
        if self.contact_passes and not is_first:
            end = self._look_ahead(response, f_scale, x_scale, again=refinement > 1)
        response.gaps(
            y,
            u=self.u,
            v=self.dof_v,
            v0=self.dof_v0,
            x_scale=x_scale,
            recovery=o.recovery_speed,
            bounce_speed=o.bounce_speed,
            share=o.recovery_share(x_scale),
            end=end,
        )
        sweeps, tolerance = o.gauss_seidel_iterations, o.gap_tolerance(self.model.extent, x_scale)
        response.solve(self.lower_bound, self.upper_bound, self.multiplier, sweeps=sweeps, tolerance=tolerance)
        response.add_change(y, f_scale)

    def _look_ahead(self, response: ContactResponse, f_scale: float, x_scale: float, *, again: bool) -> Rows:
        """Distances of the contacts where the unknowns of the last pass lead to; new ones join the response."""
        assert self.contact is not None
        self.dof_v.copy_from(self.u)
        self.move(x_scale)
        self.contact.look(x_scale, again=again)
        self.dof_v.zero()
        if self.joints is not None:
            self.move(x_scale)  # joints measure at the start
        response.sides(self.linear)
        response.delassus(self.linear.y, f_scale * x_scale, late=True)
        return self.contact.end

    def rows_into_sides(self) -> None:
        """H from the point gradients, and its transpose among the right-hand sides."""
        m = self.model
        inputs = [m.dof_count, m.entry_dof, m.entry_row, m.entry_start, m.entry_point, m.entry_weight]
        inputs += [m.entry_item, m.dof_free, self.point_gradient.S, self.lever.S]
        entries = m.entry_start.size - 1 if self.rows_count else 0
        self.each(self.k_cable.cable_rows, entries, inputs, [self.row.S, self.linear.y.S])
        if self.joints is not None:
            self.joints.sides()

    @property
    def lever(self) -> Rows:
        """Levers of carried slots; one unused row without frames."""
        return self.norm if self.frames is None else self.frames.lever

    def add_row_forces(self, target: Rows, f_scale: float) -> None:
        """target += f_scale H' multiplier."""
        m = self.model
        inputs = [m.dof_entry_start, m.dof_entry, m.entry_row, m.dof_free]
        inputs += [self.row.S, self.multiplier.S, f_scale]
        self.each(self.k_constraint.row_force, m.dof_count, inputs, [target.S])

    def _multipliers(self, y: Rows, f_scale: float, x_scale: float, is_first: bool) -> None:
        """W in the first pass; multipliers, and their change in side 0."""
        m, k, count, panels = self.model, self.k_constraint, self.rows_count, self.linear.panels
        if panels is not None and count <= cable_block.MOST_ROWS:
            inputs = [m.dof_count, count, m.delassus_pair, m.row_entry_start, m.entry_dof, panels.index["column"]]
            inputs += [panels.threads, is_first, self.options.gauss_seidel_iterations]
            inputs += [panels.half, self.row.S, self.u.S, self.displacement.S, self.target.S]
            inputs += [self.lower_bound.S, self.upper_bound.S, f_scale, x_scale]
            outputs = [self.delassus.S, self.multiplier.S, self.constraint_residual.S, y.S]
            panels.cooperate(cable_block.kernels(self.variant).solve_rows, inputs, outputs)
            return
        if is_first:
            inputs = [m.dof_count, count, m.delassus_pair, y.S, f_scale * x_scale]
            self.each(k.delassus, len(m.delassus_pair), inputs, [self.delassus.S])
        self._free_gaps(y, x_scale, self.gap)
        inputs = [count, self.options.gauss_seidel_iterations, self.delassus.S]
        inputs += [self.lower_bound.S, self.upper_bound.S]
        outputs = [self.gap.S, self.multiplier.S, self.change.S, self.constraint_residual.S]
        self.each_world(k.gauss_seidel, inputs, outputs)
        inputs = [m.dof_count, count, self.change.S, f_scale]
        self.each(k.add_change, self.variant.parts(self.dof_rows), inputs, [y.S])

    def _free_gaps(self, y: Rows, x_scale: float, gap: Rows) -> None:
        """Gaps of the static rows before new multipliers."""
        m = self.model
        inputs = [m.dof_count, m.row_entry_start, m.entry_dof, self.row.S, self.u.S, y.S]
        inputs += [self.displacement.S, self.target.S, x_scale]
        self.each(self.k_constraint.free_gap, self.rows_count, inputs, [gap.S])

    def imbalance(self, f_scale: float, inertia: bool) -> None:
        """Norms of b + f_scale H' multiplier and of the forces in it, into ``norm``; overwrites side 0."""
        m, y = self.model, self.linear.y
        y.zero()
        self.rows_into_sides()
        self.each(self.k.accumulate, self.dof_rows, [self.b.S], [y.S])
        if self.rows_count:
            self.add_row_forces(y, f_scale)
        if self.response is not None:
            self.response.add_forces(y, f_scale)
        force_rows = 12 * m.tet_count if self.quadratic is None else self.quadratic.end
        inputs = [m.dof_count, m.node_count, m.dof_node, force_rows]
        inputs += [self.node_mass.S, self.node_external.S, self.input["v0"].S]
        inputs += [self.tet_force.S, y.S, f_scale, 1.0 if inertia else 0.0]
        self.each_world(self.k.force_norms, inputs, [self.norm.S])
        if self.frames is not None:
            self.frames.force_norms(f_scale)

    def move(self, x_scale: float) -> None:
        """Trial positions x0 + x_scale v."""
        inputs = [self.model.node_dof, self.input["x0"].S, self.dof_v.S, x_scale]
        self.each(self.k.trial_position, self.model.node_count, inputs, [self.x.S])
        if self.frames is not None:
            self.frames.move(x_scale)

    def refresh(self) -> None:
        """Outputs that follow from positions into the state, where these were written by hand."""
        if self.cavities is None and self.frames is None:
            return
        self.load()
        self.measure_rows()
        if self.cavities is not None:
            self.cavities.write_volume()
        if self.frames is not None:
            self.frames.refresh()
        if self.joints is not None:
            self.joints.refresh()

    def commit(self, h: float, v_scale: float, iterated: bool) -> None:
        """Check every world; write the good ones to the state and give each its status.

        ``iterated`` says that Newton's control rows tell which worlds converged.
        """
        m, k, s = self.model, self.k_state, self.state
        if self.joints is not None:
            self.joints.release(h)
        inputs = [m.node_dof, self.input["x0"].real, self.x.real, self.dof_v.real]
        inputs += [self.commanded.real, self.options.reach * m.extent]
        parts = self.variant.parts(m.node_count)
        self.each_real(k.check_nodes, parts, inputs, [self.flag.real])
        if self.rows_count:
            self.check_finite(self.multiplier.real, self.rows_count)
        if self.frames is not None:
            self.frames.commit(h)
        inputs = [m.node_dof, self.lanes, self.flag.real, self.x.real, self.dof_v.real, v_scale]
        self.each_real(k.commit_nodes, parts, inputs, [s.node_x, s.node_v, s.good_x, s.good_v])
        cables = m.cable_count
        if cables:
            inputs = [self.lanes, self.flag.real, self.multiplier.real]
            self.each_real(k.commit_rows, cables, inputs, [s.cable_tension])
        if self.cavities is not None:
            self.cavities.write()
        if self.joints is not None:
            self.joints.write(h)
        if self.contact is not None:
            self.contact.write()
        if self.frames is not None:
            self.frames.write()
        inputs = [self.lanes, h, iterated, self.flag.real, self.constraint_residual.real, self.newton.real]
        inputs.append(self.overflow.real)
        self.each_real(k.commit_status, None, inputs, [s.status, s.contact_overflow, s.time, s.residual])


def membrane_triangles(model: Model) -> int:
    """Triangles of all membranes."""
    return 0 if model.membranes is None else len(model.membranes.triangles)
