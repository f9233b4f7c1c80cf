"""Rest shapes as inputs: gradients by the rest positions of nodes. How to use it: docs/gradients.md."""

from __future__ import annotations

import torch

from softwarp.model.model import Model

SAME = 1.0e-5  # of the extent: how far a given rest shape may be from that of the model, which float32 has rounded


class RestShape:
    """The rest shape of a model, and what its cables' lengths at rest have to do with it.

    Points of cables, chambers and markers keep their shares of the nodes that carry them: they are of the material.

    Args:
        model: Scene.
        like: A tensor of the precision and on the device of the results.

    Attributes:
        x: Rest positions [m], (node, 3).
        held: 1 where a node is fixed or an axis locked, (node, 3).

    Raises:
        ValueError: For a model with quadratic tetrahedra, tractions or membranes.
    """

    def __init__(self, model: Model, like: torch.Tensor) -> None:
        if model.quadratic is not None:
            told = "rest shapes of quadratic tetrahedra have no gradient yet; mesh the body with linear ones"
            raise ValueError(f"gradients: rest=True: {told}")
        if model.tractions is not None:
            told = "faces under tractions have no gradient by the rest shape; command their sum as control.node_force"
            raise ValueError(f"gradients: rest=True: {told}")
        if model.membranes is not None:
            told = f"membrane {model.membranes.names[0]!r} has no gradient by the rest shape yet; leave rest=True out"
            raise ValueError(f"gradients: rest=True: {told}")
        self.x = torch.as_tensor(model.node_rest).to(like)
        self._extent = model.extent
        self.held = torch.as_tensor(model.node_fixed[:, None] | model.node_locked).to(like)
        self._lengths = self._slopes(model, like)

    @torch.inference_mode(False)
    @torch.enable_grad()  # whoever makes this may take no gradients
    def _slopes(self, model: Model, like: torch.Tensor) -> torch.Tensor:
        """Slope of every length at rest by the rest positions, (cable, node, 3)."""
        node = torch.as_tensor(model.point_node.numpy().reshape(-1, 4)).long()[: model.point_count]
        weight = torch.as_tensor(model.point_weight.numpy().reshape(-1, 4)).double()[: model.point_count]
        weight = torch.where(node < 0, 0.0, weight)
        anchor = torch.as_tensor(model.point_anchor.numpy().reshape(-1, 3)).double()[: model.point_count]
        x = torch.as_tensor(model.node_rest).double().requires_grad_()
        place = anchor + (x[node.clamp(min=0)] * weight[..., None]).sum(dim=1)
        rows = []
        for begin, end in zip(model.cable_starts[:-1], model.cable_starts[1:], strict=True):
            length = place[begin:end].diff(dim=0).norm(dim=1).sum()
            rows.append(torch.autograd.grad(length, x, retain_graph=True)[0])
        empty = torch.zeros((0, *x.shape), dtype=x.dtype)
        return (torch.stack(rows) if rows else empty).to(like)

    def check(self, given: torch.Tensor) -> None:
        """Refuse a rest shape that is not the model's.

        Args:
            given: (world, node, 3) [m].

        Raises:
            ValueError: Saying how far it is from it.
        """
        off = float((given - self.x).abs().max()) if given.numel() else 0.0
        if off > SAME * self._extent:
            raise ValueError(
                f"parameters 'rest_x' must be the rest positions of the model, from which these differ by {off:.3g} m; "
                "gradients are taken there: build the scene from the new positions"
            )

    def slopes(self, along: torch.Tensor) -> dict[str, torch.Tensor]:
        """What follows a slope of rest positions, (world, node, 3), by names of ``Gradients``."""
        products = self._lengths * along[:, None]  # sums one after the other: the same bits in every batch
        return {"rest_x": along, "cable_rest_length": products.flatten(2).cumsum(dim=-1)[..., -1]}

    def gradient(self, by_x: torch.Tensor, by_length: torch.Tensor) -> torch.Tensor:
        """By rest positions, (world, node, 3), from that by elements and that by the lengths of cables."""
        return by_x + torch.einsum("wc,cni->wni", by_length, self._lengths)
