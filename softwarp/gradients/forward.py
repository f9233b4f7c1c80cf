"""Forward mode: slopes of states along a few directions of what steps start from. How to use it: docs/gradients.md."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from softwarp import checks
from softwarp.advice import nearest
from softwarp.gradients.calls import Call, push
from softwarp.gradients.rollout import GROUPS, Rollout, States, tensors_of

Tensors = Mapping[str, torch.Tensor]


def jvp(
    rollout: Rollout,
    along: Mapping[str, Tensors],
    state: Tensors | None = None,
    controls: Tensors | None = None,
    parameters: Tensors | None = None,
    *,
    steps: int | None = None,
    every: int = 1,
) -> tuple[States, States]:
    """Take the steps of a rollout, and push directions through them: Jacobians times vectors.

    All directions share the factor of every step, so that each costs about what the adjoint of a step costs with kept
    factors, and memory does not grow with the number of steps. For one direction, ``torch.autograd.forward_ad`` does
    the same with ``rollout`` itself, which then takes the steps twice.

    Args:
        rollout: Of what.
        along: Directions: ``{"parameters": {"youngs": tensor}}`` and so on, with the groups and names of the arguments,
            and a leading axis of directions that all tensors share before the axes of the argument. What is not named
            does not change.
        state: As of ``rollout``.
        controls: As of ``rollout``.
        parameters: As of ``rollout``.
        steps: As of ``rollout``.
        every: As of ``rollout``.

    Returns:
        States, and their slopes with a leading axis of directions: (direction, state, world, ...).

    Raises:
        ValueError: As ``rollout``, and for numbers of directions that do not agree.
        Diverged: If a step failed; the message names the worlds.
    """
    plan, given = rollout.plan(state, controls, parameters, steps=steps, every=every)
    directions = _directions(rollout, plan.steps, along)
    with torch.no_grad():
        call = Call(rollout.worlds, plan, {name: value.detach() for name, value in given.items()})
        kept, slopes = push(call, directions)
        return rollout.states(plan, kept), rollout.slopes(plan, kept, slopes)


def _directions(rollout: Rollout, steps: int, along: Mapping[str, Tensors]) -> list[dict[str, torch.Tensor]]:
    """Every direction as tensors that fit into the worlds, by the names of a call."""
    found: list[dict[str, torch.Tensor]] = []
    for group, named in tensors_of("gradients.jvp: along", along).items():
        if group not in GROUPS:
            raise ValueError(f"gradients.jvp: along has no group {group!r}; {nearest(group, tuple(GROUPS))}")
        for name, value in tensors_of(f"gradients.jvp: along {group}", named).items():
            slopes = torch.as_tensor(value)
            found = found or [{} for _ in range(len(slopes) if slopes.ndim else 0)]
            if slopes.ndim == 0 or len(slopes) != len(found):
                need = f"have a leading axis of directions, {len(found) or 'one or more'} of them as all others"
                raise ValueError(checks.refusal(f"gradients.jvp: along {group} {name!r}", need, slopes))
            for direction, slope in zip(found, slopes, strict=True):
                moving: list[str] = []
                fit = rollout.fit(group, name, slope, moving)
                if moving and len(fit) != steps:
                    raise ValueError(
                        f"gradients.jvp: along {group} {name!r} has {len(fit)} steps, and the rollout {steps}"
                    )
                direction[f"{GROUPS[group]}.{name}"] = fit
    if not found:
        raise ValueError('gradients.jvp: along names no direction; give {"parameters": {"youngs": tensor}} or the like')
    return found
