"""Write the quadruped and its chambers to files: python assets/multi_gait/generate.py coarse body.vtu chamber.stl."""

import argparse
from pathlib import Path

import meshio

from softwarp import meshing


def main() -> None:
    """Read the command line, generate, write."""
    parser = argparse.ArgumentParser(description="Write the quadruped and its chambers to files, in metres.")
    parser.add_argument("resolution", nargs="?", default="coarse", help="coarse or fine")
    parser.add_argument("output", nargs="?", type=Path, help="file of the solid; default: quadruped_<resolution>.vtu")
    parser.add_argument(
        "chamber",
        nargs="?",
        type=Path,
        help="files of the chambers, their names are added; default: quadruped_<resolution>_chamber.stl",
    )
    parser.add_argument("--skin", type=Path, help="file of the surface that touches; not written without")
    arguments = parser.parse_args()

    resolution = arguments.resolution
    try:
        body = meshing.quadruped(resolution)
    except meshing.MeshError as error:
        parser.error(str(error))
    solid_file = arguments.output or Path(f"quadruped_{resolution}.vtu")
    pattern = arguments.chamber or Path(f"quadruped_{resolution}_chamber.stl")
    meshio.Mesh(body.nodes, [("tetra", body.tets)]).write(solid_file)
    print(f"{solid_file}: {len(body.nodes)} nodes, {len(body.tets)} tetrahedra, {body.volume * 1e9:.1f} mm^3")
    for name, wall in body.cavities.items():
        file = pattern.with_stem(f"{pattern.stem}_{name}")
        meshio.Mesh(wall.nodes, [("triangle", wall.triangles)]).write(file)
        print(f"{file}: {len(wall.nodes)} vertices, {wall.volume * 1e9:.2f} mm^3 of air")
    if arguments.skin is not None:
        skin = meshing.quadruped_skin()
        meshio.Mesh(skin.nodes, [("triangle", skin.triangles)]).write(arguments.skin)
        print(f"{arguments.skin}: {len(skin.nodes)} vertices, {len(skin.triangles)} triangles")
    ratio, angle = meshing.radius_ratio(body.nodes, body.tets), meshing.min_dihedral(body.nodes, body.tets)
    print(f"worst radius ratio {ratio.min():.3f}, worst dihedral angle {angle.min():.1f} degrees")


if __name__ == "__main__":
    main()
