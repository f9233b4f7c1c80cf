"""The studies behind docs/accuracy.md: elements of the NumPy study, patches, sentences of the page."""

import dataclasses
import json

import numpy as np
import pytest

from softwarp import cli, meshing
from tests import cases


def part(name):
    return cli.script("benchmarks", name)


@pytest.fixture(scope="module")
def locking():
    return part("locking")


def beam(locking, nu):
    """The cantilever of catalogue 2.1 at small strain, 25 N on its end."""
    mu, lam = cases.lame(1.0e6, nu)
    return locking.Problem(
        name="beam",
        mesh=meshing.box((1.0, 0.1, 0.1), (20, 2, 2)),
        mu=mu,
        lam=lam,
        fixed=lambda nodes: nodes[:, 0] < 1e-9,
        weight=(0.0, 0.0, -2500.0),
        read=lambda nodes, u: float(u[np.argmin(np.abs(nodes - [1.0, 0.05, 0.05]).sum(axis=1)), 2]),
        face=lambda nodes: nodes[:, 0] > 1.0 - 1e-9,
    )


@pytest.mark.parametrize(
    ("element", "nu", "expected"), [("p1", 0.3, -0.5076298), ("p2", 0.3, -0.9965836), ("p2", 0.49, -0.9618203)]
)
def test_study_against_the_catalogue(locking, element, nu, expected):
    """The same-mesh numbers of scikit-fem, catalogue 2.1 and 1.6: 1e-6."""
    assert locking.solve(beam(locking, nu), element)[0] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("element", ["average", "patch", "face", "edge", "node", "edge, node", "edge, patch"])
def test_averaged_elements_pass_the_patch_test(locking, element):
    """Averages keep the volume, and a uniform strain stores mu e:e + lam/2 (tr e)^2 per volume: 1e-12."""
    problem = beam(locking, 0.3)
    slope = np.array([[0.3, 0.1, 0.0], [-0.2, 0.4, 0.1], [0.5, 0.0, -0.1]])
    strain = 0.5 * (slope + slope.T)
    u = (problem.mesh.nodes @ slope.T).ravel()
    matrix, domains = locking.averaged(problem, *locking.DOMAINS[element])
    density = problem.mu * (strain**2).sum() + 0.5 * problem.lam * np.trace(strain) ** 2
    assert 0.5 * u @ (matrix @ u) == pytest.approx(density * problem.mesh.volume, rel=1e-12)
    assert all(domain.shape[1] == len(problem.mesh.nodes) for domain in domains)


@pytest.mark.parametrize("size", [4, 8, 12])
def test_patches_cover_the_mesh(locking, size):
    """Every tetrahedron is in one patch; none is much smaller or larger than asked."""
    tets = meshing.trunk("coarse").tets
    sizes = np.bincount(locking.patches(tets, size))
    assert sizes.sum() == len(tets)
    assert size // 3 < sizes.min() and sizes.max() <= 2 * size


def test_page_says_what_the_records_say(tmp_path):
    """Which meshes reach 2 %, and by how much they differ; a problem without such a mesh says that too."""
    page = part("accuracy_page")
    solids = part("solids")
    problem = solids.Problem("beam", "A beam", "deflection", "mm", 10.0, "theory", {}, lambda: None)
    row = {"problem": "beam", "cells": [1, 1, 1], "static_s": 1.0, "ms_per_step": 2.0, "value": 9.9, "error": -0.01}
    fine = row | {"element": "p2", "unknowns": 100}
    coarse = row | {"element": "p1", "unknowns": 1000, "static_s": 5.0, "ms_per_step": 30.0}
    text = page.statement([fine, coarse])
    assert "within 2 % with 100 unknowns" in text
    assert "need 1000 unknowns for 1.0 %, 5 s (5 times) and 30 ms (15 times)" in text
    assert "still 5.0 % off with 1000 unknowns" in page.statement([fine, coarse | {"error": -0.05}])
    assert "the best is 3.0 % off" in page.statement([fine | {"error": 0.03}, coarse])
    page.write([dataclasses.replace(problem, name="beam")], [fine, coarse], tmp_path)
    assert (tmp_path / "images" / "accuracy_beam.png").stat().st_size > 1000
    assert "## A beam" in (tmp_path / "accuracy.md").read_text()


def test_records_of_the_page_are_complete():
    """Both elements of every problem, all converged, on the page as they are in the records."""
    solids, accuracy = part("solids"), part("accuracy")
    records = json.loads(accuracy.RESULTS.read_text())
    page = (solids.ROOT / "docs" / "accuracy.md").read_text()
    for problem in solids.problems():
        rows = [record for record in records if record["problem"] == problem.name]
        assert [tuple(r["cells"]) for r in rows if r.get("graded", True)] == list(sum(problem.cells.values(), ()))
        assert all(r["converged"] for r in rows)
        assert f"## {problem.title}" in page
        assert all(f"| {r['value']:.5g} | {100.0 * r['error']:+.1f} % |" in page for r in rows)
