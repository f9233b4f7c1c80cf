"""The robot: a silicone bar that is clamped at one end, with a cable along its top and one along its bottom."""

from dataclasses import dataclass

import softwarp as sw
from softwarp.envs.options import Length, Modulus

LENGTH, WIDTH = 0.12, 0.02  # m


@dataclass(kw_only=True)
class MyRobotSceneConfig:
    """Measures of the robot; each is a setting ``env.<name>=`` of the command line."""

    youngs: Modulus = 200.0e3  # Pa, of the silicone
    pull: Length = 0.015  # m, by which an action of 1 shortens a cable


def build_my_robot(config: MyRobotSceneConfig, builder: sw.ModelBuilder) -> int:
    """Add the robot to a scene; returns the marker at its free end."""
    mesh = sw.meshing.box((LENGTH, WIDTH, WIDTH), (12, 2, 2))  # or sw.read_mesh("robot.msh")
    material = sw.Corotational(config.youngs, 0.45, method="warped")
    bar = builder.add_tets(mesh, material=material, density=1100.0, rayleigh=(0.1, 0.01))
    builder.fix(bar, box=((0.0, 0.0, 0.0), (0.0, WIDTH, WIDTH)))
    for z in (0.8 * WIDTH, 0.2 * WIDTH):
        points = [(x * LENGTH / 12, 0.5 * WIDTH, z) for x in range(13)]
        builder.add_cable(bar, points, control="length", max_displacement=config.pull)
    return builder.add_marker(bar, (LENGTH, 0.5 * WIDTH, 0.5 * WIDTH))
