"""Zero-copy torch views of batched Warp arrays. The only core file that imports torch, and only when it is called."""

from __future__ import annotations

import gc
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING, Any

import warp as wp

from softwarp import checks
from softwarp.advice import close_to
from softwarp.model.fields import Declaration, declarations
from softwarp.model.model import Model
from softwarp.threads import alone, check_gpu

if TYPE_CHECKING:
    import torch


def view(array: wp.array, items: int, width: int) -> torch.Tensor:
    """Torch view of a batched array: (world, item), or (world, item, width) for vectors."""
    import torch

    if array.shape[1] == 0:
        dtype = {wp.float32: torch.float32, wp.float64: torch.float64, wp.int32: torch.int32}[array.dtype]
        empty = (array.shape[0], 0) if width == 1 else (array.shape[0], 0, width)
        return torch.zeros(empty, dtype=dtype, device=wp.device_to_torch(array.device))
    tensor: torch.Tensor = wp.to_torch(array, requires_grad=False)
    return tensor if width == 1 else tensor.unflatten(1, (items, width))


def views(container: Any, model: Model) -> dict[str, torch.Tensor]:
    """Views of every array of a container; quantities of a world drop their item axis."""
    return {name: _declared_view(container, model, name, each) for name, each in declarations(container).items()}


def named_view(container: Any, model: Model, name: str) -> torch.Tensor:
    """The view of one array of a container."""
    return _declared_view(container, model, name, declarations(container)[name])


def _declared_view(container: Any, model: Model, name: str, declaration: Declaration) -> torch.Tensor:
    items, width = model.items(declaration["item"]), declaration["width"]
    if declaration["item"] != "world":
        return view(getattr(container, name), items, width)
    found = view(getattr(container, name), width, 1)
    return found[:, 0] if width == 1 else found


def frame_aliases(views: dict[str, torch.Tensor], model: Model, pose: str, twist: str) -> dict[str, torch.Tensor]:
    """Poses and twists of frames as those of rigid bodies and of rod nodes, without a copy."""
    rigid = slice(model.rigid_count)
    rods = slice(model.rigid_count, model.rigid_count + model.rod_node_count)
    return {
        "body_pose": views[pose][:, rigid],
        "body_twist": views[twist][:, rigid],
        "rod_x": views[pose][:, rods, :3],
        "rod_q": views[pose][:, rods, 3:],
        "rod_v": views[twist][:, rods, :3],
        "rod_w": views[twist][:, rods, 3:],
    }


def force_aliases(views: dict[str, torch.Tensor], model: Model) -> dict[str, torch.Tensor]:
    """External wrenches on frames as those on rigid bodies and on rod nodes, without a copy."""
    rods = slice(model.rigid_count, model.rigid_count + model.rod_node_count)
    return {"body_force": views["frame_force"][:, : model.rigid_count], "rod_force": views["frame_force"][:, rods]}


class Views:
    """Named torch views; write into them with ``views.name[...] = value``.

    Aliases are further names for parts of them, left out of ``tensors``.
    """

    def __init__(
        self, owner: str, tensors: dict[str, torch.Tensor], aliases: dict[str, torch.Tensor] | None = None
    ) -> None:
        object.__setattr__(self, "_owner", owner)
        object.__setattr__(self, "_tensors", tensors)
        object.__setattr__(self, "_aliases", aliases or {})

    def __getattr__(self, name: str) -> torch.Tensor:
        tensors, aliases = self.tensors(), object.__getattribute__(self, "_aliases")
        if name in tensors:
            return tensors[name]
        if name in aliases:
            return aliases[name]  # type: ignore[no-any-return]
        names = [*tensors, *aliases]
        same = [other for other in names if other.partition("_")[0] == name.partition("_")[0]]  # of the same part
        near = [*close_to(name, same, cutoff=0.0, count=2), *close_to(name, names)] or sorted(names)
        near = list(dict.fromkeys(near))
        raise AttributeError(f"{self._owner} has no {name!r}; did you mean {', '.join(near)}?")

    def __setattr__(self, name: str, value: Any) -> None:
        aliases: dict[str, torch.Tensor] = object.__getattribute__(self, "_aliases")
        owner: str = object.__getattribute__(self, "_owner")
        refuse_assignment(owner, name, value, self.tensors(), aliases)
        if name not in self.tensors() and name not in aliases:
            self.__getattr__(name)  # raises, with the nearest names

    def __dir__(self) -> list[str]:
        return sorted({**self.tensors(), **object.__getattribute__(self, "_aliases")})

    def tensors(self) -> dict[str, torch.Tensor]:
        """All views by name."""
        tensors: dict[str, torch.Tensor] = object.__getattribute__(self, "_tensors")
        return tensors


@contextmanager
def on_torch_stream(device: str) -> Iterator[None]:
    """Launch Warp's kernels, one thread at a time; on a CUDA device on the stream that is torch's current one.

    Warp has one current stream per device for all threads, torch one for each.
    """
    with alone:
        chosen = wp.get_device(device)
        if not chosen.is_cuda:
            yield
            return
        import torch

        check_gpu(device)
        stream = torch.cuda.current_stream(wp.device_to_torch(chosen))
        if chosen.stream.cuda_stream == stream.cuda_stream:
            yield
            return
        with wp.ScopedStream(wp.stream_from_torch(stream)):
            yield


def replaying(device: str) -> AbstractContextManager[Any]:
    """Replay captured graphs: on a CPU any number of threads at once, on a CUDA device on torch's current stream."""
    return on_torch_stream(device) if wp.get_device(device).is_cuda else nullcontext()


@contextmanager
def uncollected() -> Iterator[None]:
    """Collect garbage now and none meanwhile: an earlier graph that is freed during a capture makes that fail."""
    was_on = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def copy_all(targets: Sequence[torch.Tensor], sources: Sequence[torch.Tensor]) -> None:
    """Copy tensors, all by one call of torch: one by one, short ones take longer to call for than to copy."""
    import torch

    if len(targets):
        torch._foreach_copy_(list(targets), list(sources))


@contextmanager
def single_thread(device: torch.device) -> Iterator[None]:
    """Torch works in the calling thread alone meanwhile, on a CPU.

    Its other threads go on looking for work for milliseconds after each small operation, on the cores that step worlds
    next; and where something else has a core, every operation waits for it.
    """
    import torch

    count = torch.get_num_threads()
    if count == 1 or device.type != "cpu":
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)


def records(device: str) -> bool:
    """Whether launches may be recorded and replayed: not on a CPU in Warp's debug mode, whose replays crash.

    There all is launched one by one, with the same results (Warp 1.19).
    """
    return bool(wp.get_device(device).is_cuda) or wp.config.mode != "debug"


@contextmanager
def capturing(device: str) -> Iterator[wp.ScopedCapture]:
    """Record this thread's launches as a graph; on a CUDA device on a stream that no other waits for.

    Warp's own streams wait for the default one, so that CUDA would refuse what other threads launch there meanwhile.
    """
    chosen = wp.get_device(device)
    scope: AbstractContextManager[Any] = nullcontext()
    tidy: AbstractContextManager[None] = nullcontext()
    if chosen.is_cuda:
        import torch

        scope = wp.ScopedStream(wp.stream_from_torch(torch.cuda.Stream(wp.device_to_torch(chosen))))
        tidy = uncollected()
    with alone, tidy, scope, wp.ScopedCapture(device=device) as capture:
        yield capture


def refuse_assignment(owner: str, name: str, value: Any, *groups: dict[str, torch.Tensor] | None) -> None:
    """Refuse a new tensor under the name of a view: the simulator would not see it.

    The view itself passes, as ``owner.name += change`` assigns it after writing into it.

    Raises:
        AttributeError: Naming the view and how to write into it.
    """
    for views in groups:
        if views is not None and name in views and views[name] is not value:
            raise AttributeError(f"{owner}.{name} is a view of simulator memory; write {owner}.{name}[...] = ...")


def world_index(worlds: Iterable[int] | torch.Tensor | None, count: int, device: torch.device) -> torch.Tensor:
    """World numbers as an int64 tensor on a device.

    Args:
        worlds: Numbers, or a mask of all worlds; None means all.
        count: Worlds that there are.
        device: Where the tensor is to be.

    Raises:
        ValueError: For what is neither numbers nor a mask of that length, and for worlds that do not exist.
    """
    import torch

    if worlds is None:
        return torch.arange(count, device=device)
    need = f"be numbers of worlds, or a mask of shape ({count},)"
    try:
        index = torch.as_tensor(worlds if isinstance(worlds, torch.Tensor) else list(worlds))
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise ValueError(checks.refusal("worlds", need, worlds)) from None
    if index.dtype == torch.bool and index.shape == (count,):
        index = index.nonzero().flatten()
    is_integer = not (index.is_floating_point() or index.is_complex() or index.dtype == torch.bool)
    if not is_integer and index.numel():
        raise ValueError(checks.refusal("worlds", need, worlds))
    index = index.to(device=device, dtype=torch.long).flatten()
    wrong = index[(index < 0) | (index >= count)]
    if wrong.numel():
        raise ValueError(f"world {int(wrong[0])} does not exist; this simulation has worlds 0 .. {count - 1}")
    return index


def empty_cache() -> None:
    """Give memory that torch keeps for its next tensors back to CUDA devices."""
    import torch

    if torch.cuda.is_initialized():
        torch.cuda.empty_cache()


def is_captured_by_torch(device: str) -> bool:
    """Whether what is launched now on a device goes into a graph that torch is capturing."""
    if not wp.get_device(device).is_cuda:
        return False
    import torch

    return bool(torch.cuda.is_current_stream_capturing())


class JoinedCapture:
    """Within its context, Warp's launches go into the graph that torch is capturing on a stream.

    Warp is told of the capture, so that it keeps the kernels' code loaded and frees nothing meanwhile. Its stream is
    not made to wait for the one that Warp has used before: a capture must not depend on work outside.

    Args:
        stream: Torch's; the capture must have begun when the context is entered, not when this object is made.

    Attributes:
        kernels: What has to live as long as the graph.
    """

    def __init__(self, stream: torch.cuda.Stream) -> None:
        self.kernels: list[object] = []
        self._stream = wp.stream_from_torch(stream)
        self._scope = wp.ScopedStream(self._stream, sync_enter=False)

    def __enter__(self) -> None:
        self._scope.__enter__()
        try:
            wp.capture_begin(stream=self._stream, external=True)
        except BaseException:
            self._scope.__exit__(None, None, None)
            raise

    def __exit__(self, *error: object) -> None:
        try:
            self.kernels = [wp.capture_end(stream=self._stream), self._stream]
        finally:
            self._scope.__exit__(None, None, None)


def worst_of(told: Sequence[torch.Tensor]) -> torch.Tensor:
    """The worst status code of each world over steps, int (world,) each: remarks are below OK."""
    import torch

    status = torch.stack(list(told))
    highest = status.amax(dim=0)
    return torch.where(highest > 0, highest, status.amin(dim=0))
