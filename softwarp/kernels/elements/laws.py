"""All laws of solids as kernels see them: functions of ``materials``, stress and parameters."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

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
    """

    name: str
    energy: Any
    principal: Any
    own: int = 0
    invariants: Any = None
    derivatives: Any = None
    slopes: Any = None
    is_cubic: bool = False

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
        Law("corotational", m.corotational_energy, m.corotational_principal, slopes=m.corotational_slopes),
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
        ),
        Law(
            "mooney_rivlin",
            m.mooney_rivlin_energy,
            m.mooney_rivlin_principal,
            own=3,
            invariants=m.mooney_rivlin_invariants,
            derivatives=m.mooney_rivlin_derivatives,
            is_cubic=True,
        ),
        Law("ogden", m.ogden_energy, m.ogden_principal, own=7, slopes=m.ogden_slopes),
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
