"""Forces of contacts at the nodes of soft bodies, as recorded motion holds them."""

from types import SimpleNamespace

import pytest
import torch

from softwarp.model.handles import RigidBody, SoftBody
from softwarp.reduction import motion

WORLDS, CONTACTS, NODES = 3, 7, (4, 9)  # of two bodies


@pytest.mark.parametrize("together", [motion.TOGETHER, 20])
def test_each_force_is_at_the_nearest_node_of_its_own_world_and_body(monkeypatch: pytest.MonkeyPatch, together: int):
    """Against one contact after the other, some of them at one node; also with few distances at a time."""
    monkeypatch.setattr(motion, "TOGETHER", together)
    draws = torch.Generator().manual_seed(3)
    parts = [(SoftBody(0), RigidBody(0)), (SoftBody(0), SoftBody(1))]
    sim = SimpleNamespace(
        model=SimpleNamespace(contact=SimpleNamespace(parts=parts), body_node_start=[0, NODES[0], sum(NODES)]),
        node_x=torch.rand(WORLDS, sum(NODES), 3, generator=draws),
        contact_pair=torch.randint(-1, 2, (WORLDS, CONTACTS), generator=draws),
        contact_point=torch.rand(WORLDS, CONTACTS, 3, generator=draws),
        contact_load=torch.rand(WORLDS, CONTACTS, 3, generator=draws),
    )
    wanted = torch.zeros_like(sim.node_x)
    for w in range(WORLDS):
        for c in range(CONTACTS):
            if (pair := int(sim.contact_pair[w, c])) < 0:
                continue
            for part, sign in zip(parts[pair], (1.0, -1.0), strict=True):
                if isinstance(part, SoftBody):
                    first = sum(NODES[: int(part)])
                    nodes = sim.node_x[w, first : first + NODES[int(part)]]
                    near = first + int((nodes - sim.contact_point[w, c]).norm(dim=1).argmin())
                    wanted[w, near] += sign * sim.contact_load[w, c]
    assert (sim.contact_pair >= 0).sum() > WORLDS
    torch.testing.assert_close(motion._touch(sim), wanted)
