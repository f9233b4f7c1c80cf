"""Write a nasal passage to a file: python assets/nasal/generate.py passage.stl --seed 3."""

import argparse
from pathlib import Path

import meshio

from softwarp import meshing


def main() -> None:
    """Read the command line, generate, write."""
    parser = argparse.ArgumentParser(description="Write the wall of a nasal passage to a file, in metres.")
    parser.add_argument("output", nargs="?", type=Path, default=Path("passage.stl"), help="file of the surface")
    parser.add_argument("--seed", type=int, help="of a random anatomy; without it, the standard one")
    parser.add_argument("--scale", type=float, default=1.0, help="size relative to the standard one")
    parser.add_argument("--variation", type=float, default=1.0, help="how much random anatomies differ")
    parser.add_argument("--around", type=int, default=32, help="points of a section")
    arguments = parser.parse_args()
    try:
        lumen = meshing.nasal_passage(arguments.seed, scale=arguments.scale, variation=arguments.variation)
        surface = lumen.surface(arguments.around)
    except ValueError as error:
        parser.error(str(error))
    meshio.Mesh(surface.nodes, [("triangle", surface.triangles)]).write(arguments.output)
    print(
        f"{arguments.output}: {len(surface.nodes)} vertices, {len(surface.triangles)} triangles, "
        f"{1e3 * lumen.length:.1f} mm along the line, semi-axes {1e3 * lumen.radius.min():.1f} to "
        f"{1e3 * lumen.radius.max():.1f} mm"
    )


if __name__ == "__main__":
    main()
