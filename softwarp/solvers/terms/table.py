"""The terms of a scene, in the order that a step walks them."""

from __future__ import annotations

from softwarp.solvers.terms.attachments import AttachmentTerm
from softwarp.solvers.terms.cables import CableTerm
from softwarp.solvers.terms.cavities import CavityTerm
from softwarp.solvers.terms.contact import ContactTerm
from softwarp.solvers.terms.frames import FrameTerm
from softwarp.solvers.terms.hexes import HexTerm
from softwarp.solvers.terms.inversion import InversionTerm
from softwarp.solvers.terms.joints import JointTerm
from softwarp.solvers.terms.membranes import MembraneTerm
from softwarp.solvers.terms.quadratic import QuadraticTerm
from softwarp.solvers.terms.reduction import ReductionTerm
from softwarp.solvers.terms.relaxation import RelaxationTerm
from softwarp.solvers.terms.rods import RodTerm
from softwarp.solvers.terms.telescopes import TelescopeTerm
from softwarp.solvers.terms.term import Term
from softwarp.solvers.terms.tets import TetTerm
from softwarp.solvers.terms.tractions import TractionTerm
from softwarp.solvers.workspace.shard import Shard


def terms_of(shard: Shard) -> tuple[Term, ...]:
    """Terms that the model of a shard needs: elements, then frames, then rows.

    The order is that of the sums in A and b. Elements come before the modes and frames that carry them, frames before
    the joints between them, and rows as they are numbered: cables, chambers, joints.
    """
    m = shard.model
    terms: list[Term] = []
    if m.tet_count:
        terms.append(TetTerm(shard))
    if m.membranes is not None:
        terms.append(MembraneTerm(shard, m.membranes))
    if m.quadratic is not None:
        terms.append(QuadraticTerm(shard, m.quadratic))
    if m.hexes is not None:
        terms.append(HexTerm(shard, m.hexes))
    if m.tractions is not None:
        terms.append(TractionTerm(shard, m.tractions))
    if m.tet_count or m.quadratic is not None or m.hexes is not None:
        terms.append(InversionTerm(shard))
    if m.reduction is not None:
        terms.append(ReductionTerm(shard, m.reduction))
    if m.frames is not None:
        if m.segment_count:
            terms.append(RodTerm(shard, m.frames))
        if m.telescopes is not None:
            terms.append(TelescopeTerm(shard, m.telescopes, m.frames))
        terms += [AttachmentTerm(shard, m.frames), FrameTerm(shard, m.frames)]
    if m.cable_count:
        terms.append(CableTerm(shard))
    if m.cavities is not None:
        terms.append(CavityTerm(shard, m.cavities))
    if m.relaxes:
        terms.append(RelaxationTerm(shard))
    if m.joints is not None and m.frames is not None:
        terms.append(JointTerm(shard, m.joints, m.frames))
    if m.contact is not None:
        terms.append(ContactTerm(shard, m.contact))
    return tuple(terms)
