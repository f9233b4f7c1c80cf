"""One file that acts: a policy's networks with the scaling of observations and actions inside, for ONNX or Torch.

Inputs   observation (batch, k) float32, as the environment gives it: one flat vector, in the environment's order
         memory (batch, 2 * units) float32, of recurrent policies: zeros at the start of an episode, else ``memory_out``
Outputs  action (batch, a) float32, within its limits; of choices (batch,) int64; the most likely one
         memory_out, of recurrent policies
About    JSON under ``softwarp`` in an ONNX file's metadata and in ``softwarp.json`` of a .pt2: names, sizes and ranges
         of inputs and outputs, the environment's name and options, the control period [s]

Only the weights and operations of the most likely action are exported; a policy that draws actions needs softwarp.
"""

from __future__ import annotations

import json
import warnings
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from softwarp import checks
from softwarp.deploy.policy import LoadedPolicy
from softwarp.envs import registry
from softwarp.io.atomic import atomic_path
from softwarp.io.bounded import parse_json
from softwarp.policies.policy import Policy, Spaces

FORMAT = "softwarp exported policy 1"
ENDINGS = (".onnx", ".pt2")
ABOUT = "softwarp"  # key of the metadata
TOLERANCE = 1.0e-4  # of an exported action, as part of half its range
TIES = 2.0e-3  # part of the choices that may differ: two that are as good as equal
NEEDS_ONNX = "ONNX files need the extra onnx: pip install 'softwarp[onnx]'"
_OPSET = 18


class Acting(nn.Module):
    """The most likely action by plain operations; observations and actions in the environment's units."""

    mean: Tensor
    std: Tensor

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy = policy
        self.clip = policy.observation_norm.clip
        self.register_buffer("mean", policy.observation_norm.mean.float())
        self.register_buffer("std", policy.observation_norm.std)

    def forward(self, observation: Tensor, memory: Tensor | None = None) -> Tensor | tuple[Tensor, Tensor]:
        """Action, and the memory to go on with if there is one."""
        scaled = ((observation - self.mean) / self.std).clamp(-self.clip, self.clip)
        if self.policy.memory is None:
            return self.policy.to_env(self.policy.greedy(scaled))
        output, memory = self.policy.memory(scaled, memory)
        return self.policy.to_env(self.policy.greedy(torch.cat((scaled, output), dim=-1))), memory


def export(policy: LoadedPolicy, path: str | Path) -> float:
    """Write a policy to one file and compare that file with the policy.

    Args:
        policy: From ``load_policy``.
        path: Ends in ``.onnx`` or ``.pt2``.

    Returns:
        Largest difference of an action on random observations, in actions' units; of choices, the part that differs.

    Raises:
        ImportError: If ONNX is not installed.
        ValueError: If the ending is another, or the file acts differently; it is not kept then.
        WriteError: If it cannot be written.
    """
    path = Path(path)
    checks.choice(path.suffix, "export: ending of the file", ENDINGS)
    about = describe(policy)
    device = policy.network.low.device
    acting = Acting(policy.network.cpu()).eval()
    try:
        program = _program(acting, policy)
        with atomic_path(path) as scratch:
            if path.suffix == ".onnx":
                _write_onnx(program, scratch, about)
            else:
                torch.export.save(program, scratch, extra_files={f"{ABOUT}.json": json.dumps(about)})
            difference = compare(policy, _read(scratch, path.suffix))
            if not difference <= _allowed(policy.spaces):
                raise ValueError(f"{path}: its actions differ from the policy's by {difference:.3g}; it is not kept")
    finally:
        policy.network.to(device)
    return difference


def _allowed(spaces: Spaces) -> float:
    """Largest difference that rounding may make."""
    if spaces.is_discrete:
        return TIES
    return TOLERANCE * max(0.5 * (high - low) for low, high in zip(spaces.low, spaces.high, strict=True))


def describe(policy: LoadedPolicy) -> dict[str, Any]:
    """What a user of the file must know: JSON's types alone."""
    spaces, units = policy.spaces, policy.network.config.recurrent
    told: dict[str, Any] = {"format": FORMAT, "env": policy.env, "trained_steps": policy.steps}
    observation: dict[str, Any] = {"name": "observation", "size": spaces.observation_size}
    if policy.env.get("name") in registry.names():
        env = registry.make(**(policy.env | {"settle": False}))
        low, high = env.observation_bounds()["observation"]
        observation |= {"low": low.tolist(), "high": high.tolist()}
        layout: dict[str, slice] = getattr(env, "observation_layout", {})
        observation["parts"] = {name: list(range(*part.indices(len(low)))) for name, part in layout.items()}
        told["control_period"] = env.control_dt
    action: dict[str, Any] = {
        "name": "action",
        "size": spaces.action_size,
        "is_discrete": spaces.is_discrete,
        "is_one_hot": spaces.is_one_hot,
    }
    if not spaces.is_discrete:
        action |= {"low": list(spaces.low), "high": list(spaces.high)}
    return told | {"observation": observation, "action": action, "memory": 2 * units}


def _program(acting: Acting, policy: LoadedPolicy) -> torch.export.ExportedProgram:
    """The traced module, any number of rows."""
    rows = torch.export.Dim("batch", min=1, max=2**16)
    given = [torch.zeros(2, policy.spaces.observation_size)]
    if policy.is_recurrent:
        given.append(policy.network.start(2).cpu())
    shapes = tuple({0: rows} for _ in given)
    with torch.no_grad():
        return torch.export.export(acting, tuple(given), dynamic_shapes=shapes)


def _write_onnx(program: torch.export.ExportedProgram, path: Path, about: dict[str, Any]) -> None:
    try:
        import onnx
        import onnxruntime  # noqa: F401 - by which the file is checked
        import onnxscript  # noqa: F401 - by which Torch writes
    except ImportError as error:
        raise ImportError(NEEDS_ONNX) from error
    count = 2 if about["memory"] else 1
    inputs, outputs = ["observation", "memory"][:count], ["action", "memory_out"][:count]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Torch's exporter, about itself
        made = torch.onnx.export(
            program, input_names=inputs, output_names=outputs, opset_version=_OPSET, verbose=False, dynamo=True
        )
    assert made is not None
    model = made.model_proto
    onnx.helper.set_model_props(model, {ABOUT: json.dumps(about)})
    path.write_bytes(model.SerializeToString())


class ExportedPolicy(ABC):
    """An exported file as a function of an observation, called as ``LoadedPolicy`` with arrays is.

    Attributes:
        about: What the file tells of itself.
    """

    def __init__(self, about: dict[str, Any]) -> None:
        self.about = about
        self._memory: NDArray[np.float32] | None = None

    def reset(self) -> None:
        """Forget what was shown."""
        self._memory = None

    def __call__(self, observation: Any) -> NDArray[Any]:
        """The action (a,) for an observation (k,), or of a batch."""
        told = np.asarray(observation, dtype=np.float32)
        size = self.about["observation"]["size"]
        if told.ndim not in (1, 2) or told.shape[-1] != size:
            raise ValueError(checks.refusal("policy: observation", f"have shape ({size},) or (n, {size})", told.shape))
        rows = {"observation": told.reshape(-1, size)}
        if self.about["memory"]:
            if self._memory is None:
                self._memory = np.zeros((len(rows["observation"]), self.about["memory"]), dtype=np.float32)
            rows["memory"] = self._memory
        action, *rest = self.run(rows)
        self._memory = rest[0] if rest else None
        return action if told.ndim > 1 else action[0]

    @abstractmethod
    def run(self, rows: dict[str, NDArray[np.float32]]) -> list[NDArray[Any]]:
        """Outputs for inputs, both of whole batches."""


class OnnxPolicy(ExportedPolicy):
    """An ONNX file, which needs ONNX Runtime but neither Torch nor a simulator."""

    def __init__(self, path: Path) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise ImportError(NEEDS_ONNX) from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # small networks: threads would cost more than they bring
        self.session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        super().__init__(_about(self.session.get_modelmeta().custom_metadata_map.get(ABOUT, ""), path))

    def run(self, rows: dict[str, NDArray[np.float32]]) -> list[NDArray[Any]]:
        """Outputs for inputs."""
        return list(self.session.run(None, rows))


class TorchPolicy(ExportedPolicy):
    """A file of ``torch.export``. Unlike an ONNX file it is no mere data: open those alone whose makers you trust."""

    def __init__(self, path: Path) -> None:
        told = {f"{ABOUT}.json": ""}
        self.module = torch.export.load(path, extra_files=told).module()
        super().__init__(_about(told[f"{ABOUT}.json"], path))

    def run(self, rows: dict[str, NDArray[np.float32]]) -> list[NDArray[Any]]:
        """Outputs for inputs."""
        with torch.no_grad():
            told = self.module(*(torch.from_numpy(rows[name]) for name in ("observation", "memory") if name in rows))
        return [part.numpy() for part in (told if isinstance(told, tuple) else (told,))]


def load_exported(path: str | Path) -> ExportedPolicy:
    """An exported policy.

    Raises:
        ImportError: If ONNX Runtime is not installed.
        ValueError: If the file is none of ``export``.
    """
    path = Path(path)
    checks.choice(path.suffix, "exported policy: ending of the file", ENDINGS)
    if not path.is_file():
        raise ValueError(f"exported policy {path}: no such file; softwarp policy export writes one")
    return _read(path, path.suffix)


def _read(path: Path, ending: str) -> ExportedPolicy:
    return OnnxPolicy(path) if ending == ".onnx" else TorchPolicy(path)


def _about(text: str, path: Path) -> dict[str, Any]:
    try:
        about = parse_json(text)
    except ValueError:
        about = None
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise ValueError(f"exported policy {path}: not written by softwarp policy export")
    return about


def compare(policy: LoadedPolicy, exported: ExportedPolicy, *, rows: int = 256, steps: int = 4) -> float:
    """Largest difference of actions on random observations that spread wider than those of training.

    Of choices it is the part of the rows in which they differ.
    """
    generator = torch.Generator().manual_seed(0)
    norm = policy.network.observation_norm
    acting = LoadedPolicy(policy.network, policy.env)
    exported.reset()
    largest = 0.0
    for _ in range(steps):
        noise = torch.randn((rows, policy.spaces.observation_size), generator=generator)
        observation = (norm.mean.float().cpu() + 2.0 * norm.std.cpu() * noise).numpy()
        ours, theirs = acting(observation), exported(observation)
        if policy.spaces.is_discrete:
            largest = max(largest, float((ours != theirs).reshape(rows, -1).any(axis=-1).mean()))
        else:
            largest = max(largest, float(np.abs(ours - theirs).max()))
    exported.reset()
    return largest
