"""Inverse control of a plate: where its normal points and how high its middle is; its turn about the normal is free."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from softwarp.control.effectors import Effector, OrientationEffector, PointEffector
from softwarp.control.inverse import InverseController, Solution
from softwarp.simulation import Simulation

LENGTH = 0.1  # m that a radian of tilt is worth against the height


class TiltController:
    """Steers the normal of a rigid body and the height of a point, for all worlds at once.

    The target of the orientation is made anew at every call: the body as it is, turned the shortest way until its z
    axis points where it should. What it turns about that axis, which no tilt determines, costs nothing.

    Args:
        sim: Simulation; z is up.
        frame: Index of the body in ``Simulation.frame_pose``; its z axis is the normal.
        marker: Point whose height is steered, on the body.
        length: Metres that a radian of tilt is worth against the height.
        **options: Of ``InverseController``.

    Attributes:
        controller: The inverse control that this one asks.

    Raises:
        ValueError: As ``InverseController`` does.
    """

    def __init__(self, sim: Simulation, frame: int, marker: int, *, length: float = LENGTH, **options: Any) -> None:
        effectors: list[Effector | int] = [
            OrientationEffector(int(frame), length=length, axes="xy"),
            PointEffector((int(marker),), axes="z"),
        ]
        self.controller = InverseController(sim, effectors, **options)
        self.sim, self.frame, self.marker = sim, int(frame), int(marker)
        self._targets = torch.zeros((sim.num_worlds, 2, 4), dtype=torch.float64, device=sim.device)

    def normal(self) -> Tensor:
        """Unit normal of the body, float64 (world, 3)."""
        return normal_of(self.sim.frame_pose[:, self.frame, 3:].double())

    def height(self) -> Tensor:
        """Height of the point [m], float64 (world,)."""
        return self.sim.marker_x[:, self.marker, 2].double()

    def solve(self, targets: Tensor, *, apply: bool = True) -> Solution:
        """Commands that bring the normals to directions and the points to heights.

        Args:
            targets: Normal, of any length but 0, and height [m], (world, 4).
            apply: Write the commands to ``sim.control``.

        Returns:
            As ``InverseController.solve``; the errors are those of the tilt, in ``length`` per radian, and of the
            height [m].

        Raises:
            ValueError: If the targets have another shape.
        """
        given = torch.as_tensor(targets).to(self._targets)
        if given.shape != (self.sim.num_worlds, 4):
            raise ValueError(
                f"tilt control: targets must have shape ({self.sim.num_worlds}, 4), normal and height, got "
                f"{tuple(given.shape)}"
            )
        present = self.sim.frame_pose[:, self.frame, 3:].to(self._targets)
        wished = torch.nn.functional.normalize(given[:, :3], dim=1)
        self._targets[:, 0] = product(shortest_turn(normal_of(present), wished), present)
        self._targets[:, 1, :3] = self.sim.marker_x[:, self.marker].to(self._targets)
        self._targets[:, 1, 2] = given[:, 3]
        return self.controller.solve(self._targets, apply=apply)


def normal_of(quaternion: Tensor) -> Tensor:
    """Where quaternions x y z w turn the z axis to, (..., 3)."""
    x, y, z, w = quaternion.unbind(dim=-1)
    return torch.stack((2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)), dim=-1)


def shortest_turn(start: Tensor, end: Tensor) -> Tensor:
    """Quaternions x y z w that turn unit vectors the shortest way into others, which are not opposite, (..., 4)."""
    real = 1.0 + (start * end).sum(dim=-1, keepdim=True)
    return torch.nn.functional.normalize(torch.cat((torch.linalg.cross(start, end), real), dim=-1), dim=-1)


def product(first: Tensor, second: Tensor) -> Tensor:
    """Quaternion product x y z w: ``second``, then ``first``, (..., 4)."""
    a, b, p, q = first[..., :3], second[..., :3], first[..., 3:], second[..., 3:]
    vector = p * b + q * a + torch.linalg.cross(a, b)
    return torch.cat((vector, p * q - (a * b).sum(dim=-1, keepdim=True)), dim=-1)
