"""Air chambers: closed triangulated surfaces in soft bodies, with a law of pressure. Theory: docs/theory/cavity.md.

A chamber's surface passes through points that nodes carry, as a cable's does. With outward triangles its volume is
V = 1/6 sum a . (b x c); its constraint row is H = dV/dx, and a gauge pressure p [Pa] pushes the nodes with H' p, so the
multiplier of the row is the pressure itself whatever the step is. Rows have the form

    gap = V - target + compliance p,   gap = 0 while lower < p < upper.

Order of a step: ``cavity_points``, ``cavity_gradient`` and ``cavity_volume`` (on a CPU ``measure_cavity`` of
``cavity_surface``), then once ``cavity_command`` and, at every
linearisation, ``cavity_law``. The tangent -p d2V/dx2 follows from ``edge_stiffness`` and ``block_stiffness``.

Points and rows are numbered from ``first_point`` and ``first_row``, so that chambers can share arrays with cables; the
indices in ``point_ring``, ``edge_opposite`` and ``cavity_point_start`` count from the beginning of those arrays.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import team
from softwarp.kernels.algebra.lanes import LANE_COUNT, Variant
from softwarp.model.codes import UNBOUNDED, CavityControl

SQUEEZE = 1.0e-3  # share of its free volume below which a gas is not compressed further; keeps the law finite
RAREFACTION = 1.0e-6  # share of the chamber that its gas at least fills at ambient pressure; as above, towards vacuum
EMPTY = 1.0e-15  # m^3, volume of a chamber that is squeezed flat; as above
STRIDE = 0.25  # of the volume, now or at rest, that volume control asks for in one linearisation; see the theory page


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Cavity kernels for one scalar type."""
    S = variant.S
    real = variant.real
    mul, div = variant.mul, variant.div
    world_fastest = variant.world_fastest
    module = variant.module("cavity")

    if variant.lanes > 1:

        @wp.func
        def power(a: S, b: S):
            """a^b of every lane."""
            result = S()
            for lane in range(wp.static(LANE_COUNT)):
                result[lane] = wp.pow(a[lane], b[lane])
            return result

    else:

        @wp.func
        def power(a: S, b: S):
            """a^b."""
            return wp.pow(a, b)

    @wp.kernel(module=module, enable_backward=False)
    def cavity_points(
        # Model
        first_point: int,
        point_node: wp.array2d(dtype=wp.int32),
        point_weight: wp.array2d(dtype=real),
        point_anchor: wp.array2d(dtype=real),
        # Workspace in
        node_x_in: wp.array2d(dtype=S),
        # Workspace out
        point_x_out: wp.array2d(dtype=S),
    ):
        """Position [m] of one surface point: its anchor plus its weighted nodes (-1: none)."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        p = first_point + item
        x = S(point_anchor[p, 0])
        y = S(point_anchor[p, 1])
        z = S(point_anchor[p, 2])
        for k in range(4):
            node = point_node[p, k]
            if node >= 0:
                weight = point_weight[p, k]
                x += node_x_in[w, 3 * node] * weight
                y += node_x_in[w, 3 * node + 1] * weight
                z += node_x_in[w, 3 * node + 2] * weight
        point_x_out[w, 3 * p] = x
        point_x_out[w, 3 * p + 1] = y
        point_x_out[w, 3 * p + 2] = z

    @wp.kernel(module=module, enable_backward=False)
    def cavity_gradient(
        # Model
        first_point: int,
        ring_start: wp.array(dtype=wp.int32),
        point_ring: wp.array2d(dtype=wp.int32),
        # Workspace in
        point_x_in: wp.array2d(dtype=S),
        # Workspace out
        point_gradient_out: wp.array2d(dtype=S),
    ):
        """dV/dx [m^2] of one point: a third of the area vectors around it, sum (b - x) x (c - x) / 6.

        ``ring_start`` counts from the first cavity point; ``point_ring`` holds b and c of every triangle (x, b, c).
        Edges from the point itself make this exact to rounding far from the origin too.
        """
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        p = 3 * (first_point + item)
        x0 = point_x_in[w, p]
        x1 = point_x_in[w, p + 1]
        x2 = point_x_in[w, p + 2]
        g0 = S(real(0.0))
        g1 = S(real(0.0))
        g2 = S(real(0.0))
        for r in range(ring_start[item], ring_start[item + 1]):
            b = 3 * point_ring[r, 0]
            c = 3 * point_ring[r, 1]
            b0 = point_x_in[w, b] - x0
            b1 = point_x_in[w, b + 1] - x1
            b2 = point_x_in[w, b + 2] - x2
            c0 = point_x_in[w, c] - x0
            c1 = point_x_in[w, c + 1] - x1
            c2 = point_x_in[w, c + 2] - x2
            g0 += mul(b1, c2) - mul(b2, c1)
            g1 += mul(b2, c0) - mul(b0, c2)
            g2 += mul(b0, c1) - mul(b1, c0)
        sixth = real(1.0) / real(6.0)
        point_gradient_out[w, p] = g0 * sixth
        point_gradient_out[w, p + 1] = g1 * sixth
        point_gradient_out[w, p + 2] = g2 * sixth

    @wp.func
    def moment(
        point_x: wp.array2d(dtype=S),
        point_gradient: wp.array2d(dtype=S),
        w: int,
        first: int,
        begin: int,
        end: int,
        step: int,
    ):
        """Sum of (x_p - x_0) . dV/dx_p over some points of a chamber, whose first is x_0."""
        total = S(real(0.0))
        for p in range(begin, end, step):
            for c in range(3):
                offset = point_x[w, 3 * p + c] - point_x[w, 3 * first + c]
                total += mul(offset, point_gradient[w, 3 * p + c])
        return total

    @wp.kernel(module=module, enable_backward=False)
    def cavity_volume(
        # Model
        first_row: int,
        cavity_point_start: wp.array(dtype=wp.int32),
        # Workspace in
        point_x_in: wp.array2d(dtype=S),
        point_gradient_in: wp.array2d(dtype=S),
        # Workspace out
        volume_out: wp.array2d(dtype=S),
    ):
        """Volume [m^3] of one chamber: V = 1/3 sum (x_i - x_0) . dV/dx_i, as V is homogeneous of degree 3."""
        w, cavity = wp.tid()
        if wp.static(world_fastest):
            cavity, w = wp.tid()
        first = cavity_point_start[cavity]
        total = moment(point_x_in, point_gradient_in, w, first, first + 1, cavity_point_start[cavity + 1], 1)
        volume_out[w, first_row + cavity] = total * (real(1.0) / real(3.0))

    @wp.kernel(module=module, enable_backward=False)
    def cavity_command(
        # Model
        first_row: int,
        cavity_control: wp.array(dtype=wp.int32),
        # Workspace in
        pressure_command_in: wp.array2d(dtype=S),
        volume_command_in: wp.array2d(dtype=S),
        gas_command_in: wp.array2d(dtype=S),
        min_pressure_in: wp.array2d(dtype=S),
        max_pressure_in: wp.array2d(dtype=S),
        min_volume_in: wp.array2d(dtype=S),
        max_volume_in: wp.array2d(dtype=S),
        max_pressure_rate_in: wp.array2d(dtype=S),
        max_flow_in: wp.array2d(dtype=S),
        ambient_in: wp.array2d(dtype=S),
        exponent_in: wp.array2d(dtype=S),
        pressure_in: wp.array2d(dtype=S),
        volume_in: wp.array2d(dtype=S),
        lag_in: wp.array2d(dtype=S),
        h: real,
        lapse: real,
        # Workspace out
        goal_out: wp.array2d(dtype=S),
        lower_out: wp.array2d(dtype=S),
        upper_out: wp.array2d(dtype=S),
    ):
        """Turn a command into a goal, the volume or the amount of gas [m^3], and pressure bounds [Pa].

        Commands, limits, ``ambient_in`` [Pa] and ``exponent_in`` have one row per chamber; ``pressure_in`` (the
        multiplier at the start of the step), ``volume_in`` (measured there) and the outputs are rows of the solver,
        from ``first_row`` on. ``max_pressure_rate_in`` [Pa/s] limits pressure control and ``max_flow_in`` [m^3/s]
        volume and gas control, around the measured value; h <= 0, statics, has no rate. An amount of gas is the
        volume it fills at ambient pressure; ``min_volume`` and ``max_volume`` bound only volume control.
        ``lag_in`` is the part of the way to a commanded volume that is left to later stages of the step, and ``lapse``
        [s] the time in which pressures move. ``cavity_law`` completes the row.
        """
        w, cavity = wp.tid()
        if wp.static(world_fastest):
            cavity, w = wp.tid()
        row = first_row + cavity
        low = min_pressure_in[w, cavity]
        high = max_pressure_in[w, cavity]
        pressure = pressure_in[w, row]
        volume = volume_in[w, row]
        change = S(real(wp.static(UNBOUNDED)))
        flow = S(real(wp.static(UNBOUNDED)))
        if h > real(0.0):
            change = max_pressure_rate_in[w, cavity] * lapse
            flow = max_flow_in[w, cavity] * h
        control = cavity_control[cavity]
        goal = volume
        if control == wp.static(CavityControl.PRESSURE):
            command = wp.min(wp.max(pressure_command_in[w, cavity], low), high)
            low = wp.min(wp.max(command, pressure - change), pressure + change)
            high = low
        if control == wp.static(CavityControl.VOLUME):
            goal = wp.min(wp.max(volume_command_in[w, cavity], min_volume_in[w, cavity]), max_volume_in[w, cavity])
            goal = goal - mul(lag_in[w, 0], goal - volume)
            goal = wp.min(wp.max(goal, volume - flow), volume + flow)
        if control == wp.static(CavityControl.GAS):
            ambient = ambient_in[w, cavity]
            ratio = wp.max(div(pressure + ambient, ambient), S(real(0.0)))
            held = mul(volume, power(ratio, div(S(real(1.0)), exponent_in[w, cavity])))
            goal = wp.min(wp.max(gas_command_in[w, cavity], held - flow), held + flow)
        goal_out[w, row] = goal
        lower_out[w, row] = low
        upper_out[w, row] = high

    @wp.kernel(module=module, enable_backward=False)
    def cavity_law(
        # Model
        first_row: int,
        cavity_control: wp.array(dtype=wp.int32),
        rest_volume: wp.array(dtype=real),
        # Workspace in
        ambient_in: wp.array2d(dtype=S),
        exponent_in: wp.array2d(dtype=S),
        goal_in: wp.array2d(dtype=S),
        volume_in: wp.array2d(dtype=S),
        # Workspace out
        target_out: wp.array2d(dtype=S),
        compliance_out: wp.array2d(dtype=S),
    ):
        """Target [m^3] and compliance [m^3/Pa] of one row at the present volume V.

        A gas has p = ambient (gas / V)^exponent - ambient, linearised at V: compliance C = V / (exponent (p + ambient))
        and target V + C p. Volume control goes towards its goal by a share of the volume at most.
        """
        w, cavity = wp.tid()
        if wp.static(world_fastest):
            cavity, w = wp.tid()
        row = first_row + cavity
        volume = volume_in[w, row]
        goal = goal_in[w, row]
        way = wp.max(volume, S(rest_volume[cavity])) * real(wp.static(STRIDE))
        target = wp.min(wp.max(goal, volume - way), volume + way)
        compliance = S(real(0.0))
        if cavity_control[cavity] == wp.static(CavityControl.GAS):
            least = S(real(wp.static(EMPTY)))
            gas = wp.max(goal, wp.max(volume, least) * real(wp.static(RAREFACTION)))
            dense = wp.max(wp.max(volume, least), gas * real(wp.static(SQUEEZE)))
            ambient = ambient_in[w, cavity]
            exponent = exponent_in[w, cavity]
            absolute = mul(ambient, power(div(gas, dense), exponent))
            compliance = div(dense, mul(exponent, absolute))
            target = volume + mul(compliance, absolute - ambient)
        target_out[w, row] = target
        compliance_out[w, row] = compliance

    @wp.kernel(module=module, enable_backward=False)
    def whole_share(
        # Workspace out
        share_out: wp.array2d(dtype=S),
    ):
        """A receives the whole tangent."""
        w = wp.tid()
        share_out[w, 0] = S(real(1.0))

    @wp.kernel(module=module, enable_backward=False)
    def edge_stiffness(
        # Model
        first_row: int,
        edge_cavity: wp.array(dtype=wp.int32),
        edge_opposite: wp.array2d(dtype=wp.int32),
        # Workspace in
        point_x_in: wp.array2d(dtype=S),
        pressure_in: wp.array2d(dtype=S),
        share_in: wp.array2d(dtype=S),
        scale: real,
        # Workspace out
        edge_out: wp.array2d(dtype=S),
    ):
        """Vector s [N/m] of one surface edge (i, j): the tangent's block of points i and j is [s]x, of j and i -[s]x.

        The triangles (i, j, k) and (j, i, l) share the edge, k and l are ``edge_opposite``:
        s = -share scale p (x_l - x_k) / 6, with one ``share_in`` per world.
        """
        w, edge = wp.tid()
        if wp.static(world_fastest):
            edge, w = wp.tid()
        left = 3 * edge_opposite[edge, 0]
        right = 3 * edge_opposite[edge, 1]
        factor = mul(pressure_in[w, first_row + edge_cavity[edge]], share_in[w, 0]) * (scale / real(6.0))
        for c in range(3):
            edge_out[w, 3 * edge + c] = mul(factor, point_x_in[w, left + c] - point_x_in[w, right + c])

    @wp.kernel(module=module, enable_backward=False)
    def block_stiffness(
        # Model
        coupling_start: wp.array(dtype=wp.int32),
        coupling_edge: wp.array(dtype=wp.int32),
        coupling_weight: wp.array(dtype=real),
        # Workspace in
        edge_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """Add the skew blocks of all edges that tie two nodes together to one 3x3 block of A."""
        w, block = wp.tid()
        if wp.static(world_fastest):
            block, w = wp.tid()
        begin = coupling_start[block]
        end = coupling_start[block + 1]
        if begin < end:
            s0 = S(real(0.0))
            s1 = S(real(0.0))
            s2 = S(real(0.0))
            for p in range(begin, end):
                edge = 3 * coupling_edge[p]
                weight = coupling_weight[p]
                s0 += edge_in[w, edge] * weight
                s1 += edge_in[w, edge + 1] * weight
                s2 += edge_in[w, edge + 2] * weight
            k = 9 * block
            a_out[w, k + 1] -= s2
            a_out[w, k + 2] += s1
            a_out[w, k + 3] += s2
            a_out[w, k + 5] -= s0
            a_out[w, k + 6] -= s1
            a_out[w, k + 7] += s0

    @wp.kernel(module=module, enable_backward=False)
    def to_row(
        # Model
        first_row: int,
        cavity_area: wp.array(dtype=real),
        # Workspace in
        volume_in: wp.array2d(dtype=S),
        target_in: wp.array2d(dtype=S),
        lower_in: wp.array2d(dtype=S),
        upper_in: wp.array2d(dtype=S),
        compliance_in: wp.array2d(dtype=S),
        # Workspace out
        displacement_out: wp.array2d(dtype=S),
        target_out: wp.array2d(dtype=S),
        lower_out: wp.array2d(dtype=S),
        upper_out: wp.array2d(dtype=S),
        compliance_out: wp.array2d(dtype=S),
    ):
        """One chamber as a row in metres and newtons: volumes over, pressures times its area at rest."""
        w, cavity = wp.tid()
        if wp.static(world_fastest):
            cavity, w = wp.tid()
        row = first_row + cavity
        area = cavity_area[cavity]
        inverse = real(1.0) / area
        displacement_out[w, row] = volume_in[w, cavity] * inverse
        target_out[w, row] = target_in[w, cavity] * inverse
        lower_out[w, row] = lower_in[w, cavity] * area
        upper_out[w, row] = upper_in[w, cavity] * area
        compliance_out[w, row] = compliance_in[w, cavity] * (inverse * inverse)

    @wp.kernel(module=module, enable_backward=False)
    def scale_gradient(
        # Model
        first_point: int,
        cavity_area: wp.array(dtype=real),
        point_cavity: wp.array(dtype=wp.int32),
        # Workspace out
        point_gradient_out: wp.array2d(dtype=S),
    ):
        """dV/dx of one point over the chamber's area, for a row in metres."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        inverse = real(1.0) / cavity_area[point_cavity[item]]
        p = 3 * (first_point + item)
        for c in range(3):
            point_gradient_out[w, p + c] = point_gradient_out[w, p + c] * inverse

    @wp.kernel(module=module, enable_backward=False)
    def pressure_of_row(
        # Model
        first_row: int,
        cavity_area: wp.array(dtype=real),
        # Workspace in
        multiplier_in: wp.array2d(dtype=S),
        # Workspace out
        pressure_out: wp.array2d(dtype=S),
    ):
        """Gauge pressure [Pa] of one chamber from its row's multiplier [N]."""
        w, cavity = wp.tid()
        if wp.static(world_fastest):
            cavity, w = wp.tid()
        pressure_out[w, cavity] = multiplier_in[w, first_row + cavity] * (real(1.0) / cavity_area[cavity])

    @wp.kernel(module=module, enable_backward=False)
    def row_of_pressure(
        # Model
        first_row: int,
        cavity_area: wp.array(dtype=real),
        # Workspace in
        pressure_in: wp.array2d(dtype=S),
        # Workspace out
        multiplier_out: wp.array2d(dtype=S),
    ):
        """Multiplier [N] of one chamber's row from its gauge pressure [Pa]."""
        w, cavity = wp.tid()
        if wp.static(world_fastest):
            cavity, w = wp.tid()
        multiplier_out[w, first_row + cavity] = pressure_in[w, cavity] * cavity_area[cavity]

    found = {}
    if world_fastest:
        seat, whole = vars(team.functions(variant)).values()

        @wp.kernel(module=module, enable_backward=False)
        def share_volume(
            parts: int,
            # Model
            first_row: int,
            cavity_point_start: wp.array(dtype=wp.int32),
            # Workspace in
            point_x_in: wp.array2d(dtype=S),
            point_gradient_in: wp.array2d(dtype=S),
            # Workspace out
            volume_out: wp.array2d(dtype=S),
        ):
            """``cavity_volume`` where some threads of a GPU share the points of a chamber."""
            group = wp.tid()
            cavity, world, part = seat(group, cavity_point_start.shape[0] - 1, parts)
            w = wp.min(world, point_x_in.shape[0] - 1)  # all threads of a warp take part in its exchanges
            first = cavity_point_start[cavity]
            last = cavity_point_start[cavity + 1]
            total = whole(moment(point_x_in, point_gradient_in, w, first, first + 1 + part, last, parts), parts)
            if part == 0 and world < point_x_in.shape[0]:
                volume_out[w, first_row + cavity] = total * (real(1.0) / real(3.0))

        found["share_volume"] = share_volume
    return SimpleNamespace(
        **found,
        to_row=to_row,
        scale_gradient=scale_gradient,
        pressure_of_row=pressure_of_row,
        row_of_pressure=row_of_pressure,
        cavity_points=cavity_points,
        cavity_gradient=cavity_gradient,
        cavity_volume=cavity_volume,
        cavity_command=cavity_command,
        cavity_law=cavity_law,
        whole_share=whole_share,
        edge_stiffness=edge_stiffness,
        block_stiffness=block_stiffness,
    )
