"""Write the inner surface of a generated aorta to a file: python assets/aorta/generate.py aorta.stl."""

import argparse
from pathlib import Path

import meshio

from softwarp import meshing, shapes


def main() -> None:
    """Read the command line, generate, write."""
    parser = argparse.ArgumentParser(description="Write the inner surface of a generated aorta to a file, in metres.")
    parser.add_argument("output", nargs="?", type=Path, default=Path("aorta.stl"), help="file to write")
    parser.add_argument("--outlets", type=int, help="how many; left out: the seven of the reference")
    parser.add_argument("--seed", type=int, help="of a random anatomy; left out: the reference's outlets")
    parser.add_argument("--radius", type=float, default=0.0066, help="of the lumen [m]")
    parser.add_argument("--spacing", type=float, default=0.0015, help="of the grid that the surface is taken from [m]")
    arguments = parser.parse_args()

    try:
        tree = meshing.aorta(arguments.outlets, radius=arguments.radius, seed=arguments.seed)
        vessel = shapes.Vessel.from_tubes(tree.tubes(), arguments.spacing, name="aorta")
    except ValueError as error:
        parser.error(str(error))
    vertices, triangles = vessel.surface()
    meshio.Mesh(vertices, [("triangle", triangles)]).write(arguments.output)
    ways = ", ".join(f"{1e3 * way:.0f}" for way in tree.length[tree.outlets])
    print(f"{arguments.output}: {len(vertices)} vertices, {len(triangles)} triangles")
    print(
        f"ways from the inlet to the outlets [mm]: {ways}; least wall between branches {1e3 * tree.clearance():.1f} mm"
    )


if __name__ == "__main__":
    main()
