"""All laws of solids as kernels see them: functions of ``materials``, stress and parameters."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from softwarp.kernels.elements import lane_laws, ogden
from softwarp.kernels.elements import materials as m


@dataclass(frozen=True)
class Law:
    """One law as kernels see it; its stress is given by ``invariants`` or by ``slopes``.

    Attributes:
        name: Of the element kernels, and ``law`` of the material.
        energy: Warp function ``energy(F, p)``.
        principal: Warp function ``principal(s, p)``.
        own: Number of parameters of its own; 0 for a law in the Lame constants.
        invariants: Warp function ``invariants(I1, I2, J, p)``: a, b, c of P = a F + b cof F + c F F'F.
        derivatives: Warp function ``derivatives(I1, I2, J, p)``: first and second ones of a law with ``invariants``.
        slopes: Warp function ``slopes(s, p)``: psi_i of P = U diag(psi_i) V'.
        is_cubic: Whether c is not zero.
        lanes: What has ``principal``, and ``slopes`` or ``invariants``, of eight elements at a time; without it they
            take turns.
        is_upright: Whether it has no stress where J is not positive; lanes then find its stretches in less time.
        awake: Warp function ``awake(p)`` of a law that leaves terms out: ``p`` with which these are there, too small to
            be seen, so that they have gradients.
    """

    name: str
    energy: Any
    principal: Any
    own: int = 0
    invariants: Any = None
    derivatives: Any = None
    slopes: Any = None
    is_cubic: bool = False
    lanes: Any = None
    is_upright: bool = False
    awake: Any = None

    @property
    def count(self) -> int:
        """Entries of ``p``."""
        return self.own or 2

    @property
    def stress(self) -> Any:
        """Warp function ``stress(F, p)``."""
        return _stress(self.name)


LAWS = {
    law.name: law
    for law in (
        Law(
            "corotational",
            m.corotational_energy,
            m.corotational_principal,
            slopes=m.corotational_slopes,
            lanes=lane_laws.corotational,
        ),
        Law(
            "st_venant_kirchhoff",
            m.stvk_energy,
            m.stvk_principal,
            invariants=m.stvk_invariants,
            derivatives=m.stvk_derivatives,
            is_cubic=True,
        ),
        Law(
            "neo_hookean",
            m.neo_hookean_energy,
            m.neo_hookean_principal,
            invariants=m.neo_hookean_invariants,
            derivatives=m.neo_hookean_derivatives,
            lanes=lane_laws.neo_hookean,
            is_upright=True,
        ),
        Law(
            "stable_neo_hookean",
            m.stable_neo_hookean_energy,
            m.stable_neo_hookean_principal,
            invariants=m.stable_neo_hookean_invariants,
            derivatives=m.stable_neo_hookean_derivatives,
        ),
        Law(
            "yeoh",
            m.yeoh_energy,
            m.yeoh_principal,
            own=4,
            invariants=m.yeoh_invariants,
            derivatives=m.yeoh_derivatives,
            lanes=lane_laws.yeoh,
            is_upright=True,
        ),
        Law(
            "mooney_rivlin",
            m.mooney_rivlin_energy,
            m.mooney_rivlin_principal,
            own=3,
            invariants=m.mooney_rivlin_invariants,
            derivatives=m.mooney_rivlin_derivatives,
            lanes=lane_laws.mooney_rivlin,
            is_upright=True,
            is_cubic=True,
        ),
        Law(
            "ogden",
            m.ogden_energy,
            m.ogden_principal,
            own=7,
            slopes=m.ogden_slopes,
            lanes=ogden,
            is_upright=True,
            awake=m.ogden_awake,
        ),
    )
}


@cache
def _stress(law: str) -> Any:
    invariants, slopes = LAWS[law].invariants, LAWS[law].slopes

    @wp.func
    def by_invariants(F: Any, p: Any):
        G = m.cofactor(F)
        a, b, c = invariants(wp.ddot(F, F), wp.ddot(G, G), wp.determinant(F), p)
        return a * F + b * G + c * (F * (wp.transpose(F) * F))

    @wp.func
    def by_slopes(F: Any, p: Any):
        U, s, V = wp.svd3(F)
        return U * wp.diag(slopes(s, p)) * wp.transpose(V)

    return by_invariants if slopes is None else by_slopes


def law_parameters(real: Any, law: str) -> Any:
    """Warp function that gathers the vector ``p`` of a body's law from arrays of shape (pack, row, lane).

    A law in Lame constants finds them at the body's row, one with parameters of its own from row ``start`` onwards.
    """
    count = LAWS[law].count
    vector = wp.types.vector(count, real)

    @wp.func
    def lame(
        start: wp.array(dtype=wp.int32),
        mu: wp.array3d(dtype=real),
        lam: wp.array3d(dtype=real),
        own: wp.array3d(dtype=real),
        pack: int,
        body: int,
        lane: int,
    ):
        return vector(mu[pack, body, lane], lam[pack, body, lane])

    @wp.func
    def declared(
        start: wp.array(dtype=wp.int32),
        mu: wp.array3d(dtype=real),
        lam: wp.array3d(dtype=real),
        own: wp.array3d(dtype=real),
        pack: int,
        body: int,
        lane: int,
    ):
        p = vector()
        for i in range(count):
            p[i] = own[pack, start[body] + i, lane]
        return p

    return declared if LAWS[law].own else lame


_OWN_ROWS = """
wp::mat_t<COUNT, LANES, wp::float32> p;
for (int k = 0; k < COUNT; ++k) __builtin_memcpy(p.data[k], &wp::index(own, pack, first + k, 0), sizeof(p.data[k]));
return p;
"""
_LAME_ROWS = """
wp::mat_t<2, LANES, wp::float32> p;
__builtin_memcpy(p.data[0], &wp::index(mu, pack, body, 0), sizeof(p.data[0]));
__builtin_memcpy(p.data[1], &wp::index(lam, pack, body, 0), sizeof(p.data[1]));
return p;
"""


def lane_parameters(at: Any, real: Any, law: str, is_packed: bool) -> Any:
    """Warp function that gathers the parameters of the elements of an item, by lane, with the ``access`` to them.

    Where a pack of worlds is in the lanes, ``is_packed``, these are of one element, and lie side by side.
    """
    count, lanes = LAWS[law].count, at.inner.lanes
    member, place_of, parameters = at.member, at.place_of, law_parameters(real, law)
    table, has_own = wp.types.matrix((count, lanes), real), bool(LAWS[law].own)

    @wp.func
    def gather(
        w: int,
        item: int,
        tet_index: wp.array(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        start: wp.array(dtype=wp.int32),
        mu: wp.array3d(dtype=real),
        lam: wp.array3d(dtype=real),
        own: wp.array3d(dtype=real),
    ):
        found = table()
        for lane in range(int(lanes)):
            pack, place = place_of(w, lane)
            p = parameters(start, mu, lam, own, pack, tet_body[member(tet_index, item, lane)], place)
            for k in range(wp.static(count)):
                found[k, lane] = p[k]
        return found

    @wp.func_native(_OWN_ROWS.replace("COUNT", str(count)).replace("LANES", str(lanes)))
    def own_rows(own: wp.array3d(dtype=real), pack: int, first: int) -> table: ...

    @wp.func_native(_LAME_ROWS.replace("LANES", str(lanes)))
    def lame_rows(mu: wp.array3d(dtype=real), lam: wp.array3d(dtype=real), pack: int, body: int) -> table: ...

    @wp.func
    def gather_packed(
        w: int,
        item: int,
        tet_index: wp.array(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        start: wp.array(dtype=wp.int32),
        mu: wp.array3d(dtype=real),
        lam: wp.array3d(dtype=real),
        own: wp.array3d(dtype=real),
    ):
        body = tet_body[member(tet_index, item, 0)]
        if wp.static(has_own):
            p = own_rows(own, w, start[body])
        else:
            p = lame_rows(mu, lam, w, body)
        return p

    return gather_packed if is_packed else gather
