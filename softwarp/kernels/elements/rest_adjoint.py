"""Gradients of tetrahedra in a step by their rest shape. Theory: docs/theory/adjoint.md.

A change D of the rest shape, dX = D X, changes the gradients of shape functions by -D'g, so that all that is found
with them, F = sum x_b g_b', X = sum p_b g_b' and Y = sum v_b g_b', changes by -F D, -X D and -Y D, and the volume by
V tr D. Of what a tet adds to the loss, -V S with S = h P : X + k C[Y] : X, that leaves the gradient by D

    V (F' dS/dF + X' (h P + k C[Y]) + Y' k C[X]) - V S 1 + V m 1,

m from the masses of its corners, and times g_b it is that by the rest position of corner b. V dS/dF is what the
gradient by positions has been made of: with the rest edges E_b it is -sum (gradient by x_b) E_b'. The frame of
``large`` elements at rest turns too, with two of the edges.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.elements import adjoint
from softwarp.kernels.elements.laws import LAWS, law_parameters
from softwarp.model.codes import FAR, TURNED

LAME = "corotational"  # whose parameters are the Lame constants, as those of turned laws are


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """What all laws share."""
    f = adjoint.functions(variant)
    real, vec3, mat33, gradient_at = variant.real, f.vec3, f.mat33, f.gradient_at
    vector_at = single.functions(variant).vector_at

    @wp.func
    def rest_edges(values: wp.array2d(dtype=real), tet: int):
        """Edges from corner 0 at rest, in rows, from the gradients that are dual to them."""
        b = gradient_at(values, tet, 0)
        c = gradient_at(values, tet, 1)
        d = gradient_at(values, tet, 2)
        volume = wp.dot(b, wp.cross(c, d))
        return wp.matrix_from_rows(wp.cross(c, d) / volume, wp.cross(d, b) / volume, wp.cross(b, c) / volume)

    @wp.func
    def by_positions(corner: wp.array3d(dtype=real), pack: int, lane: int, tet: int, E: mat33):
        """sum (gradient by x_b) E_b'."""
        total = wp.outer(vector_at(corner, pack, lane, 12 * tet + 3), E[0])
        total += wp.outer(vector_at(corner, pack, lane, 12 * tet + 6), E[1])
        return total + wp.outer(vector_at(corner, pack, lane, 12 * tet + 9), E[2])

    @wp.func
    def of_mass(
        tet_node: wp.array2d(dtype=wp.int32),
        gravity: wp.array3d(dtype=real),
        v0: wp.array3d(dtype=real),
        v: wp.array3d(dtype=real),
        p: wp.array3d(dtype=real),
        more: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        tet: int,
        density: real,
        scale: real,
        h: real,
    ):
        """Gradient by the volume of one tet, a quarter of which each of its corners carries; ``more`` is of nodes."""
        g = vector_at(gravity, pack, lane, 0)
        total = real(0.0)
        for corner in range(4):
            row = 3 * tet_node[tet, corner]
            change = h * g + vector_at(v0, pack, lane, row) - scale * vector_at(v, pack, lane, row)
            total += wp.dot(vector_at(p, pack, lane, row), change) + more[pack, tet_node[tet, corner], lane]
        return real(0.25) * density * total

    @wp.func
    def by_changes(X: mat33, Y: mat33, by_X: mat33, by_Y: mat33, mass: real):
        """X' dS/dX + Y' dS/dY - S 1 + m 1."""
        return wp.transpose(X) * by_X + wp.transpose(Y) * by_Y + wp.diag(vec3(mass - wp.ddot(by_X, X)))

    return SimpleNamespace(
        real=real,
        vec3=vec3,
        mat33=mat33,
        vector_at=vector_at,
        rest_edges=rest_edges,
        by_positions=by_positions,
        by_changes=by_changes,
        of_mass=of_mass,
        edge=f.edge,
        gradient_at=gradient_at,
        gradient_of=f.gradient_of,
        put_corners=f.put_corners,
    )


@cache
def stiffness(variant: Variant, law: str, project: bool) -> SimpleNamespace:
    """``tangent(F, p, Y)``: C[Y] of one law of ``laws.LAWS``, by principal axes, perhaps its positive part."""
    f = adjoint.functions(variant)
    real, vec3, mat33, decomposed, eigen = variant.real, f.vec3, f.mat33, f.decomposed, f.eigen
    principal_of = LAWS[law].principal
    vector = wp.types.vector(LAWS[law].count, real)

    least = 0.0 if project else -FAR

    @wp.func
    def tangent(F: mat33, p: vector, Y: mat33):
        U, s, V = decomposed(F)
        H, minus, plus = principal_of(s, p)
        y = wp.transpose(U) * Y * V
        stretch, axes = eigen(H)
        along = vec3(y[0, 0], y[1, 1], y[2, 2])
        total = wp.max(stretch[0], real(least)) * wp.dot(axes[0], along) * axes[0]
        total += wp.max(stretch[1], real(least)) * wp.dot(axes[1], along) * axes[1]
        total += wp.max(stretch[2], real(least)) * wp.dot(axes[2], along) * axes[2]
        out = wp.diag(total)
        for n in range(3):
            even = wp.max(minus[n], real(least)) * (y[(n + 1) % 3, (n + 2) % 3] + y[(n + 2) % 3, (n + 1) % 3])
            odd = wp.max(plus[n], real(least)) * (y[(n + 1) % 3, (n + 2) % 3] - y[(n + 2) % 3, (n + 1) % 3])
            out[(n + 1) % 3, (n + 2) % 3] = real(0.5) * (even + odd)
            out[(n + 2) % 3, (n + 1) % 3] = real(0.5) * (even - odd)
        return U * out * wp.transpose(V)

    return SimpleNamespace(tangent=tangent)


@single_worlds
def kernels(variant: Variant, law: str, project: bool) -> SimpleNamespace:
    """Kernel ``tet_rest`` of one law.

    Args:
        variant: Scalar type and memory order; works on single worlds.
        law: Of ``laws.LAWS``, or ``large`` or ``warped``.
        project: Whether the step has clamped tangents to positive semidefinite ones.
    """
    f = functions(variant)
    real, gradient_at, gradient_of, edge = f.real, f.gradient_at, f.gradient_of, f.edge
    rest_edges, by_positions, of_mass, put_corners = f.rest_edges, f.by_positions, f.of_mass, f.put_corners
    if law in TURNED:
        pull, clamped = _turned(variant, law == "large").pull, ""
    else:
        pull, clamped = _by_law(variant, law, project).pull, ".spd" if project else ".exact"
    parameters = law_parameters(real, LAME if law in TURNED else law)

    @wp.kernel(module=variant.module(f"adjoint.rest.{law}{clamped}"), enable_backward=False)
    def tet_rest(
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
        body_law_start: wp.array(dtype=wp.int32),
        # Workspace in
        body_mu_in: wp.array3d(dtype=real),
        body_lam_in: wp.array3d(dtype=real),
        law_parameter_in: wp.array3d(dtype=real),
        body_stiffness_in: wp.array3d(dtype=real),
        body_mass_in: wp.array3d(dtype=real),
        density_in: wp.array3d(dtype=real),
        gravity_in: wp.array3d(dtype=real),
        node_x_in: wp.array3d(dtype=real),
        node_v0_in: wp.array3d(dtype=real),
        node_v_in: wp.array3d(dtype=real),
        felt_v_in: wp.array3d(dtype=real),
        node_p_in: wp.array3d(dtype=real),
        by_volume_in: wp.array3d(dtype=real),
        corner_in: wp.array3d(dtype=real),
        h: real,
        # Workspace out
        rest_out: wp.array3d(dtype=real),
    ):
        """Gradient by the rest positions of the corners of one tet."""
        pack, item, lane = wp.tid()
        tet = tet_index[item]
        body = tet_body[tet]
        p = parameters(body_law_start, body_mu_in, body_lam_in, law_parameter_in, pack, body, lane)
        F = gradient_of(node_x_in, pack, lane, tet_node, tet_gradient, tet)
        X = gradient_of(node_p_in, pack, lane, tet_node, tet_gradient, tet)
        Y = gradient_of(felt_v_in, pack, lane, tet_node, tet_gradient, tet)
        e = edge(node_x_in, pack, lane, tet_node, tet, 1)
        g = edge(node_x_in, pack, lane, tet_node, tet, 2)
        E = rest_edges(tet_gradient, tet)
        B = by_positions(corner_in, pack, lane, tet, E)
        k = body_stiffness_in[pack, body, lane]
        density = density_in[pack, body, lane]
        scale = body_mass_in[pack, body, lane]
        mass = of_mass(
            tet_node, gravity_in, node_v0_in, node_v_in, node_p_in, by_volume_in, pack, lane, tet, density, scale, h
        )
        mass *= wp.dot(E[0], wp.cross(E[1], E[2])) / (real(6.0) * tet_volume[tet])  # which factors of moduli are not in
        D, b, c = pull(F, p, X, Y, e, g, E, B, mass, tet_volume[tet], h, k)
        b += D * gradient_at(tet_gradient, tet, 0)
        c += D * gradient_at(tet_gradient, tet, 1)
        put_corners(rest_out, pack, lane, tet, b, c, D * gradient_at(tet_gradient, tet, 2))

    return SimpleNamespace(tet_rest=tet_rest)


# Functions ``pull(F, p, X, Y, e, g, E, B, mass, volume, h, k)`` of the laws: the gradient by D, and those by the edges
# from corner 0 to corners 1 and 2 at rest that do not come with it. e and g are these edges now, E all three at rest,
# in rows; B is ``by_positions``, ``mass`` m of the formula above.


def _by_law(variant: Variant, law: str, project: bool) -> SimpleNamespace:
    """A law of ``laws.LAWS``."""
    f = functions(variant)
    real, vec3, mat33, by_changes = f.real, f.vec3, f.mat33, f.by_changes
    tangent, stress = stiffness(variant, law, project).tangent, LAWS[law].stress
    vector = wp.types.vector(LAWS[law].count, real)

    @wp.func
    def pull(
        F: mat33,
        p: vector,
        X: mat33,
        Y: mat33,
        e: vec3,
        g: vec3,
        E: mat33,
        B: mat33,
        mass: real,
        volume: real,
        h: real,
        k: real,
    ):
        by_X = h * stress(F, p) + k * tangent(F, p, Y)
        by_Y = k * tangent(F, p, X)
        D = volume * by_changes(X, Y, by_X, by_Y, mass) - wp.transpose(F) * B
        return D, vec3(), vec3()

    return SimpleNamespace(pull=pull)


def _turned(variant: Variant, is_large: bool) -> SimpleNamespace:
    """``large`` or ``warped`` elements above their guard; the frame of ``large`` ones turns with two edges at rest."""
    f, turned = functions(variant), adjoint.polar(variant)
    real, vec3, mat33, by_changes = f.real, f.vec3, f.mat33, f.by_changes
    axial, decomposed = turned.axial, adjoint.functions(variant).decomposed
    vector = wp.types.vector(LAWS[LAME].count, real)

    @wp.func
    def frame(e: vec3, g: vec3):
        """Frame of two edges, in columns."""
        e1 = wp.normalize(e)
        e3 = wp.normalize(wp.cross(e1, g))
        return wp.matrix_from_cols(e1, wp.cross(e3, e1), e3)

    @wp.func
    def by_edges(t: vec3, e: vec3, g: vec3):
        """Gradients by two edges whose frame turns by w, from that by w."""
        length = wp.length(e)
        e1 = e / length
        e3 = wp.normalize(wp.cross(e1, g))
        e2 = wp.cross(e3, e1)
        second = e3 * (wp.dot(e1, t) / wp.dot(g, e2))
        first = (e2 * wp.dot(e3, t) - e3 * wp.dot(e2, t)) / length - second * (wp.dot(g, e1) / length)
        return first, second

    @wp.func
    def stressed(m: mat33, mu: real, lam: real):
        """s(sym m)."""
        return mu * (m + wp.transpose(m)) + lam * wp.trace(m) * wp.identity(n=3, dtype=real)

    @wp.func
    def pull(
        F: mat33,
        p: vector,
        X: mat33,
        Y: mat33,
        e: vec3,
        g: vec3,
        E: mat33,
        B: mat33,
        mass: real,
        volume: real,
        h: real,
        k: real,
    ):
        R = mat33()
        if wp.static(is_large):
            R = frame(e, g) * wp.transpose(frame(E[0], E[1]))
        else:
            U, s, V = decomposed(F)
            R = U * wp.transpose(V)
        M = wp.transpose(R) * F
        Xr = wp.transpose(R) * X
        Yr = wp.transpose(R) * Y
        strained = stressed(M - wp.identity(n=3, dtype=real), p[0], p[1])
        sX = stressed(Xr, p[0], p[1])
        sY = stressed(Yr, p[0], p[1])
        D = by_changes(X, Y, R * (h * strained + k * sY), k * (R * sX), mass)
        b = vec3()
        c = vec3()
        if wp.static(is_large):
            D = volume * (D + h * (wp.transpose(M) * sX))
            turn = h * (M * sX + Xr * strained) + k * (Xr * sY + Yr * sX)
            b, c = by_edges(volume * axial(turn), E[0], E[1])
        else:
            D = volume * D - wp.transpose(F) * B
        return D, b, c

    return SimpleNamespace(pull=pull)
