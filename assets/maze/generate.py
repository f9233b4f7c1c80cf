"""Write a maze to a file: python assets/maze/generate.py serpentine maze.stl; ... random --seed 3 --cells 8 8."""

import argparse
from pathlib import Path

import meshio

from softwarp import meshing
from softwarp.meshing.maze_geometry import CELLS, CORRIDOR, FLOOR, HEIGHT, WALL


def main() -> None:
    """Read the command line, generate, write."""
    parser = argparse.ArgumentParser(description="Write a maze to a file, in metres.")
    parser.add_argument("kind", nargs="?", default="serpentine", choices=("serpentine", "random"))
    parser.add_argument("output", nargs="?", type=Path, help="file of the surface; default: maze_<kind>.stl")
    parser.add_argument("--seed", type=int, default=0, help="of a random maze")
    parser.add_argument("--cells", type=int, nargs=2, default=(CELLS, CELLS), help="of a random maze, along x and y")
    parser.add_argument("--loops", type=int, default=0, help="walls of a random maze that are opened again")
    for measure, value in (("corridor", CORRIDOR), ("wall", WALL), ("height", HEIGHT), ("floor", FLOOR)):
        parser.add_argument(f"--{measure}", type=float, default=value, help="[m]")
    arguments = parser.parse_args()

    measures = {name: getattr(arguments, name) for name in ("corridor", "wall", "height", "floor")}
    try:
        if arguments.kind == "serpentine":
            maze = meshing.serpentine(**measures)
        else:
            maze = meshing.random_maze(*arguments.cells, seed=arguments.seed, loops=arguments.loops, **measures)
    except meshing.MeshError as error:
        parser.error(str(error))
    surface = maze.surface()
    file = arguments.output or Path(f"maze_{arguments.kind}.stl")
    meshio.Mesh(surface.nodes, [("triangle", surface.triangles)]).write(file)
    x, y, z = (1.0e3 * extent for extent in maze.size)
    print(f"{file}: {len(surface.nodes)} vertices, {len(surface.triangles)} triangles, {x:g} x {y:g} x {z:g} mm")
    longest = int(maze.steps.max())
    print(
        f"{maze.columns} x {maze.rows} cells, the longest way is {longest} steps or {longest * maze.pitch * 1e3:g} mm"
    )


if __name__ == "__main__":
    main()
