"""Part of ``ModelBuilder``: tubes, catheters and wires one in the other."""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import ArrayLike

from softwarp.model.handles import Telescope
from softwarp.scene import telescopes
from softwarp.scene.parts import Scene
from softwarp.scene.telescopes import Tube


class Telescopes:
    """Part of ``ModelBuilder``; see there."""

    scene: Scene

    def add_telescope(
        self,
        tubes: Sequence[Tube],
        *,
        port: ArrayLike = (0.0, 0.0, 0.0),
        segments: int = 40,
        lengths: ArrayLike | None = None,
        angles: ArrayLike = 0.0,
        windup: bool = True,
        rayleigh: tuple[float, float] = (0.0, 0.0),
        contact_radius: float | None = None,
        name: str | None = None,
    ) -> Telescope:
        """Add tubes that share a centre line where they overlap, each inserted and turned at its base.

        Bending and torsion stiffnesses of overlapping tubes add, their stress-free curvatures compose at the angles
        that the tubes have to each other, and these follow from the balance of torsion, so that strongly curved tubes
        snap. ``control.tube_length`` and ``control.tube_angle`` say how far each tube should be out of the port [m] and
        how far turned [rad]; in one step a tube moves by no more than a 200th of its length and turns by no more than
        0.1 rad. There is no clearance and no friction between tubes. Theory: docs/theory/telescope.md.

        Args:
            tubes: Tubes, catheters, wires; the innermost first.
            port: Where tubes come out, along its z axis: position [m], (3,), or with quaternion x y z w, (7,), or a
                4x4 matrix.
            segments: Segments between the port and the tip of the tube that reaches farthest.
            lengths: Deployed lengths at the start [m], shape (tube,); None for none.
            angles: Angles of the tubes at the start [rad], a number or shape (tube,).
            windup: Whether the part of a tube behind the port, which is straight, twists as well.
            rayleigh: Damping factors (mass [1/s], stiffness [s]).
            contact_radius: Radius of the line in contacts [m]; None takes that of the outermost tube.
            name: For messages and exports.

        Returns:
            Handle of a rod, whose nodes in ``rod_x`` ``Model.rod_nodes`` gives, the last one the tip, and
            ``Model.tubes_of`` its tubes in ``tube_length`` and ``tube_angle``.

        Raises:
            ValueError: For tubes that do not fit into each other and numbers outside their range; from ``finalize``,
                where cables or joints hold it, or parts other than at its last node.
        """
        return telescopes.add_telescope(
            self.scene,
            tubes,
            port=port,
            segments=segments,
            lengths=lengths,
            angles=angles,
            windup=windup,
            rayleigh=rayleigh,
            contact_radius=contact_radius,
            name=name,
        )
