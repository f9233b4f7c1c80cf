"""Write the tripod mesh to a file for other programs: python assets/tripod/generate.py medium tripod.vtu."""

import argparse
from pathlib import Path

import meshio

from softwarp import meshing


def main() -> None:
    """Read the command line, generate, write."""
    parser = argparse.ArgumentParser(description="Write the generated tripod mesh to a file, in metres.")
    parser.add_argument("resolution", nargs="?", default="coarse", help="coarse, medium or fine")
    parser.add_argument("output", nargs="?", type=Path, help="file to write; default: tripod_<resolution>.vtu")
    arguments = parser.parse_args()

    resolution = arguments.resolution
    try:
        mesh = meshing.tripod(resolution)
    except meshing.MeshError as error:
        parser.error(str(error))
    path = arguments.output or Path(f"tripod_{resolution}.vtu")
    meshio.Mesh(mesh.nodes, [("tetra", mesh.tets)]).write(path)

    ratio, angle = meshing.radius_ratio(mesh.nodes, mesh.tets), meshing.min_dihedral(mesh.nodes, mesh.tets)
    print(f"{path}: {len(mesh.nodes)} nodes, {len(mesh.tets)} tetrahedra, {mesh.volume * 1e9:.0f} mm^3")
    print(f"worst radius ratio {ratio.min():.3f}, worst dihedral angle {angle.min():.1f} degrees")


if __name__ == "__main__":
    main()
