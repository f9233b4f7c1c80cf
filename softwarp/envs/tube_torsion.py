"""The line that tubes take together without loads, twisted by each other: many lengths and angles at once.

At a place s the tubes have angles psi_i to a frame that does not turn about the line. Where they overlap they bend
together, by k = sum(K_i R(psi_i) k_i) / K with K = sum(K_i), and twist each other:

    (T_i psi_i')' = -d/dpsi_i |sum(K_j R(psi_j) k_j)|^2 / (2 K),    T_i psi_i' = 0 at the tip of tube i.

From angles at the tips this is integrated to the port in one pass, so that a goal is sought in lengths and angles at
tips: angles at bases follow. What lies behind the port is straight. Reference: Rucker, Jones, Webster (2010), A
geometrically exact model for externally loaded concentric-tube continuum robots; theory: docs/theory/telescope.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from softwarp.envs.tube_line import TubeLine, chained

PARTS = 2  # steps of the leapfrog scheme between two places where a tube or its straight part ends
ROUNDS = 8  # of Newton's method, for angles at tips
MOST = 0.5  # rad, change of an angle in one of these
SHIFT = 1.0e-3  # rad, for differences
DAMPING = 1.0e-6  # of normal equations, which lose rank where tubes are about to snap


@dataclass(frozen=True, eq=False)
class TwistedLine:
    """Tubes with straight bodies and curved ends that twist each other; all tensors (tube,).

    Attributes:
        line: The same tubes, as if they were rigid in torsion.
        ratio: Torsion stiffness per bending stiffness, G J / E I, of all sections.
        whole: Length of each tube [m], of what twists behind the port; None where that part is rigid.
    """

    line: TubeLine
    ratio: float
    whole: Tensor | None = None

    def from_tips(self, lengths: Tensor, tips: Tensor) -> tuple[Tensor, Tensor]:
        """Where lines lead whose tubes have these angles at their tips.

        Args:
            lengths: Deployed lengths [m], (k, tube).
            tips: Angles at the tips to a frame that does not turn about the line [rad], (k, tube).

        Returns:
            Angles at the bases [rad], (k, tube), and positions of the innermost tips [m], (k, 3).
        """
        line = self.line
        begins = lengths - line.curved
        stops = torch.cat((torch.zeros_like(lengths[:, :1]), begins.clamp_min(0.0), lengths), dim=1).sort(dim=1).values
        step = (stops.diff(dim=1) / PARTS).repeat_interleave(PARTS, dim=1)
        middle = step.cumsum(dim=1) - 0.5 * step
        place = middle[..., None]
        is_here, is_curved = place < lengths[:, None], place > begins[:, None]
        stiff = torch.where(is_curved, line.curved_stiffness, line.stiffness) * is_here
        bend = torch.where(is_curved, stiff * line.curvature, torch.zeros_like(stiff))
        total = stiff.sum(dim=-1)
        soft = torch.where(is_here, 1.0 / (self.ratio * stiff).clamp_min(1.0e-12), torch.zeros_like(stiff))
        psi, torque, along = tips, torch.zeros_like(tips), []
        for j in range(step.shape[1] - 1, -1, -1):
            half = 0.5 * step[:, j, None] * soft[:, j]
            psi = psi - half * torque
            x, y = bend[:, j] * psi.cos(), bend[:, j] * psi.sin()
            k = torch.stack((x.sum(dim=1), y.sum(dim=1)), dim=1) / total[:, j, None].clamp_min(1.0e-12)
            torque = torque + step[:, j, None] * (k[:, 1:] * x - k[:, :1] * y)
            psi = psi - half * torque
            along.append(-k)
        if self.whole is not None:
            psi = psi - torque * self._hidden(lengths)
        turn = step[..., None] * torch.stack(along[::-1], dim=1)
        points = chained(turn, step)
        last = ((middle + 0.5 * step) - lengths[:, :1]).abs().argmin(dim=1) + 1
        return psi, points[torch.arange(len(points), device=points.device), last]

    def tips(self, lengths: Tensor, angles: Tensor, guess: Tensor | None = None) -> Tensor:
        """Angles at the tips [rad] of lines with these angles at their bases, (k, tube), by Newton's method.

        Of several equilibria, as strongly curved tubes have, this is the one that ``guess`` leads to, or ``angles``.
        """
        tips, eye = angles if guess is None else guess, torch.eye(3).to(angles)
        for _ in range(ROUNDS):
            jacobian, bases = self.transmission(lengths, tips)
            square = jacobian.transpose(1, 2) @ jacobian + DAMPING * eye
            missing = jacobian.transpose(1, 2) @ (angles - bases)[..., None]
            tips = tips + torch.linalg.solve(square, missing)[..., 0].clamp(-MOST, MOST)
        return tips

    def transmission(self, lengths: Tensor, tips: Tensor) -> tuple[Tensor, Tensor]:
        """How angles at bases change with those at tips, (k, tube, tube), and what they are [rad], (k, tube).

        Tubes snap where it has no inverse: the smaller its least singular value, the more do tips turn with bases.
        """
        shifts = SHIFT * torch.cat((torch.zeros(1, 3), torch.eye(3))).to(tips)
        shifted = (tips[:, None] + shifts).flatten(0, 1)
        bases = self.from_tips(lengths.repeat_interleave(4, dim=0), shifted)[0].unflatten(0, (-1, 4))
        return (bases[:, 1:] - bases[:, :1]).transpose(1, 2) / SHIFT, bases[:, 0]

    def _hidden(self, lengths: Tensor) -> Tensor:
        """Angle by which what lies behind the port twists, per torque [rad/(N m)]."""
        assert self.whole is not None
        line, behind = self.line, (self.whole - lengths).clamp_min(0.0)
        straight = torch.minimum(behind, self.whole - line.curved)
        return (straight / line.stiffness + (behind - straight) / line.curved_stiffness) / self.ratio

    def to(self, device: torch.device, dtype: torch.dtype) -> TwistedLine:
        """The same on a device."""
        whole = None if self.whole is None else self.whole.to(device=device, dtype=dtype)
        return TwistedLine(self.line.to(device, dtype), self.ratio, whole)
