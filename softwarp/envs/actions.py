"""The check of actions: at once, or without waiting for the device, as captured steps need it.

Either way an action that is not finite, or no choice, is an error that names the worlds. At once means before any world
is stepped, for one read-back per step. Later means that the device notes such an action, its world acts with 0 instead,
and one of the next calls of the environment raises: the note reaches the host by a copy that nobody waits for.

Where actions are not to be checked, what is no choice is still found later, as no table has a row for it; an action
that is not finite then fails its world in the simulation.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.data.tensor_specs import TensorSpec

from softwarp import checks

_LISTED = 8  # worlds named in an error message


class ActionGuard:
    """Refuses what is not in an action space.

    Args:
        name: Of the environment, for messages.
        spec: Of a batch of actions.
        count: Number of discrete actions; 0 when they are continuous.
        is_on: Whether values are checked before a step that is not captured; shapes and types always are.
    """

    def __init__(self, name: str, spec: TensorSpec, count: int, *, is_on: bool) -> None:
        self.name, self.spec, self.count, self.is_on = name, spec, count, is_on
        self._screens = is_on or count > 0
        self._requirement = f"lie in [0, {count - 1}]" if count else "be finite"
        device = torch.device(spec.device or "cpu")
        worlds = spec.shape[0]
        self._is_noted = torch.zeros(worlds, dtype=torch.bool, device=device)
        self._noted = torch.zeros(spec.shape, dtype=spec.dtype, device=device)  # first refused action of each world
        self._any = torch.zeros(1, dtype=torch.bool, device=device)
        self._seen = torch.zeros(1, dtype=torch.bool, pin_memory=device.type == "cuda")

    def check_form(self, action: Tensor) -> None:
        """Raise ValueError for a wrong shape or type."""
        if not isinstance(action, Tensor):
            raise ValueError(checks.refusal(f"{self.name}: action", f"be a tensor {self.spec.dtype}", action))
        if action.shape != self.spec.shape:
            raise ValueError(f"{self.name}: action must have shape {tuple(self.spec.shape)}, got {tuple(action.shape)}")
        if action.dtype != self.spec.dtype:
            raise ValueError(
                f"{self.name}: action must be {self.spec.dtype}, got {action.dtype}; convert it with .to(...)"
            )

    def check(self, action: Tensor) -> None:
        """Raise ValueError, naming the worlds, for an action that is not in the action space; waits for the device."""
        if not self.is_on or (not self.count and bool(torch.isfinite(action.sum()))):
            return
        refused = self._refused(action)
        if bool(refused.any()):
            raise ValueError(f"{self._message(refused, action)}. No world was stepped")

    def admit(self, action: Tensor) -> Tensor:
        """The action that a step carries out which is not captured: checked at once, or screened.

        Raises:
            ValueError: For this action, or one that was screened before.
        """
        if self.is_on or not self._screens:
            self.check(action)
            return action
        self.raise_noted()
        action = self.screen(action)
        self.publish()
        return action

    def screen(self, action: Tensor) -> Tensor:
        """The action with 0 where it is refused; notes which worlds that concerns. Never waits."""
        if not self._screens:
            return action
        refused = self._refused(action)
        torch.where(_like(refused & ~self._is_noted, action), action, self._noted, out=self._noted)
        self._is_noted.logical_or_(refused)
        torch.any(self._is_noted, dim=0, keepdim=True, out=self._any)
        return action.masked_fill(_like(refused, action), 0)

    def publish(self) -> None:
        """Send word of refused actions to the host, some time after the steps that were launched before."""
        if self._screens:
            self._seen.copy_(self._any, non_blocking=True)

    def raise_noted(self, *, wait: bool = False) -> None:
        """Raise ValueError for the actions that were refused since the last call, as far as the host knows of them.

        Args:
            wait: First wait for the steps that were launched.
        """
        if not self._screens:
            return
        if wait:
            self._seen.copy_(self._any)
        if not bool(self._seen):  # memory of the host, which is read without waiting
            return
        message = self._message(self._is_noted, self._noted)
        self._is_noted.zero_()
        self._any.zero_()
        self._seen.copy_(self._any)
        why, way = "Steps are captured", "capture=False"
        if not self.is_on:
            why, way = "Actions are not checked", "capture=False and check_actions=True"
        raise ValueError(
            f"{message}. {why}, so that this was found afterwards: these worlds acted with 0 instead; with {way} it is "
            "found before any world is stepped"
        )

    def _refused(self, action: Tensor) -> Tensor:
        """Worlds whose action is not in the action space, bool (world,)."""
        if self.count:
            return (action < 0) | (action >= self.count)
        return ~torch.isfinite(action).all(dim=-1)

    def _message(self, refused: Tensor, action: Tensor) -> str:
        worlds = torch.nonzero(refused).flatten().tolist()
        more = f" and {len(worlds) - _LISTED} more" if len(worlds) > _LISTED else ""
        return (
            f"{self.name}: every action must {self._requirement}; world {', '.join(map(str, worlds[:_LISTED]))}{more} "
            f"got something else, for example {action[worlds[0]].tolist()}"
        )


def _like(mask: Tensor, action: Tensor) -> Tensor:
    """A mask of worlds with as many axes as an action."""
    return mask.reshape(-1, *[1] * (action.dim() - 1))
