"""Windup: the angles of tubes one in the other that balance torsion and bending. Theory: docs/theory/telescope.md."""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.frames import tube_section
from softwarp.kernels.frames.tube_section import GRAIN, PLAN_ROWS, RIGID

ITERATIONS = 2  # of Newton's method for the angles of the tubes in a step
MOST_TWIST = 0.1  # rad, largest change of an angle in one iteration
SYSTEM_ROWS = 20  # of a node: solution and factor of its equations
EQUATION_ROWS = 38  # of a segment: lower triangles of three symmetric matrices, and two vectors


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Windup of telescopes, on single worlds; on a GPU all segments find their equations side by side."""
    side_by_side = variant.world_fastest
    real = variant.real
    one = single.functions(variant)
    vec3, vector_at, quat_at = one.vec3, one.vector_at, one.quat_at
    vec2 = wp.types.vector(2, real)
    vec4 = wp.types.vector(4, real)
    mat44 = wp.types.matrix((4, 4), real)
    types, place_of = tube_section.structures(variant.real), tube_section.functions(variant)
    Tubes, Materials = types.Tubes, types.Materials
    shown, next_stop, part_at = place_of.shown, place_of.next_stop, place_of.part_at
    angle_at, mean_at = place_of.angle_at, place_of.mean_at
    module = variant.module("windup")

    @wp.struct
    class Equations:
        """Of the angles at both ends of a segment: second derivatives and gradient."""

        low: mat44
        between: mat44
        high: mat44
        f: vec4
        g: vec4

    @wp.func
    def hidden_stiffness(
        tubes: Tubes, materials: Materials, pack: int, lane: int, telescope: int, tube: int, reach: real, piece: real
    ):
        """Torsion spring between a tube's base and the port [N m/rad], all but rigid where it counts as straight."""
        g = materials.youngs[pack, tube, lane] / (real(2.0) * (real(1.0) + materials.nu[pack, tube, lane]))
        behind = tubes.whole[tube] - reach
        length = real(0.0)  # of a tube with its own modulus that twists as easily
        start = real(0.0)
        for k in range(tubes.section_start[tube], tubes.section_start[tube + 1]):
            end = wp.min(tubes.section_end[k], behind)
            length += wp.max(end - start, real(0.0)) / tubes.section_ratio[k]
            start = wp.max(start, end)
        if tubes.hidden_twists[telescope] == 0:
            length = real(0.0)
        return g * tubes.area[4 * tube + 3] / wp.max(length, real(wp.static(RIGID)) * piece)

    @wp.func
    def inverted(a: mat44):
        """Inverse of a positive definite matrix; it is scaled, since its determinant would underflow in float32."""
        scale = real(0.0)
        for k in range(4):
            scale = wp.max(scale, a[k, k])
        rows = vec4()
        for k in range(4):
            rows[k] = real(1.0) / wp.sqrt(wp.max(a[k, k], scale * real(1.0e-30)))
        unit = mat44()
        for k in range(4):
            for j in range(4):
                unit[k, j] = a[k, j] * rows[k] * rows[j]
        result = wp.inverse(unit)
        for k in range(4):
            for j in range(4):
                result[k, j] = result[k, j] * rows[k] * rows[j]
        return result

    @wp.func
    def segment_equations(
        tubes: Tubes,
        materials: Materials,
        length: wp.array3d(dtype=real),
        before: wp.array3d(dtype=real),
        windup: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        item: int,
        carrier: int,
        line: real,
        place: int,
        moment: vec2,
        twist: real,
        yields: bool,
        has_turned: bool,
    ):
        """Equations of one segment of a telescope: bending ``moment`` [N m] of loads, ``twist`` of its frames [1/m].

        ``has_turned`` unless ``windup`` still holds the angles of ``before``.
        """
        equations = Equations()
        first = tubes.first_tube[item]
        count = tubes.first_tube[item + 1] - first
        n = tubes.pieces[item]
        angles = tubes.first_windup[item]
        piece = line / real(n)
        grain = real(wp.static(GRAIN)) * piece
        s = real(place) * piece
        end = s + piece
        rounds = int(0)
        while end - s > grain and rounds < 1000:
            stop = next_stop(tubes, length, pack, lane, item, carrier, line, s, end, grain)
            part = stop - s
            mid = s + real(0.5) * part
            t = mid / piece - real(place)
            x = vec4()
            y = vec4()
            torsion = vec4()
            own_twist = vec4()
            bending = real(0.0)
            kx = real(0.0)
            ky = real(0.0)
            for k in range(count):
                reach = shown(length, pack, lane, first + k, carrier, line)
                if reach > mid:
                    row = angles + k * (n + 1) + place
                    psi = angle_at(windup, pack, lane, row, t)
                    change = (windup[pack, row + 1, lane] - windup[pack, row, lane]) / piece
                    own = part_at(tubes, materials, pack, lane, first + k, reach, mid, psi, change)
                    x[k] = own.bending * own.x
                    y[k] = own.bending * own.y
                    torsion[k] = own.torsion
                    own_twist[k] = own.twist
                    bending += own.bending
                    kx += x[k]
                    ky += y[k]
            if has_turned and not yields:
                mean = mean_at(tubes, materials, length, before, pack, lane, item, carrier, line, place, mid)
                kx = mean.k[0]
                ky = mean.k[1]
            else:
                kx = kx / bending
                ky = ky / bending
            kx += moment[0] / bending
            ky += moment[1] / bending
            for k in range(count):
                if torsion[k] > real(0.0):  # it comes here
                    pull = torsion[k] * (twist - own_twist[k]) * part / piece
                    push = (kx * y[k] - ky * x[k]) * part
                    hold = torsion[k] * part / (piece * piece)
                    lean = kx * x[k] + ky * y[k]
                    if yields:
                        lean = (moment[0] * x[k] + moment[1] * y[k]) / bending
                    lean = wp.max(lean, real(0.0)) * part
                    equations.f[k] = equations.f[k] + push * (real(1.0) - t) - pull
                    equations.g[k] = equations.g[k] + push * t + pull
                    equations.low[k, k] = equations.low[k, k] + hold + lean * (real(1.0) - t) * (real(1.0) - t)
                    equations.high[k, k] = equations.high[k, k] + hold + lean * t * t
                    equations.between[k, k] = equations.between[k, k] + lean * t * (real(1.0) - t) - hold
            bound = int(0)  # a line in contact keeps its curvature, which no tube's angle turns
            if yields:
                bound = count
            for k in range(bound):
                for j in range(k):
                    weight = wp.max((x[k] * x[j] + y[k] * y[j]) / bending, real(0.0)) * part
                    for end_of in range(2):  # the Laplacian of one edge
                        a = k
                        b = j
                        if end_of == 1:
                            a = j
                            b = k
                        equations.low[a, a] = equations.low[a, a] + weight * (real(1.0) - t) * (real(1.0) - t)
                        equations.high[a, a] = equations.high[a, a] + weight * t * t
                        equations.between[a, a] = equations.between[a, a] + weight * t * (real(1.0) - t)
                        equations.low[a, b] = equations.low[a, b] - weight * (real(1.0) - t) * (real(1.0) - t)
                        equations.high[a, b] = equations.high[a, b] - weight * t * t
                        equations.between[a, b] = equations.between[a, b] - weight * t * (real(1.0) - t)
            s = stop
            rounds += 1
        return equations

    @wp.func
    def torque_at(pose: wp.array3d(dtype=real), wrench: wp.array3d(dtype=real), pack: int, lane: int, frame: int):
        """Commanded moment about the tangent of a node [N m]."""
        q = quat_at(pose, pack, lane, 7 * frame + 3)
        tangent = wp.quat_rotate(q, vec3(real(0.0), real(0.0), real(1.0)))
        return wp.dot(tangent, vector_at(wrench, pack, lane, 6 * frame + 3))

    @wp.func
    def kept_equations(kept: wp.array3d(dtype=real), pack: int, lane: int, segment: int):
        """Equations of a segment, as ``equate`` has left them."""
        equations = Equations()
        row = wp.static(EQUATION_ROWS) * segment
        for k in range(4):
            equations.f[k] = kept[pack, row + k, lane]
            equations.g[k] = kept[pack, row + 4 + k, lane]
        row += 8
        for k in range(4):
            for j in range(k + 1):
                equations.low[k, j] = kept[pack, row, lane]
                equations.low[j, k] = kept[pack, row, lane]
                equations.between[k, j] = kept[pack, row + 1, lane]
                equations.between[j, k] = kept[pack, row + 1, lane]
                equations.high[k, j] = kept[pack, row + 2, lane]
                equations.high[j, k] = kept[pack, row + 2, lane]
                row += 3
        return equations

    @wp.func
    def gives_way(contact_count: wp.array2d(dtype=wp.int32), world: int):
        """Whether a line touches nothing."""
        free = bool(True)
        if world < contact_count.shape[0]:
            free = contact_count[world, 0] == 0
        return free

    @wp.kernel(module=module, enable_backward=False)
    def equate(
        # Model
        tubes: Tubes,
        piece_telescope: wp.array(dtype=wp.int32),
        piece_place: wp.array(dtype=wp.int32),
        lanes: int,
        # State
        contact_count_in: wp.array2d(dtype=wp.int32),
        # Workspace in
        materials: Materials,
        plan_in: wp.array3d(dtype=real),
        length_in: wp.array3d(dtype=real),
        before_in: wp.array3d(dtype=real),
        windup_in: wp.array3d(dtype=real),
        load_in: wp.array3d(dtype=real),
        twist_in: wp.array3d(dtype=real),
        # Workspace out
        equations_out: wp.array3d(dtype=real),
    ):
        """Equations of every segment at the present angles, for ``wind``."""
        pack, segment, lane = wp.tid()
        item = piece_telescope[segment]
        plan = wp.static(PLAN_ROWS) * item
        equations = segment_equations(
            tubes,
            materials,
            length_in,
            before_in,
            windup_in,
            pack,
            lane,
            item,
            int(plan_in[pack, plan + 4, lane]),
            plan_in[pack, plan + 1, lane],
            piece_place[segment],
            vec2(load_in[pack, 2 * segment, lane], load_in[pack, 2 * segment + 1, lane]),
            twist_in[pack, segment, lane],
            gives_way(contact_count_in, pack * lanes + lane),
            True,
        )
        row = wp.static(EQUATION_ROWS) * segment
        for k in range(4):
            equations_out[pack, row + k, lane] = equations.f[k]
            equations_out[pack, row + 4 + k, lane] = equations.g[k]
        row += 8
        for k in range(4):
            for j in range(k + 1):
                equations_out[pack, row, lane] = equations.low[k, j]
                equations_out[pack, row + 1, lane] = equations.between[k, j]
                equations_out[pack, row + 2, lane] = equations.high[k, j]
                row += 3

    @wp.kernel(module=module, enable_backward=False)
    def wind(
        # Model
        tubes: Tubes,
        first_piece: wp.array(dtype=wp.int32),
        base_frame: wp.array(dtype=wp.int32),
        lanes: int,
        # State
        contact_count_in: wp.array2d(dtype=wp.int32),
        # Workspace in
        materials: Materials,
        plan_in: wp.array3d(dtype=real),
        length_in: wp.array3d(dtype=real),
        angle_in: wp.array3d(dtype=real),
        windup_in: wp.array3d(dtype=real),
        load_in: wp.array3d(dtype=real),
        twist_in: wp.array3d(dtype=real),
        equations_in: wp.array3d(dtype=real),
        pose_in: wp.array3d(dtype=real),
        wrench_in: wp.array3d(dtype=real),
        # Workspace out
        system_out: wp.array3d(dtype=real),
        windup_out: wp.array3d(dtype=real),
    ):
        """Angles of all tubes to the frames that balance their torsion against their bending, on one line.

        They minimise the sum over tubes of the integral of G J (twist + psi' - twist*)^2 / 2 - E I k . R(psi) k* by
        Newton's method; tips are free, springs lead to the bases. A line that touches something keeps its curvature k.
        Any other one keeps the moments of loads, and k follows the angles, which makes the second derivative of
        bending the Laplacian of a graph with the weights E I_i E I_j k_i . k_j / sum E I; those below 0 are left out.
        Commanded moments about the line act on the carrier. ``windup`` holds what the first iteration begins with.
        On a GPU a launch is one iteration, of the equations that ``equate`` has found.
        """
        pack, item, lane = wp.tid()
        yields = gives_way(contact_count_in, pack * lanes + lane)
        first = tubes.first_tube[item]
        count = tubes.first_tube[item + 1] - first
        n = tubes.pieces[item]
        angles = tubes.first_windup[item]
        plan = wp.static(PLAN_ROWS) * item
        line = plan_in[pack, plan + 1, lane]
        carrier = int(plan_in[pack, plan + 4, lane])
        piece = line / real(n)
        grain = real(wp.static(GRAIN)) * piece
        systems = wp.static(SYSTEM_ROWS) * (first_piece[item] + item)
        for iteration in range(wp.static(1 if side_by_side else ITERATIONS)):
            diagonal = mat44()
            gradient = vec4()
            for k in range(count):  # springs of what lies behind the port
                reach = shown(length_in, pack, lane, first + k, carrier, line)
                spring = hidden_stiffness(tubes, materials, pack, lane, item, first + k, reach, piece)
                goal = angle_in[pack, first + k, lane] - plan_in[pack, plan + 6, lane]
                gradient[k] = spring * (windup_out[pack, angles + k * (n + 1), lane] - goal)
                diagonal[k, k] = spring
            for place in range(n):
                equations = Equations()
                if wp.static(side_by_side):
                    equations = kept_equations(equations_in, pack, lane, first_piece[item] + place)
                else:
                    row = 2 * (first_piece[item] + place)
                    moment = vec2(load_in[pack, row, lane], load_in[pack, row + 1, lane])
                    twist = twist_in[pack, first_piece[item] + place, lane]
                    equations = segment_equations(
                        tubes,
                        materials,
                        length_in,
                        windup_in,
                        windup_out,
                        pack,
                        lane,
                        item,
                        carrier,
                        line,
                        place,
                        moment,
                        twist,
                        yields,
                        iteration > 0,
                    )
                store = systems + wp.static(SYSTEM_ROWS) * place
                diagonal = diagonal + equations.low
                gradient = gradient + equations.f
                if place > 0:  # the port takes what is given there
                    given = torque_at(pose_in, wrench_in, pack, lane, base_frame[item] + place)
                    gradient[carrier - first] = gradient[carrier - first] - given
                for k in range(4):
                    if diagonal[k, k] <= real(0.0):
                        diagonal[k, k] = real(1.0)  # a tube that does not come here
                inverse = inverted(diagonal)
                rest = inverse * gradient
                ahead = inverse * equations.between
                for k in range(4):
                    system_out[pack, store + k, lane] = rest[k]
                    for j in range(4):
                        system_out[pack, store + 4 + 4 * k + j, lane] = ahead[k, j]
                diagonal = equations.high - wp.transpose(equations.between) * ahead
                gradient = equations.g - wp.transpose(equations.between) * rest
            given = torque_at(pose_in, wrench_in, pack, lane, base_frame[item] + n)
            gradient[carrier - first] = gradient[carrier - first] - given
            for k in range(4):
                if diagonal[k, k] <= real(0.0):
                    diagonal[k, k] = real(1.0)
            step = -(inverted(diagonal) * gradient)
            for back in range(n + 1):
                node = n - back
                if back > 0:
                    store = systems + wp.static(SYSTEM_ROWS) * node
                    before = vec4()
                    for k in range(4):
                        before[k] = -system_out[pack, store + k, lane]
                        for j in range(4):
                            before[k] = before[k] - system_out[pack, store + 4 + 4 * k + j, lane] * step[j]
                    step = before
                limit = real(wp.static(MOST_TWIST))
                for k in range(count):
                    row = angles + k * (n + 1) + node
                    windup_out[pack, row, lane] = windup_out[pack, row, lane] + wp.clamp(step[k], -limit, limit)
        for k in range(count):
            row = angles + k * (n + 1)
            reach = shown(length_in, pack, lane, first + k, carrier, line)
            for node in range(1, n + 1):
                if real(node - 1) * piece >= reach - grain:
                    windup_out[pack, row + node, lane] = windup_out[pack, row + node - 1, lane]

    return SimpleNamespace(equate=equate, wind=wind)
