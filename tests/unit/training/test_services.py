"""Weights & Biases and MLflow beside the tables: what is sent, resumed runs, services that fail or are missing."""

import importlib.util
import os
from typing import ClassVar

import pytest

from softwarp.training import services
from softwarp.training.logs import LoggerConfig, RunLog, read_csv
from softwarp.training.services import ServiceLog


class FakeLogger:
    """Remembers what it was sent; fails where it is told to."""

    made: ClassVar[list["FakeLogger"]] = []

    def __init__(self, *place, wandb_kwargs):
        self.place, self.options, self.sent = place, wandb_kwargs, []
        self.experiment = self
        self.is_down = False
        FakeLogger.made.append(self)

    def log_hparams(self, settings):
        self.sent.append(settings)

    def log_metrics(self, curves, step):
        if self.is_down:
            raise ConnectionError("no route")
        self.sent.append((step, curves))

    def finish(self):
        self.sent.append("end")


@pytest.fixture
def fake(monkeypatch):
    """Weights & Biases without Weights & Biases."""
    monkeypatch.setattr(services.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(services, "get_logger", FakeLogger)
    monkeypatch.setattr(FakeLogger, "made", [])
    return FakeLogger.made


def test_rows_go_to_the_tables_and_to_the_service(fake, tmp_path):
    config = LoggerConfig(tensorboard=False, kind="wandb", project="arms", offline=True)
    for resume in (None, 1):
        log = RunLog(tmp_path, config, ["loss_critic"], resume_update=resume, settings={"seed": 4})
        log.add("progress", {"update": 1 if resume is None else 2, "return": 2.5, "loss_critic": 0.5})
        log.close()
    first, second = fake
    assert first.place == ("wandb", str(tmp_path), tmp_path.name)
    assert first.options["project"] == "arms" and first.options["mode"] == "offline"
    assert first.sent == [{"seed": 4}, (1, {"progress/return": 2.5, "progress/loss_critic": 0.5}), "end"]
    assert second.options["id"] == first.options["id"] and second.sent[1][0] == 2
    assert [row["update"] for row in read_csv(tmp_path / "progress.csv")] == [1, 2]


def test_a_service_that_fails_does_not_end_a_run(fake, tmp_path):
    """It is warned of once; the tables have every row."""
    log = RunLog(tmp_path, LoggerConfig(tensorboard=False, kind="wandb"), [])
    fake[0].is_down = True
    with pytest.warns(UserWarning, match=r"wandb did not take a row \(no route\); the tables have it") as told:
        for update in (1, 2, 3):
            log.add("progress", {"update": update, "return": 0.0})
        log.close()
    assert len(told) == 1 and len(read_csv(tmp_path / "progress.csv")) == 3


def test_missing_packages_and_wrong_kinds_are_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(services.importlib.util, "find_spec", lambda name: None)
    for kind in services.SERVICES:
        with pytest.raises(ImportError, match=rf"logger.kind={kind} needs the extra.*softwarp\[{kind}\]"):
            RunLog(tmp_path, LoggerConfig(kind=kind), [])
    with pytest.raises(ValueError, match=r"logger.kind must be one of csv, tensorboard, wandb, mlflow"):
        LoggerConfig(kind="wanbd")


def test_kind_tensorboard_writes_curves(tmp_path):
    log = RunLog(tmp_path, LoggerConfig(tensorboard=False, kind="tensorboard"), [])
    log.add("progress", {"update": 1, "return": 2.0})
    log.close()
    assert list((tmp_path / "tensorboard").iterdir()) and (tmp_path / "progress.csv").exists()


@pytest.mark.slow
@pytest.mark.parametrize("kind", services.SERVICES)
def test_real_services_take_it(kind, tmp_path, monkeypatch):
    """Where they are installed, without a network."""
    pytest.importorskip(kind)
    monkeypatch.setenv("WANDB_SILENT", "true")
    if kind == "mlflow" and importlib.util.find_spec("sqlalchemy") is None:  # mlflow-skinny
        monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
        monkeypatch.setenv("MLFLOW_TRACKING_URI", (tmp_path / "store").as_uri())
    offline = "MLFLOW_TRACKING_URI" not in os.environ
    given = {"project": "softwarp", "offline": offline, "settings": {"env": {"name": "CartPole"}, "seed": 1}}
    for resumed in (False, True):
        log = ServiceLog(kind, tmp_path, is_resumed=resumed, **given)
        log.add({"progress/return": 2.0}, 1 + resumed)
        log.close()
        assert not log._is_down
    assert list(tmp_path.glob("wandb/offline-run-*" if kind == "wandb" else "**/*"))
