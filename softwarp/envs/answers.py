"""What the hooks of a task may answer: looked at the first time that each is called, and told with the way out.

Names, types, shapes and devices are looked at once, so later steps cost nothing and captured ones stay captured. That
numbers are finite is noted for every action, on the device: a world for which a hook says nan is ended as failed, and
``tell`` names the hook, what it said and the worlds.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import CodeType
from typing import Any

import torch
from torch import Tensor

from softwarp import checks
from softwarp.advice import close_to, did_you_mean
from softwarp.envs.hooks import Hooks
from softwarp.envs.soundness import is_finite_state
from softwarp.model.codes import Status
from softwarp.simulation import Simulation

RESERVED = ("action", "reward", "done", "terminated", "truncated", "success", "distance", "world_status", "action_mask")
_ADDED = ("failure", "inversion")  # reward terms of the base class
_FAILED = int(Status.NONFINITE)  # from here on the simulator has rolled the world back
_ALIKE = 0.85  # likeness from which a method that nobody calls is taken for a misspelt hook
_LISTED = 8  # worlds named in a message
_CAUSES = "divisions by 0, and roots or logarithms of what may be negative, are the usual causes"


def check_class(task: type, base: type) -> None:
    """Refuse a task that lacks a hook, or has a method that can only be a misspelt one.

    Args:
        task: The class.
        base: What it derives from; names that this has are no misspelt ones.

    Raises:
        ValueError: Naming the class, the hooks and what may have been meant.
    """
    own = [kind for kind in task.__mro__ if not issubclass(base, kind)]
    given = {name: value for kind in reversed(own) for name, value in vars(kind).items() if _is_method(name, value)}
    missing = sorted(getattr(task, "__abstractmethods__", ()))
    if missing:
        near = {name: close_to(name, given, count=1) for name in missing}
        meant = "".join(f"; {name}: {did_you_mean(found)}" for name, found in near.items() if found)
        raise ValueError(f"{task.__name__} lacks the hook{'s'[: len(missing) > 1]} {', '.join(missing)}{meant}")
    hooks = [name for name in vars(Hooks) if not name.startswith("_") and name not in given]
    called = {name for value in given.values() for name in _called_by(value)}
    for name in given:
        if hasattr(base, name) or name in called:
            continue
        if near_hooks := close_to(name, hooks, count=1, cutoff=_ALIKE):
            raise ValueError(
                f"{task.__name__}.{name} is called by nobody; {did_you_mean(near_hooks)} If it is no hook, begin its "
                "name with an underscore"
            )


def _is_method(name: str, value: Any) -> bool:
    return not name.startswith("_") and (inspect.isfunction(value) or isinstance(value, property))


def _called_by(value: Any) -> Iterator[str]:
    """Names that the code of a method uses."""
    function = value.fget if isinstance(value, property) else value
    codes: list[CodeType] = [function.__code__] if inspect.isfunction(function) else []
    while codes:
        code = codes.pop()
        yield from code.co_names
        codes += [part for part in code.co_consts if isinstance(part, CodeType)]


class Answers:
    """Looks at what the hooks of one environment say.

    Args:
        task: The environment, for its hooks and the names in messages.
        count: Worlds.
        device: Of tensors.
    """

    def __init__(self, task: Hooks, count: int, device: torch.device) -> None:
        self.name, self.count, self.device = type(task).__name__, count, device
        self._seen: set[str] = set()
        self._begun: set[str] = set()  # stages that were looked at
        self._found: dict[str, Tensor] = {}  # stage -> how often a part was not finite, int64 (world, part)
        self._parts: dict[str, tuple[str, ...]] = {}
        self._told: dict[tuple[str, str], int] = {}  # how often it was when that was last told
        self._has_news = False

    def refuse(self, hook: str, need: str, answer: Any, advice: str = "") -> ValueError:
        """The error of an answer that cannot be used."""
        return ValueError(checks.refusal(f"{self.name}.{hook}", need, answer, advice))

    def actions(self, size: Any, count: Any) -> None:
        """Check ``action_size`` and ``action_count``, exactly one of which is above 0."""
        for hook, value in (("action_size", size), ("action_count", count)):
            checks.count(value, f"{self.name}.{hook}", low=0)
        if (size > 0) == (count > 0):
            raise ValueError(
                f"{self.name}: actions must be continuous or discrete, got action_size {size} and action_count "
                f"{count}; override action_size with the length of a continuous action, or action_count with the "
                "number of choices"
            )

    def bounds(self, answer: Any, sensors: Sequence[str] = ()) -> None:
        """Check ``observation_bounds``; ``sensors`` are keys that are taken."""
        hook = "observation_bounds"
        if not isinstance(answer, Mapping) or not answer or not all(isinstance(key, str) and key for key in answer):
            raise self.refuse(hook, "return a dictionary of names and pairs of tensors (low, high)", answer)
        for key, pair in answer.items():
            if key in RESERVED or key in sensors:
                raise self.refuse(hook, "use names of its own", key, f"taken are {', '.join((*RESERVED, *sensors))}")
            where = f"{hook}: {key!r}"
            if not isinstance(pair, (tuple, list)) or len(pair) != 2 or not all(isinstance(x, Tensor) for x in pair):
                raise self.refuse(where, "be a pair of tensors (low, high), each of shape (k,)", pair)
            for part in pair:
                if part.dim() != 1 or part.dtype != torch.float32 or part.shape != pair[0].shape or not len(part):
                    raise self.refuse(where, "be two float32 tensors of one shape (k,)", part)
            low, high = pair[0].cpu(), pair[1].cpu()
            if not bool((torch.isfinite(low) & torch.isfinite(high) & (low < high)).all()):
                raise self.refuse(where, "be finite, and below its upper bound", low, f"the upper bound is {high}")

    def mask(self, answer: Any, count: int) -> None:
        """Check ``action_mask`` of a task with ``count`` choices."""
        if answer is not None and not count:
            raise self.refuse("action_mask", "be None, as actions are continuous", answer)
        if answer is not None:
            self._check_tensor("action_mask", answer, (self.count, count), torch.bool)

    def distance(self, answer: Any) -> None:
        """Check ``measure_distance`` the first time."""
        if "measure_distance" not in self._seen:
            self._check_tensor("measure_distance", answer, (self.count,), torch.float32)
            self._seen.add("measure_distance")

    def flags(self, hook: str, answer: Tensor) -> Tensor:
        """The answer of ``is_success`` or ``is_terminated``, checked the first time."""
        if hook not in self._seen:
            self._check_tensor(hook, answer, (self.count,), torch.bool)
            self._seen.add(hook)
        return answer

    def observation(self, answer: Any, bounds: Mapping[str, tuple[Tensor, Tensor]]) -> None:
        """Check ``observe`` the first time, by what ``observation_bounds`` says."""
        if "observe" in self._seen:
            return
        if not isinstance(answer, dict):
            raise self.refuse("observe", "return a dictionary of tensors", answer, f"its keys are {list(bounds)}")
        if answer.keys() != bounds.keys():
            told = ", ".join(map(repr, answer)) or "none"
            need = f"have the keys of observation_bounds, {', '.join(map(repr, bounds))}"
            raise ValueError(f"{self.name}.observe must {need}, got {told}; name them alike in both hooks")
        for key, value in answer.items():
            shape = (self.count, len(bounds[key][0]))
            advice = "observation_bounds tells k; the world stands first"
            self._check_tensor(f"observe: {key!r}", value, shape, torch.float32, advice=advice)
        self._seen.add("observe")

    def rewards(self, answer: Any, names: Sequence[str] | None = None) -> None:
        """Check ``reward_terms`` the first time; ``names`` are those of the probe."""
        if (call := "reward_terms" if names is None else "reward_terms of a step") in self._seen:
            return
        if not isinstance(answer, dict) or not answer or not all(isinstance(key, str) and key for key in answer):
            raise self.refuse("reward_terms", "return a dictionary of names and tensors of shape (world,)", answer)
        if taken := [key for key in _ADDED if key in answer]:
            raise ValueError(f"{self.name}.reward_terms: {taken[0]!r} is a term of the base class; choose another name")
        if names is not None and tuple(answer) != tuple(names):
            told = f"gave {', '.join(map(repr, names))} first, then {', '.join(map(repr, answer))}"
            raise ValueError(f"{self.name}.reward_terms {told}; return the same names always, 0 where there is nothing")
        for key, value in answer.items():
            whole = isinstance(value, Tensor) and not (value.is_floating_point() or value.is_complex())
            dtype = value.dtype if whole else torch.float32  # flags and counts add up as well
            self._check_tensor(f"reward_terms: {key!r}", value, (self.count,), dtype)
        self._seen.add(call)

    def _check_tensor(
        self, where: str, value: Any, shape: tuple[int, ...], dtype: torch.dtype, advice: str = ""
    ) -> None:
        """Raise ValueError unless a value is a tensor of this shape and type, on the device of the worlds."""
        if not isinstance(value, Tensor):
            raise self.refuse(where, f"be a tensor {dtype} of shape {shape}", value, advice)
        if value.shape != shape:
            raise self.refuse(where, f"have shape {shape}", value, advice or "the world stands first")
        if value.dtype != dtype:
            raise self.refuse(where, f"be {dtype}", value, f"convert it with .to({dtype})")
        if value.device != self.device:
            told = f"be on {self.device}, got a tensor on {value.device}"
            raise ValueError(f"{self.name}.{where} must {told}; make tensors with device=self.device")

    # What is not finite.

    def screen(
        self,
        stage: str,
        status: Tensor,
        distance: Tensor,
        terms: Mapping[str, Tensor],
        seen: Mapping[str, Tensor],
        *,
        at_once: bool,
    ) -> Tensor:
        """Worlds whose numbers are all finite and that the simulator has not given up, bool (world,).

        Worlds that a hook has spoilt are noted; those that have lost their state are not, as no hook is to blame.

        Args:
            stage: ``"reset"`` or ``"step"``.
            status: Of the worlds, int32 (world,).
            distance: Of ``measure_distance``, (world,).
            terms: Of ``reward_terms``, each (world,).
            seen: Observations and sensors, each (world, k).
            at_once: Whether to wait for the device, and note nothing where all is well.
        """
        columns = torch.stack((distance, *terms.values(), *(part.sum(dim=1) for part in seen.values())), dim=1)
        is_kept = status < _FAILED
        good = torch.isfinite(columns.sum(dim=1)).logical_and_(is_kept)
        if at_once and bool(good.all()):
            self._begun.add(stage)
            return good
        odd = ~torch.isfinite(columns) & is_kept[:, None]
        if stage not in self._found:
            parts = [f"reward_terms: {name!r}" for name in terms] + [f"observe: {key!r}" for key in seen]
            self._parts[stage] = ("measure_distance", *parts)
            with torch.inference_mode(False):  # may be made there and written elsewhere
                self._found[stage] = torch.zeros(odd.shape, dtype=torch.int64, device=self.device)
        self._found[stage].add_(odd)
        self._has_news = at_once
        return good

    def hear_news(self, sim: Simulation) -> None:
        """Hear what steps and resets that were not captured have noted, if there is anything new."""
        if self._has_news:
            self._has_news = False
            self.hear(sim)

    def hear(self, sim: Simulation) -> None:
        """Tell what was not finite; waits for the device.

        Warns of every hook's answer at once, and again when ten times as much has come.

        Raises:
            ValueError: After the first step or reset, for what is finite in no world although the simulation is.
        """
        for stage, found in self._found.items():
            if stage not in self._begun:
                self._begun.add(stage)
                self._refuse_first(stage, found, sim)
            counts = dict(zip(self._parts[stage], found.sum(dim=0).tolist(), strict=True))
            due = [part for part, count in counts.items() if count >= 10 * max(self._told.get((stage, part), 0), 0.1)]
            if due:
                self._told |= {(stage, part): counts[part] for part in due}
                times = f"{counts[due[0]]} {stage}{'s'[: counts[due[0]] > 1]}"
                self._warn(due, times, found[:, self._parts[stage].index(due[0])])

    def _refuse_first(self, stage: str, found: Tensor, sim: Simulation) -> None:
        everywhere = (found > 0).all(dim=0).nonzero().flatten().tolist()
        if everywhere and bool(is_finite_state(sim).all()):
            found.zero_()
            self._begun.discard(stage)  # whoever goes on hears it again
            raise ValueError(
                f"{self.name}.{self._parts[stage][everywhere[0]]} must be finite, got nan or infinity in each of "
                f"{self.count} worlds at the first {stage}, although all positions and velocities are finite; {_CAUSES}"
            )

    def _warn(self, parts: Sequence[str], times: str, found: Tensor) -> None:
        """Of the first part, which those after it may have been computed from."""
        others = f"; neither was {', '.join(parts[1:])}" if parts[1:] else ""
        warnings.warn(
            f"{self.name}.{parts[0]} was not finite in {times} so far ({_listed(found > 0)}) although the simulator "
            f"found no fault{others}; these episodes ended as failed, and no policy sees the number; {_CAUSES}",
            stacklevel=2,
        )

    # What a reset may touch.

    @contextmanager
    def untouched(self, mask: Tensor, tensors: Mapping[str, Tensor], *, is_watched: bool) -> Iterator[None]:
        """Meanwhile ``reset_worlds`` runs; the first time for some worlds only, the others must keep every bit.

        Raises:
            ValueError: Naming what has changed in worlds that were not reset.
        """
        if not is_watched or "reset_worlds" in self._seen or not 0 < int(mask.sum()) < self.count:
            yield
            return
        before = {name: tensor.clone() for name, tensor in tensors.items()}
        yield
        for name, old in before.items():
            changed = _rows(tensors[name] != old).any(dim=1) & _rows(old == old).all(dim=1) & ~mask  # nan is unlike nan
            if bool(changed.any()):
                raise ValueError(
                    f"{self.name}.reset_worlds must change only worlds that are reset, but world state {name!r} "
                    f"changed in others ({_listed(changed)}); take new values where the mask holds, "
                    "tensor.copy_(torch.where(mask[:, None], new, tensor)), or mask where it is of shape (world,)"
                )
        self._seen.add("reset_worlds")


def _rows(tensor: Tensor) -> Tensor:
    """All numbers of each world, (world, k)."""
    return tensor.reshape(len(tensor), tensor[0].numel())


def _listed(worlds: Tensor) -> str:
    """Worlds of a mask, bool (world,), in words."""
    numbers = worlds.nonzero().flatten().tolist()
    more = f" and {len(numbers) - _LISTED} more" if len(numbers) > _LISTED else ""
    return f"world {', '.join(map(str, numbers[:_LISTED]))}{more}"
