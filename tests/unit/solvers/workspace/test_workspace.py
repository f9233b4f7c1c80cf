"""The workspace is what its declarations say: rows, types, constants; and terms reach nothing else of a step."""

import inspect

import numpy as np
import pytest
import warp as wp

import softwarp as sw
from softwarp import meshing
from softwarp.solvers.terms import table
from softwarp.solvers.terms.term import Term
from softwarp.solvers.workspace.workspace import allocate, counts, declared


def simulation(num_worlds: int, path: str) -> sw.Simulation:
    """A block that a rigid plate carries, with a cable and a hinge."""
    builder = sw.ModelBuilder()
    block = builder.add_tets(meshing.box((0.1, 0.1, 0.1), (2, 2, 2)), material=sw.NeoHookean(1e5, 0.4), density=1000.0)
    plate = builder.add_rigid(sw.Box((0.06, 0.06, 0.01)), density=1000.0, pose=(0.05, 0.05, -0.01))
    builder.attach(block, box=((-1, -1, -1), (1, 1, 1e-6)), to=plate)
    builder.add_joint(None, plate, "hinge", anchor=(0.05, 0.05, -0.01), axis=(0, 1, 0))
    builder.add_cable(block, [(0.05, 0.05, 0.02), (0.05, 0.05, 0.08)])
    return sw.Simulation(builder.finalize(num_worlds), solver_path=path, threads=1)


@pytest.mark.parametrize(("worlds", "path"), [(1, "scalar"), (9, "lanes")])
def test_arrays_have_the_rows_that_are_declared(worlds: int, path: str) -> None:
    """Rows are items times width, at least one; the type is the declared one; constants stand before the first step."""
    system = simulation(worlds, path)._systems[0]
    items = counts(system.model, exact=False)
    work = allocate(system.model, system.variant, worlds, exact=False)
    assert items["joint row"] == 5
    assert items["rigid"] == items["owner"] == 1
    for name, about in declared().items():
        array = getattr(work, name).real
        assert array.shape[1] == max(items[about.item] * about.width, 1), name
        assert array.shape[0] * array.shape[2] >= worlds, name
        assert about.doc, name
        assert (array.dtype is wp.int32) == about.integer, name
        assert np.all(array.numpy() == np.float32(about.keeps or 0.0)), name


def test_terms_of_a_scene() -> None:
    """Elements, then frames, then rows; scenes without a part have no term for it."""
    names = [type(term).__name__ for term in simulation(1, "scalar")._systems[0].terms]
    assert names == ["TetTerm", "InversionTerm", "AttachmentTerm", "FrameTerm", "CableTerm", "JointTerm"]


def test_terms_override_stages_only() -> None:
    """A public method of a term is a stage of ``Term`` with the same arguments.

    Contact also tells where it ends, and finds again what was there with the forces of an earlier iterate; adjoints
    ask for the stiffness of membranes, products with that of hexahedra, what dofs feel of memories, where modes put
    nodes, and how chosen elements are placed and what they do.
    """
    stages = {name for name, value in vars(Term).items() if not name.startswith("_") and inspect.isfunction(value)}
    kinds = [kind for kind in vars(table).values() if inspect.isclass(kind) and issubclass(kind, Term)]
    assert len(kinds) > 8
    for kind in kinds:
        own = {name for name, value in vars(kind).items() if not name.startswith("_") and inspect.isfunction(value)}
        others = {"look", "find_kept", "stiffness", "lean_dofs", "place_both", "sample", "take_samples", "add_products"}
        assert own - stages <= others, kind.__name__
        for name in own & stages:
            assert (
                inspect.signature(vars(kind)[name]).parameters.keys()
                == inspect.signature(vars(Term)[name]).parameters.keys()
            )
