"""Calls of a function that are replayed as one CUDA graph, with the bits that the function itself gives.

The arguments are copied into fixed tensors that the graph reads; the results lie in fixed memory that the graph writes,
one piece for each type of numbers, and a call returns copies of these: what a caller keeps is never overwritten. That
takes a few launches and no wait for the device, whatever the function does.

On a CPU the same tensors are used and the function is called anew each time.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from softwarp import interop
from softwarp.threads import alone

_ALIGNMENT = 16  # numbers, at multiples of which each tensor begins

_REHEARSALS = 2  # calls in which a function may show that it does not wait for the device
_MODE = "thread_local"  # what other threads do meanwhile ends no capture
_WAIT = "synchronizing CUDA operation"  # in torch's warnings
_failed: list[torch.cuda.CUDAGraph] = []  # torch's allocator goes on asking graphs whose capture has failed

Function = Callable[..., dict[str, Tensor]]


class CaptureError(RuntimeError):
    """A function cannot be recorded; its cause tells what it did."""


class Packed:
    """Tensors of fixed shapes and types, in one piece of memory for each type, which one copy takes as a whole."""

    def __init__(self, parts: dict[str, Tensor]) -> None:
        """Make room for tensors like the given ones, on their device."""
        self._places: dict[str, tuple[torch.dtype, torch.Size, tuple[int, ...], int]] = {}
        sizes: dict[torch.dtype, int] = {}
        for name, part in parts.items():
            strides = tuple(part.shape[axis + 1 :].numel() for axis in range(part.dim()))
            start = sizes.get(part.dtype, 0)
            self._places[name] = (part.dtype, part.shape, strides, start)
            sizes[part.dtype] = start + -(-part.numel() // _ALIGNMENT) * _ALIGNMENT
        device = next(iter(parts.values())).device
        with torch.inference_mode(False):  # may be made there and written elsewhere
            self._memory = {dtype: torch.zeros(size, dtype=dtype, device=device) for dtype, size in sizes.items()}
            self._parts = self._views(self._memory)

    def _views(self, memory: dict[torch.dtype, Tensor]) -> dict[str, Tensor]:
        return {
            name: memory[dtype].as_strided(shape, strides, start)
            for name, (dtype, shape, strides, start) in self._places.items()
        }

    def write(self, parts: dict[str, Tensor]) -> None:
        """Overwrite all tensors, with one launch for those of a type."""
        for dtype in self._memory:
            names = [name for name, place in self._places.items() if place[0] == dtype]
            torch._foreach_copy_([self._parts[name] for name in names], [parts[name] for name in names])

    def copy(self) -> dict[str, Tensor]:
        """The tensors as they are now; those of a type share new memory."""
        return self._views({dtype: memory.clone() for dtype, memory in self._memory.items()})


class Capture:
    """A function's calls: the first runs it, which compiles and loads kernels; from the second on a graph is replayed.

    The function must do the same work each time: neither read the device back nor branch on data, and what it reads or
    changes besides its arguments must stay the same tensors. ``forget`` tells that they no longer are.

    A capture that fails leaves CUDA and torch in disorder. So the first call is watched, and the function is recorded
    after a call that has not waited for the device; a first call that has may have made constants, and gets a second
    chance.

    Args:
        device: Of the tensors; only CUDA devices record.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.forget()

    def forget(self) -> None:
        """Drop the recording."""
        self._arguments: tuple[Tensor, ...] = ()
        self._results: Packed | None = None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._kernels: list[object] = []
        self._rehearsals = 0
        self._waits: list[str] = []  # places where the last rehearsal waited for the device

    @property
    def is_recorded(self) -> bool:
        """Whether calls replay a graph."""
        return self._graph is not None

    def __call__(self, function: Function, *arguments: Tensor) -> dict[str, Tensor]:
        """What the function returns for these arguments, which have the shapes and types of the first call's.

        Raises:
            CaptureError: If the function cannot be recorded. It has then not been run.
            ValueError: If an argument has another shape than in the first call.
        """
        # Recording a graph, and watching for waits, is seen by all threads of the process.
        with torch.no_grad(), alone if self.device.type == "cuda" else nullcontext():
            if not self._arguments:
                self._arguments = tuple(_room_like(argument) for argument in arguments)
            for own, given in zip(self._arguments, arguments, strict=True):
                if own.shape != given.shape:
                    shapes = f"{tuple(own.shape)}, got {tuple(given.shape)}"
                    raise ValueError(f"{function.__qualname__}: an argument must have shape {shapes}")
                own.copy_(given)
            if self._results is None or self._waits or self.device.type != "cuda":
                results = self._rehearse(function)
                self._results = self._results or Packed(results)
                self._results.write(results)
                return self._results.copy()
            if self._graph is None:
                self._graph = self._record(function, self._results)
            with interop.on_torch_stream(str(self.device)):  # replays follow what Warp was told before
                self._graph.replay()
            return self._results.copy()

    def _rehearse(self, function: Function) -> dict[str, Tensor]:
        if self.device.type != "cuda":
            return function(*self._arguments)
        if self._rehearsals == _REHEARSALS:
            places = ", ".join(dict.fromkeys(self._waits))
            raise CaptureError(f"{function.__qualname__} cannot be recorded as a CUDA graph: it waits at {places}")
        with waits_for_device() as self._waits:
            results = function(*self._arguments)
        self._rehearsals += 1
        return results

    def _record(self, function: Function, results: Packed) -> torch.cuda.CUDAGraph:
        graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream(self.device)
        joined = interop.JoinedCapture(stream)
        try:
            with (
                interop.uncollected(),
                torch.cuda.device(self.device),
                torch.cuda.graph(graph, stream=stream, capture_error_mode=_MODE),
                joined,
            ):
                results.write(function(*self._arguments))
        except RuntimeError as error:
            _failed.append(graph)
            _free_generator(self.device, stream)
            cause = _first(error)  # ending a capture that has failed fails as well
            raise CaptureError(f"{function.__qualname__} cannot be recorded as a CUDA graph: {cause}") from error
        self._kernels = joined.kernels
        return graph


@contextmanager
def waits_for_device() -> Iterator[list[str]]:
    """Places, as ``file:line``, where this thread waits for a CUDA device meanwhile, as far as torch notices it.

    The list stays empty where torch has been told to warn of waits or to refuse them.
    """
    places: list[str] = []
    if torch.cuda.get_sync_debug_mode():
        yield places
        return
    thread, show = threading.get_ident(), warnings.showwarning

    def note(message: Any, category: Any, filename: str, lineno: int, file: Any = None, line: Any = None) -> None:
        if _WAIT not in str(message):
            show(message, category, filename, lineno, file, line)
        elif threading.get_ident() == thread:
            places.append(f"{filename}:{lineno}")

    with warnings.catch_warnings():
        warnings.filterwarnings("always", message=f".*{_WAIT}")
        warnings.showwarning = note
        torch.cuda.set_sync_debug_mode("warn")
        try:
            yield places
        finally:
            torch.cuda.set_sync_debug_mode("default")


def _free_generator(device: torch.device, stream: torch.cuda.Stream) -> None:
    """Let torch draw random numbers again after a capture that failed: its generator awaits the end of one."""
    with torch.cuda.device(device), torch.cuda.graph(torch.cuda.CUDAGraph(), stream=stream, capture_error_mode=_MODE):
        torch.zeros(1, device=device)


def _room_like(tensor: Tensor) -> Tensor:
    with torch.inference_mode(False):
        return torch.zeros(tensor.shape, dtype=tensor.dtype, device=tensor.device)


def _first(error: BaseException) -> BaseException:
    """The error in whose wake this one was raised."""
    while error.__context__ is not None:
        error = error.__context__
    return error


class Captures:
    """The captured calls of an environment.

    Args:
        owner: Of whom messages speak.
        device: Of the environment.
        wanted: Whether calls are captured; None captures on CUDA, and goes without where something cannot be recorded.

    Attributes:
        are_on: Whether calls are captured.

    Raises:
        ValueError: If captures are wanted on a device that has none.
    """

    def __init__(self, owner: str, device: torch.device | None, wanted: bool | None) -> None:
        self._device = device or torch.device("cpu")
        can_record = self._device.type == "cuda"
        if wanted and not can_record:
            raise ValueError(
                f"{owner}: capture=True needs a CUDA device, this environment is on {self._device}; capture=None "
                "captures wherever that is possible"
            )
        self.are_on = can_record if wanted is None else wanted
        self._owner, self._is_strict = owner, bool(wanted)
        self._captures: WeakKeyDictionary[object, dict[str, Capture]] = WeakKeyDictionary()  # by whose method it is
        self._given: Any = None

    @property
    def recorded(self) -> list[str]:
        """Names of the functions that are replayed as graphs."""
        return [name for own in self._captures.values() for name, capture in own.items() if capture.is_recorded]

    def run(self, function: Function, *arguments: Tensor, given: Any) -> dict[str, Tensor]:
        """What the function returns for these arguments, in tensors of its own.

        Args:
            function: A method, told apart from others by its object and its name; what is recorded for an object goes
                with it.
            arguments: Of one shape and type for all calls.
            given: Values that a recording would not notice to have changed; when they have, all are made anew.

        Raises:
            CaptureError: If the function cannot be recorded and captures were explicitly wanted.
        """
        if given != self._given:
            self._captures.clear()
            self._given = given
        own = self._captures.setdefault(getattr(function, "__self__", self), {})
        capture = own.setdefault(function.__name__, Capture(self._device))
        try:
            return capture(function, *arguments)
        except CaptureError as error:
            if self._is_strict:
                raise
            self.are_on = False
            warnings.warn(f"{self._owner}: steps are launched part by part from now on; {error}", stacklevel=2)
            return {key: value.clone() for key, value in function(*arguments).items()}
