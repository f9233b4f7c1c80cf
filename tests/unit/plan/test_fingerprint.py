"""The digest of a scene: no record of the model is forgotten."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

import softwarp as sw
from softwarp import meshing
from softwarp.model.fields import shared
from softwarp.model.model import Model
from softwarp.plan.fingerprint import fingerprint


@dataclass
class Ropes:
    """A part that came after the lists of arrays were written."""

    rope_length: wp.array = shared("rope", unit="m")
    rope_node: wp.array = shared("rope")


@dataclass
class Wider(Model):
    """A model with such a part."""

    ropes: Any = None


def test_records_that_no_list_names_count() -> None:
    """Every declared array of them changes the digest; without such a part it stays what it was."""
    builder = sw.ModelBuilder()
    body = builder.add_tets(meshing.box((0.1, 0.1, 0.1), (1, 1, 1)), material=sw.NeoHookean(1e5, 0.4), density=1000.0)
    builder.fix(body, nodes=[0])
    model = builder.finalize()

    def digest(ropes: Ropes | None) -> str:
        return fingerprint(builder.scene, Wider(**vars(model), ropes=ropes), None)

    assert digest(None) == model.fingerprint
    length, node = np.array([0.1, 0.2]), np.array([[0, 1], [1, 2]])
    ropes = [Ropes(length, node), Ropes(2.0 * length, node), Ropes(length, node + 1), None]
    assert len({digest(rope) for rope in ropes}) == 4
    assert digest(Ropes(length.copy(), node.copy())) == digest(ropes[0])
