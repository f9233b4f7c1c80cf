"""Write the board and its chambers to files: python assets/bubble_motion/generate.py coarse board.vtu cell.stl."""

import argparse
from pathlib import Path

import meshio

from softwarp import meshing
from softwarp.meshing.board_geometry import SKIN


def main() -> None:
    """Read the command line, generate, write."""
    parser = argparse.ArgumentParser(description="Write the generated board and its chambers to files, in metres.")
    parser.add_argument("resolution", nargs="?", default="coarse", help="coarse, medium or fine")
    parser.add_argument("output", nargs="?", type=Path, help="file of the solid; default: board_<resolution>.vtu")
    parser.add_argument(
        "chamber",
        nargs="?",
        type=Path,
        help="files of the chambers, a number is added to the name; default: board_<resolution>_cell.stl",
    )
    parser.add_argument("--skin", type=float, default=SKIN, help="thickness of the floor over the chambers [m]")
    parser.add_argument("--no-rim", action="store_true", help="the plate alone")
    arguments = parser.parse_args()

    resolution = arguments.resolution
    try:
        board = meshing.board(resolution, skin=arguments.skin, rim=not arguments.no_rim)
    except meshing.MeshError as error:
        parser.error(str(error))
    solid_file = arguments.output or Path(f"board_{resolution}.vtu")
    pattern = arguments.chamber or Path(f"board_{resolution}_cell.stl")
    meshio.Mesh(board.nodes, [("tetra", board.tets)]).write(solid_file)
    ratio, angle = meshing.radius_ratio(board.nodes, board.tets), meshing.min_dihedral(board.nodes, board.tets)
    print(f"{solid_file}: {len(board.nodes)} nodes, {len(board.tets)} tetrahedra, {board.volume * 1e6:.2f} cm^3")
    for name, wall in board.cavities.items():
        file = pattern.with_stem(f"{pattern.stem}_{name.removeprefix('cell_')}")
        meshio.Mesh(wall.nodes, [("triangle", wall.triangles)]).write(file)
        print(
            f"{file}: {len(wall.nodes)} vertices, {len(wall.triangles)} triangles, {wall.volume * 1e6:.3f} cm^3 of air"
        )
    print(f"worst radius ratio {ratio.min():.3f}, worst dihedral angle {angle.min():.1f} degrees")


if __name__ == "__main__":
    main()
