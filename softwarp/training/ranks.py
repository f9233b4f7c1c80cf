"""Ranks: the processes of one training run, and what they tell each other.

Every rank simulates its own worlds on its own device; what they share are gradients, statistics and decisions.
``torchrun`` starts the ranks and says in environment variables which is which; a run of one process is ``ALONE``, whose
methods cost nothing and leave bits as they are.

    gradients       averaged by one all-reduce per minibatch over all of them laid end to end: NCCL between GPUs, gloo
                    between CPUs; never within a captured graph
    statistics      moments of every rank, gathered and merged by their counts in the order of the ranks, so that all
                    ranks hold the same bits
    decisions       of rank 0 (learning rates, clock, when to save) or of any rank (a signal), by gloo on the host,
                    which waits for no GPU
    votes           whether to stop, after every step: what is cast at one step is heard at the next, so that nobody
                    waits for a rank that is less than a step behind, and all ranks stop at the same place

Rank r draws from a seed made of the run's seed and r; that of rank 0 is the run's own.
"""

import io
import os
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

from softwarp.io.bounded import read_tensors

VARIABLES = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")  # of torchrun
PATIENCE = timedelta(hours=2)  # that a rank waits for the others, as long as these live
_PIECE = 1 << 28  # bytes that are sent at a time


class RankLost(ConnectionError):
    """Another rank of the run is gone, or does not answer in time."""


class Ranks:
    """The ranks of a run as one of them sees them; this class is that of a run of one process.

    Attributes:
        rank: Number of this process, from 0.
        size: How many there are.
        local: Number of this process among those of its machine.
    """

    rank = 0
    size = 1
    local = 0

    @property
    def is_first(self) -> bool:
        """Whether this rank writes files and tells how the run goes."""
        return self.rank == 0

    def seed(self, seed: int) -> int:
        """Seed of this rank in a run with ``seed``; no rank of another seed has the same but by chance."""
        return rank_seed(seed, self.rank)

    def gather(self, part: Tensor) -> Tensor:
        """``part`` of all ranks, shape (rank, ...)."""
        return part.unsqueeze(0)

    def average(self, parts: Sequence[Tensor]) -> None:
        """Replace tensors of one type by their means over the ranks, with one all-reduce."""

    def mean(self, part: Tensor) -> Tensor:
        """The mean over the ranks."""
        return part

    def mean_and_spread(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (of a sample) of the values of all ranks."""
        return values.mean(), values.std(correction=min(1, values.numel() - 1))

    def vote(self, wish: int) -> int:
        """Cast ``wish`` and hear the largest of the last vote, 0 if there was none; alone: ``wish``."""
        return wish

    def most(self, number: int) -> int:
        """The largest of all ranks' numbers."""
        return number

    def told(self, number: float) -> float:
        """Rank 0's number."""
        return number

    def share(self, content: Any) -> Any:
        """Rank 0's content: tensors, which come as those of a CPU, numbers and text."""
        return content

    def collect(self, content: Any) -> list[Tensor]:
        """On rank 0 what the ranks after it hold, each packed into bytes (n,); empty elsewhere."""
        return []

    def hand_out(self, packed: Sequence[Tensor] | None) -> Any:
        """On rank r >= 1 the content that rank 0 gives as entry r - 1; None on rank 0."""
        return None

    def exchange(self, content: Any) -> list[Any]:
        """What every rank holds, in their order: tensors, which come as those of a CPU, numbers and text."""
        return [content]

    def follow(self, tensors: Sequence[Tensor]) -> None:
        """Overwrite tensors by those of rank 0."""

    def close(self) -> None:
        """Leave the group, which all ranks do together."""


ALONE = Ranks()


class Group(Ranks):
    """One of several processes, as torchrun's environment variables say.

    Raises:
        RankLost: If the others do not come; every method raises it if one is gone.
    """

    def __init__(self) -> None:
        self.rank, self.size = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
        self.local = int(os.environ["LOCAL_RANK"])
        if int(os.environ["LOCAL_WORLD_SIZE"]) == self.size and "lo" in [name for _, name in socket.if_nameindex()]:
            os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")  # a machine's name may lead to no address of its own
        kinds = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() and dist.is_nccl_available() else "gloo"
        with self._company():
            # The launcher's store outlives a restart, and torch looks up addresses of ranks that are gone.
            store, rank, size = next(iter(dist.rendezvous("env://", timeout=PATIENCE)))  # type: ignore[attr-defined]
            attempt = f"softwarp/{os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}_of_{size}"
            store = dist.PrefixStore(attempt, store)  # type: ignore[attr-defined]
            dist.init_process_group(kinds, store=store, rank=rank, world_size=size, timeout=PATIENCE)
            self._control: Any = dist.new_group(backend="gloo", timeout=PATIENCE)  # on the host, beside what GPUs do
        self._ballot = torch.zeros(1, dtype=torch.int64)
        self._pending: Any = None

    def gather(self, part: Tensor) -> Tensor:
        """``part`` of all ranks, shape (rank, ...)."""
        gathered = [torch.empty_like(part, memory_format=torch.contiguous_format) for _ in range(self.size)]
        with self._company():
            dist.all_gather(gathered, part.contiguous())
        return torch.stack(gathered)

    def average(self, parts: Sequence[Tensor]) -> None:
        """Replace tensors of one type by their means over the ranks, with one all-reduce."""
        flat = torch.cat([part.reshape(-1) for part in parts])
        with self._company():
            dist.all_reduce(flat)
        flat /= self.size
        pieces = flat.split([part.numel() for part in parts])
        torch._foreach_copy_(list(parts), [piece.view_as(part) for piece, part in zip(pieces, parts, strict=True)])

    def mean(self, part: Tensor) -> Tensor:
        """The mean over the ranks."""
        total = part.detach().clone()
        with self._company():
            dist.all_reduce(total)
        return total / self.size

    def mean_and_spread(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (of a sample) of the values of all ranks, which have equally many."""
        own = values.double()
        moments = self.gather(torch.stack((own.mean(), own.var(correction=0))))
        mean = moments[:, 0].mean()
        square = moments[:, 1].mean() + (moments[:, 0] - mean).square().mean()
        count = self.size * values.numel()
        return mean.to(values.dtype), (square * count / (count - 1)).sqrt().to(values.dtype)

    def vote(self, wish: int) -> int:
        """Cast ``wish`` and hear the largest of the last vote, 0 if there was none."""
        verdict = self._hear()
        if not verdict:
            self._ballot = torch.tensor([wish])
            with self._company():
                self._pending = dist.all_reduce(self._ballot, dist.ReduceOp.MAX, self._control, async_op=True)
        return verdict

    def _hear(self) -> int:
        """What the vote that is under way says; 0 if none is."""
        if self._pending is None:
            return 0
        with self._company():
            self._pending.wait()
        self._pending = None
        return int(self._ballot)

    def most(self, number: int) -> int:
        """The largest of all ranks' numbers."""
        largest = torch.tensor([number])
        with self._company():
            dist.all_reduce(largest, dist.ReduceOp.MAX, self._control)
        return int(largest)

    def told(self, number: float) -> float:
        """Rank 0's number."""
        shared = torch.tensor([number], dtype=torch.float64)
        with self._company():
            dist.broadcast(shared, 0, self._control)
        return float(shared)

    def share(self, content: Any) -> Any:
        """Rank 0's content: tensors, which come as those of a CPU, numbers and text."""
        packed = pack(content) if self.is_first else torch.zeros(0, dtype=torch.uint8)
        size = int(self.told(len(packed)))
        if not self.is_first:
            packed = torch.empty(size, dtype=torch.uint8)
        with self._company():
            for piece in packed.split(_PIECE):
                dist.broadcast(piece, 0, self._control)
        return content if self.is_first else _unpack(packed)

    def collect(self, content: Any) -> list[Tensor]:
        """On rank 0 what the ranks after it hold, each packed into bytes (n,); empty elsewhere."""
        if not self.is_first:
            self._send(pack(content), 0)
            return []
        return [self._receive(rank) for rank in range(1, self.size)]

    def hand_out(self, packed: Sequence[Tensor] | None) -> Any:
        """On rank r >= 1 the content that rank 0 gives as entry r - 1; None on rank 0."""
        if not self.is_first:
            return _unpack(self._receive(0))
        for rank, part in enumerate(packed or (), start=1):
            self._send(part, rank)
        return None

    def exchange(self, content: Any) -> list[Any]:
        """What every rank holds, in their order: tensors, which come as those of a CPU, numbers and text."""
        packed = self.collect(content)
        parts = self.share({"packed": [pack(content), *packed] if self.is_first else []})["packed"]
        return [_unpack(part) for part in parts]

    def follow(self, tensors: Sequence[Tensor]) -> None:
        """Overwrite tensors by those of rank 0."""
        with self._company():
            for tensor in tensors:
                whole = tensor.contiguous()
                dist.broadcast(whole, 0)
                if whole is not tensor:
                    tensor.copy_(whole)

    def close(self) -> None:
        """Leave the group, which all ranks do together."""
        self._hear()
        with self._company():
            dist.barrier(self._control)
            dist.destroy_process_group()

    def _send(self, packed: Tensor, rank: int) -> None:
        with self._company():
            dist.send(torch.tensor([len(packed)]), rank, self._control)
            for piece in packed.split(_PIECE):
                dist.send(piece, rank, self._control)

    def _receive(self, rank: int) -> Tensor:
        with self._company():
            size = torch.zeros(1, dtype=torch.int64)
            dist.recv(size, rank, self._control)
            packed = torch.empty(int(size), dtype=torch.uint8)
            for piece in packed.split(_PIECE):
                dist.recv(piece, rank, self._control)
        return packed

    @contextmanager
    def _company(self) -> Iterator[None]:
        """Say which rank misses another, where torch tells of sockets."""
        try:
            yield
        except RuntimeError as error:
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            reason = reason.partition("] ")[2] if reason.startswith("[/") else reason  # without its place in gloo
            told = f"rank {self.rank} of {self.size}: another rank is gone or does not answer"
            raise RankLost(f"{told} ({reason.partition('. ')[0]})") from error


def rank_seed(seed: int, rank: int) -> int:
    """Seed of a rank: the run's own on rank 0, on others a hash of both (NumPy's SeedSequence)."""
    return seed if rank == 0 else int(np.random.SeedSequence((seed, rank)).generate_state(1)[0])


def are_asked() -> bool:
    """Whether torchrun started this process as one of several."""
    return all(name in os.environ for name in VARIABLES) and int(os.environ["WORLD_SIZE"]) > 1


def join() -> Ranks:
    """The ranks of this run: ``ALONE``, or the group that torchrun has started."""
    return Group() if are_asked() else ALONE


def own_device(device: str) -> str:
    """Device of this process, which becomes Torch's present one: of several on a machine each has a GPU of its own.

    Raises:
        ValueError: If the machine has fewer GPUs than ranks.
    """
    if not are_asked() or not device.startswith("cuda"):
        return device
    here, present = int(os.environ["LOCAL_WORLD_SIZE"]), torch.cuda.device_count()
    if here > present:
        raise ValueError(
            f"device {device!r}: {here} ranks on this machine, which has {present} GPUs; start as many ranks as GPUs "
            "(torchrun --nproc-per-node), or take device=cpu"
        )
    own = f"cuda:{os.environ['LOCAL_RANK']}"
    torch.cuda.set_device(own)
    return own


def pin() -> None:
    """Keep this process to its share of the machine's cores, where torchrun started several on it."""
    if not are_asked() or not hasattr(os, "sched_setaffinity"):
        return
    cores = sorted(os.sched_getaffinity(0))
    local, here = int(os.environ["LOCAL_RANK"]), int(os.environ["LOCAL_WORLD_SIZE"])
    if here > 1 and len(cores) >= here:
        own = cores[local * len(cores) // here : (local + 1) * len(cores) // here]
        os.sched_setaffinity(0, own)
        torch.set_num_threads(len(own))


def pack(content: Any) -> Tensor:
    """Tensors, numbers and text as bytes (n,)."""
    file = io.BytesIO()
    torch.save(content, file)
    return torch.frombuffer(bytearray(file.getvalue()), dtype=torch.uint8)


def _unpack(packed: Tensor) -> Any:
    return read_tensors(packed.numpy().tobytes())
