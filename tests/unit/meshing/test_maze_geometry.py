"""Mazes: measures, closed solids, one way between any two cells, shortest ways, refusals."""

import itertools

import networkx
import numpy as np
import pytest

from softwarp import meshing, shapes
from softwarp.meshing.maze_geometry import LOOP

MAZES = [
    meshing.serpentine(),
    meshing.random_maze(8, 8, seed=3),
    meshing.random_maze(5, 9, seed=1, loops=4, corridor=0.01, wall=0.002, height=0.006, floor=0.003),
    meshing.random_maze(2, 2, seed=0),
]


def graph_of(maze):
    """The cells as a graph."""
    graph = networkx.Graph()
    for cell, beside in enumerate(maze.neighbours):
        graph.add_edges_from((cell, int(other)) for other in beside if other >= 0)
    return graph


@pytest.mark.parametrize("maze", MAZES, ids=lambda maze: maze.name)
def test_solid(maze):
    """Closed, outward, one part; its volume is that of the floor and of the blocks that are walls."""
    surface = maze.surface()
    np.testing.assert_array_equal(meshing.check_closed(surface.nodes, surface.triangles), surface.triangles)
    solid = shapes.Mesh(surface.nodes, surface.triangles)
    x, y, z = maze.size
    np.testing.assert_allclose(solid.bounds[1] - solid.bounds[0], (x, y, z), rtol=1e-12)
    np.testing.assert_allclose(solid.bounds[:, 2], (-maze.floor, maze.height), atol=1e-15)
    # Walls: all between neighbouring cells that are closed, the border, and posts; every post of these mazes is needed.
    columns, rows = maze.columns, maze.rows
    pieces = (~maze.east).sum() + (~maze.north).sum() + 2 * (columns + rows)
    posts = maze._is_wall()[::2, ::2].sum()
    area = pieces * maze.corridor * maze.wall + posts * maze.wall**2
    np.testing.assert_allclose(solid.volume, x * y * maze.floor + area * maze.height, rtol=1e-9)
    middles = np.column_stack([maze.centres, np.full(len(maze.centres), 0.5 * maze.corridor)])
    np.testing.assert_allclose(solid.distance(middles).min(), 0.5 * maze.corridor, rtol=1e-9)


def test_serpentine_is_one_ring():
    """60 x 60 x 10 mm; every cell has two neighbours, and one ring runs through all of them."""
    maze = meshing.serpentine()
    np.testing.assert_allclose(maze.size, (0.060, 0.060, 0.010))
    assert len(LOOP) == maze.columns * maze.rows == 64
    assert ((maze.neighbours >= 0).sum(axis=1) == 2).all()
    assert maze.steps.max() == 32
    np.testing.assert_allclose(1e3 * maze.corridor, 6.375)


@pytest.mark.parametrize("seed", range(5))
def test_random_mazes_are_trees(seed):
    """Without loops a spanning tree, with k loops k edges more; the same seed gives the same maze, another does not."""
    maze, again = meshing.random_maze(7, 6, seed=seed), meshing.random_maze(7, 6, seed=seed)
    assert networkx.is_tree(graph_of(maze))
    np.testing.assert_array_equal(maze.neighbours, again.neighbours)
    assert (meshing.random_maze(7, 6, seed=seed + 5).neighbours != maze.neighbours).any()
    assert graph_of(meshing.random_maze(7, 6, seed=seed, loops=3)).number_of_edges() == 41 + 3


@pytest.mark.parametrize("maze", MAZES, ids=lambda maze: maze.name)
def test_shortest_ways(maze):
    """Steps and lengths are those of Dijkstra's algorithm on a graph whose edges are cut at both ends of the way."""
    graph, rng = graph_of(maze), np.random.default_rng(5)
    for cell in range(0, len(maze.centres), 5):
        expected = networkx.single_source_shortest_path_length(graph, cell)
        assert maze.steps[cell].tolist() == [expected[other] for other in range(len(maze.centres))]
    edges = list(graph.edges)
    for _ in range(40):
        cut, ends = networkx.Graph(), []
        cut.add_edges_from(edges, weight=maze.pitch)
        for name in ("start", "goal"):
            a, b = edges[rng.integers(len(edges))]
            share = rng.uniform(0.01, 0.99)
            ends.append(maze.centres[a] + share * (maze.centres[b] - maze.centres[a]))
            cut.add_edge(name, a, weight=share * maze.pitch)
            cut.add_edge(name, b, weight=(1.0 - share) * maze.pitch)
            if name == "goal" and {a, b} == {*cut["start"]} - {"goal"}:
                cut.add_edge("start", "goal", weight=float(np.linalg.norm(ends[0] - ends[1])))
        length = networkx.shortest_path_length(cut, "start", "goal", weight="weight")
        np.testing.assert_allclose(maze.distance(*ends), length, atol=1e-9)
        way = maze.path(*ends)
        np.testing.assert_allclose(way[[0, -1]], ends, atol=1e-12)
        assert np.isclose(np.diff(way, axis=0), 0.0, atol=1e-12).any(axis=1).all()  # along x or along y


def test_a_way_stays_in_the_corridors():
    """Half a corridor away from every wall, all along."""
    maze = meshing.random_maze(6, 6, seed=2, loops=2)
    surface = maze.surface()
    solid = shapes.Mesh(surface.nodes, surface.triangles)
    for a, b in itertools.pairwise(maze.path(maze.centres[0], maze.centres[-1])):
        along = np.linspace(a, b, 20)
        points = np.column_stack([along, np.full(20, 0.5 * maze.corridor)])
        np.testing.assert_allclose(solid.distance(points), 0.5 * maze.corridor, rtol=1e-9)


def test_points_beside_the_middles():
    """A point in a corridor belongs to the nearest place on a middle; ends need not lie on the middles."""
    maze = meshing.serpentine()
    low, high = maze.centres[0], maze.centres[int(maze.neighbours[0, 0])]
    assert maze.on_middle(low + (0.002, -0.001)) == (0, 0, pytest.approx(0.002))
    np.testing.assert_allclose(maze.path(low + (0.002, -0.001), high + (0.0, 0.001)), [low + (0.002, 0.0), high])
    np.testing.assert_allclose(maze.path(low, low), [low])


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: meshing.serpentine(wall=0.0), "wall"),
        (lambda: meshing.serpentine(floor=float("nan")), "floor"),
        (lambda: meshing.random_maze(1, 4, seed=0), "columns"),
        (lambda: meshing.random_maze(200, 200, seed=0), "columns \\* rows"),
        (lambda: meshing.random_maze(3, 3, seed=-1), "seed"),
        (lambda: meshing.random_maze(3, 3, seed=0, loops=5), "loops"),
        (lambda: meshing.Maze(np.zeros((1, 2), bool), np.ones((2, 1), bool)), "cannot be reached"),
        (lambda: meshing.Maze(np.ones((2, 2), bool), np.ones((2, 1), bool)), "shape"),
        (lambda: meshing.Maze(np.ones((1, 2)), np.ones((2, 1), bool)), "flags"),
        (lambda: meshing.serpentine().check_ball(0.0032), "does not fit"),
        (lambda: meshing.serpentine().path((0.0, 0.0), (0.0, 0.0035)), "lies in a wall"),
        (lambda: meshing.serpentine().path((0.0, 0.0035), (0.1, 0.0)), "lies outside"),
        (lambda: meshing.serpentine().path((0.0, np.inf), (0.1, 0.0)), "must be x and y"),
    ],
)
def test_refusals(make, told):
    """What no maze can be is told."""
    with pytest.raises(meshing.MeshError, match=told):
        make()
