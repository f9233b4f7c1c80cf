"""Curves of a run sent to Weights & Biases or MLflow by TorchRL's loggers, beside our own tables.

Training does not depend on a service: what it refuses is warned of once, and the run goes on.
"""

import importlib.util
import json
import os
import uuid
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl.record.loggers import Logger, MLFlowLogger, get_logger

from softwarp.io.atomic import write_text
from softwarp.io.bounded import DamagedFileError, parse_json

SERVICES = ("wandb", "mlflow")
_KEPT = "logger.json"  # file of a run folder that says which run of the service it is


class ServiceLog:
    """A run of a logging service.

    Args:
        kind: One of SERVICES.
        folder: Run folder; its name is that of the run.
        project: Where the service files the run.
        offline: Keep everything in the run folder: Weights & Biases for ``wandb sync``, MLflow in a database there.
        settings: Resolved configuration of the run, sent along.
        is_resumed: Whether the run goes on; with Weights & Biases it is then the same run there.

    Raises:
        ImportError: If the service's package is not installed.
    """

    def __init__(
        self, kind: str, folder: Path, *, project: str, offline: bool, settings: Mapping[str, Any], is_resumed: bool
    ) -> None:
        if importlib.util.find_spec(kind) is None:
            raise ImportError(f"logger.kind={kind} needs the extra: pip install 'softwarp[{kind}]'")
        self.kind = kind
        self._is_down = False
        make = self._wandb if kind == "wandb" else self._mlflow
        self.logger: Logger = make(folder, project, offline, is_resumed)
        self._send("settings", self.logger.log_hparams, dict(settings))

    def add(self, curves: Mapping[str, float], step: int) -> None:
        """Add a point to each of the curves."""
        self._send("a row", self.logger.log_metrics, dict(curves), step)

    def close(self) -> None:
        """End the run."""
        if self.kind == "wandb":
            self._send("the end of the run", self.logger.experiment.finish)
        else:
            import mlflow

            self._send("the end of the run", mlflow.end_run)

    def _wandb(self, folder: Path, project: str, offline: bool, is_resumed: bool) -> Logger:
        mode = {"mode": "offline", "offline": True} if offline else {}
        own = {"id": _identity(folder, is_resumed), "project": project, "log_env_packages": False, **mode}
        return get_logger("wandb", str(folder), folder.resolve().name, wandb_kwargs=own)

    def _mlflow(self, folder: Path, project: str, offline: bool, is_resumed: bool) -> Logger:
        database = f"sqlite:///{folder.resolve() / 'mlflow.db'}"
        place = database if offline else os.environ.get("MLFLOW_TRACKING_URI", database)
        logger = MLFlowLogger(exp_name=project, tracking_uri=place, tags={"run": folder.resolve().name})
        return logger

    def _send(self, what: str, call: Any, *given: Any) -> None:
        try:
            call(*given)
        except Exception as error:  # noqa: BLE001 - a service raises what it likes, and a run is worth more than its curves
            if not self._is_down:
                warnings.warn(f"{self.kind} did not take {what} ({error}); the tables have it", stacklevel=2)
            self._is_down = True


def _identity(folder: Path, is_resumed: bool) -> str:
    """Identifier of the run at the service: kept in its folder, so that a resumed run is the same one."""
    path = folder / _KEPT
    if is_resumed and path.is_file():
        try:
            return str(parse_json(path.read_bytes())["id"])
        except (DamagedFileError, KeyError, TypeError):
            warnings.warn(f"{path} is damaged; the run is a new one at the service", stacklevel=2)
    found = uuid.uuid4().hex[:12]
    write_text(path, json.dumps({"id": found}) + "\n")
    return found
