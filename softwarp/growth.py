"""Room for more contacts in a simulation that exists: its arrays made wider, and steps that find no place repeated.

Contacts of a world lie side by side in rows of fixed length. A longer row holds the same contacts in the same places,
so a step gives the same bits whether its room was made before or has grown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import warp as wp

from softwarp.model.fields import allocate, declarations
from softwarp.model.model import Model
from softwarp.model.state import State

if TYPE_CHECKING:
    import torch

GROWTH = 1.5  # of the room, at least, so that a pile that builds up is not met contact by contact
PAD = {"contact_pair": -1}  # what says that a place is empty; 0 elsewhere


def contact_arrays() -> list[str]:
    """Names of the state's arrays that have a place for every contact."""
    return [name for name, declared in declarations(State).items() if declared["item"] == "contact"]


def widened_state(state: State, model: Model) -> State:
    """The state with the room of ``model``: new arrays for contacts, all others as they are."""
    wide: dict[str, wp.array] = {}
    for name in contact_arrays():
        narrow, rows = getattr(state, name), model.contact_capacity * declarations(State)[name]["width"]
        array = allocate(narrow.shape[0], rows, narrow.dtype, narrow.device)
        view = wp.to_torch(array, requires_grad=False)
        view.fill_(PAD.get(name, 0))
        view[:, : narrow.shape[1]] = wp.to_torch(narrow, requires_grad=False)
        wide[name] = array
    return replace(state, **wide)


def fitted(name: str, values: torch.Tensor, places: int) -> torch.Tensor:
    """One of the contact arrays, (world, contact, ...), with another number of places; what has none is left out."""
    import torch

    kept = values[:, :places]
    missing = places - kept.shape[1]
    if missing <= 0:
        return kept
    empty = torch.full_like(kept[:, :1], PAD.get(name, 0)).expand(-1, missing, *kept.shape[2:])
    return torch.cat([kept, empty], dim=1)


def held(arrays: Mapping[str, torch.Tensor]) -> int:
    """Places that the fullest world of some saved contact arrays, by name, needs."""
    import torch

    pair, count = arrays["contact_pair"], arrays["contact_count"]
    place = torch.arange(1, pair.shape[1] + 1, device=pair.device)
    used = torch.where(pair >= 0, place, 0)
    return min(max(int(used.max()), int(count.max())), pair.shape[1])


def more_room(model: Model, missing: int) -> int:
    """Places to make where some were missing: what is needed and some more, but not more than could ever be used."""
    assert model.contact is not None
    present = model.contact_capacity
    return max(present + missing, min(int(GROWTH * present), model.contact.scene.key_count))
