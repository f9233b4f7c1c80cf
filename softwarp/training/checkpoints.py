"""Checkpoints that survive a kill at any moment.

A checkpoint is one file: a temporary file in the same folder is written, forced to disk and renamed, so a file with a
checkpoint's name is always whole. It holds plain tensors, numbers and text (loading never runs code from it), a format
version, and the resolved configuration, so that it can be used without anything beside it.

``training`` checkpoints hold all that continues a run exactly; ``policy`` checkpoints only what acts.
"""

import fcntl
import os
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from softwarp.io.atomic import atomic_path, writing
from softwarp.io.bounded import DamagedFileError, read_tensors
from softwarp.policies.actor_critic import ActorCritic
from softwarp.policies.policy import NetworkConfig, Policy, Spaces
from softwarp.policies.soft_actor import SoftActor

FORMAT = "softwarp checkpoint"
VERSION = 1
POLICIES: dict[str, type[Policy]] = {cls.kind: cls for cls in (ActorCritic, SoftActor)}
LOCK = ".lock"  # file that a process holds while it trains in a run folder
NAME = re.compile(r"step_(\d{12})\.pt")


class CheckpointError(ValueError):
    """A file that is no whole checkpoint of this program, or does not fit what it is loaded into."""


class NewerCheckpointError(CheckpointError):
    """A checkpoint of a later version of this program, which is whole and must not be passed over."""


def save(path: Path, kind: str, content: dict[str, Any]) -> None:
    """Write a checkpoint so that ``path`` is either its old self or the whole new one, whatever happens.

    Raises:
        WriteError: If it cannot be written.
    """
    with atomic_path(path) as scratch, scratch.open("wb") as file:
        torch.save({"format": FORMAT, "version": VERSION, "kind": kind, **content}, file)


def load(path: Path, *, device: str = "cpu") -> dict[str, Any]:
    """Read a checkpoint.

    Raises:
        CheckpointError: If the file is missing, cut short, altered, of another program or of a newer version.
    """
    if not path.is_file():
        raise CheckpointError(f"checkpoint {path}: no such file")
    try:
        content = read_tensors(path, device=device)
    except DamagedFileError as error:
        raise CheckpointError(f"checkpoint {path}: {error}") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CheckpointError(f"checkpoint {path}: not written by softwarp")
    found = content.get("version")
    if not isinstance(found, int) or found > VERSION:
        kind = NewerCheckpointError if isinstance(found, int) else CheckpointError
        raise kind(f"checkpoint {path}: format version {found}, this softwarp reads {VERSION}; update it")
    return content


@contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Keep a run folder for this process until the block ends, however it ends: two writers would spoil the run.

    Raises:
        CheckpointError: If another process holds it.
        WriteError: If the folder cannot be written to.
    """
    with writing(folder / LOCK):
        handle = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise CheckpointError(f"run folder {folder}: another process trains there; stop it first") from error
        yield
    finally:
        os.close(handle)


class CheckpointFolder:
    """The training checkpoints of a run, the last few of which are kept."""

    def __init__(self, path: Path, keep: int) -> None:
        self.path, self.keep = path, keep

    def save(self, step: int, content: dict[str, Any]) -> Path:
        """Write the checkpoint of an environment step and delete the ones beyond ``keep``."""
        path = self.path / f"step_{step:012d}.pt"
        save(path, "training", content)
        for old in self.files()[: -self.keep]:
            old.unlink(missing_ok=True)
        return path

    def files(self) -> list[Path]:
        """Checkpoints by name, the oldest first."""
        return sorted(path for path in self.path.glob("*.pt") if NAME.fullmatch(path.name))

    def steps(self) -> list[int]:
        """Environment steps of the checkpoints, the lowest first."""
        return [int(path.stem.removeprefix("step_")) for path in self.files()]

    def sweep(self) -> None:
        """Delete what a process left that was killed while it wrote; the run must be held (:func:`hold`)."""
        for leftover in self.path.glob(".step_*.pt"):
            leftover.unlink(missing_ok=True)

    def drop_after(self, step: int) -> None:
        """Delete the checkpoints of later steps: broken ones, or those of a run that is taken back to ``step``."""
        for path in self.files():
            if int(path.stem.removeprefix("step_")) > step:
                path.unlink(missing_ok=True)

    def load_latest(self, *, device: str = "cpu") -> dict[str, Any]:
        """The newest whole checkpoint; warns of each broken one that it passes over.

        Raises:
            CheckpointError: If none is left, or one is of a later version: to go on before it would drop it.
        """
        files = self.files()
        for path in reversed(files):
            try:
                return load(path, device=device)
            except NewerCheckpointError:
                raise
            except CheckpointError as error:
                warnings.warn(f"{error}; using the one before it", stacklevel=2)
        held = f"none of its {len(files)} checkpoints can be read" if files else "it holds no checkpoint yet"
        raise CheckpointError(f"run folder {self.path.parent}: {held}; start the run anew")


def policy_content(policy: Policy) -> dict[str, Any]:
    """What rebuilds a policy: its class, its spaces, its shape and its numbers."""
    described = {"spaces": asdict(policy.spaces), "network": asdict(policy.config)}
    return {"policy_kind": policy.kind, **described, "policy": policy.state_dict()}


def build_policy(content: dict[str, Any]) -> Policy:
    """The policy of a checkpoint of either kind, in evaluation mode.

    Raises:
        CheckpointError: If the checkpoint describes no network, one that its numbers do not fill, or numbers that
            are not finite.
    """
    try:
        kind = POLICIES[content.get("policy_kind", ActorCritic.kind)]
        policy: Policy = kind(Spaces(**content["spaces"]), NetworkConfig(**content["network"]))
        policy.load_state_dict(content["policy"])
    except (KeyError, TypeError, RuntimeError, ValueError, AttributeError, IndexError) as error:
        raise CheckpointError(f"checkpoint: its policy cannot be rebuilt ({error})") from error
    for name, value in policy.state_dict().items():
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            raise CheckpointError(f"checkpoint: {name} of its policy is not finite; take an earlier checkpoint")
    policy.eval()
    return policy


def take_over(policy: Policy, path: Path) -> None:
    """Give a policy the networks of a trained one, its critic among them, and leave its scale of observations as it is.

    Args:
        policy: Of a new run.
        path: Run folder or checkpoint of either kind.

    Raises:
        CheckpointError: If there is none, or one of another algorithm's kind, with other spaces or other networks.
    """
    found = build_policy(load_policy(path))
    shape = {name: (asdict(held.config) | {"initial_std": None}) for name, held in (("has", found), ("asks", policy))}
    for what, has, asks in (
        ("kind of policy", found.kind, policy.kind),
        ("observation and action", asdict(found.spaces), asdict(policy.spaces)),
        ("network", shape["has"], shape["asks"]),
    ):
        if has != asks:
            raise CheckpointError(
                f"warm_start={path}: its {what} is {has}, this run's {asks}; train with the algorithm, environment "
                "options and network settings of that run, which are in its config.yaml"
            )
    policy.load_state_dict(found.state_dict())
    policy.observation_norm.is_frozen = True


def load_policy(path: Path, *, device: str = "cpu") -> dict[str, Any]:
    """Content of the checkpoint that stands for a run folder (best policy, else newest) or of a checkpoint file.

    Raises:
        CheckpointError: If there is no such run or none of its checkpoints can be read.
    """
    if path.is_file():
        return load(path, device=device)
    if not path.is_dir():
        raise CheckpointError(f"run {path}: no such folder or checkpoint")
    best = path / "best.pt"
    if best.is_file():
        try:
            return load(best, device=device)
        except CheckpointError as error:
            warnings.warn(f"{error}; using the newest training checkpoint", stacklevel=2)
    return CheckpointFolder(path / "checkpoints", keep=1).load_latest(device=device)
