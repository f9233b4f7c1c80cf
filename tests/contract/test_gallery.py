import sys

import numpy as np
import pytest
from PIL import Image
from pxr import Usd, UsdValidation

from experiments import gallery


@pytest.mark.slow
@pytest.mark.parametrize("name", gallery.SCENES)
def test_scene_is_simulated_drawn_and_exported(name, tmp_path, monkeypatch):
    """A picture with something in its middle and a stage that every validator passes."""
    monkeypatch.setattr(sys, "argv", ["gallery", str(tmp_path), "--only", name, "--width", "120"])
    gallery.main()
    picture = np.asarray(Image.open(tmp_path / f"{name}.png"))
    assert picture.shape == (90, 120, 3)
    assert np.ptp(picture[20:70, 30:90].astype(int), axis=(0, 1)).min() > 80
    stage = Usd.Stage.Open(str(tmp_path / f"{name}.usdc"))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetErrorAsString() for error in found] == []
    assert stage.GetEndTimeCode() >= gallery.FRAMES
