"""Options of every environment: lists become tuples, and what is no number or too long is refused by name."""

import dataclasses
import math

import numpy as np
import pytest

from softwarp.envs import registry

DEFAULTS = {name: registry.spec(name).config_class()() for name in registry.names()}
FIELDS = {name: [entry for entry in dataclasses.fields(config) if entry.init] for name, config in DEFAULTS.items()}


def options_of(name, kind):
    """Options of an environment whose default is of a type, with it."""
    return [(key, value) for key, value in vars(DEFAULTS[name]).items() if type(value) is kind]


def is_refused(name, key, value, message):
    """The option takes no such value, and says why."""
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(DEFAULTS[name], **{key: value})
        pytest.fail(f"{name} takes {key}={value}")


@pytest.mark.parametrize("name", DEFAULTS)
def test_nan_is_refused(name):
    """A start, a limit or a reward that is nan would spoil worlds one by one instead."""
    floats = options_of(name, float)
    assert floats
    for key, _ in floats:
        is_refused(name, key, math.nan, rf"\b{key}\b.*nan")


@pytest.mark.parametrize("name", [name for name in DEFAULTS if options_of(name, tuple)])
def test_tuples_have_their_length(name):
    """As tuple or list, of the declared number of values, each a number."""
    for key, value in options_of(name, tuple):
        if key in ("start_displacement", "sensors"):
            continue
        assert getattr(dataclasses.replace(DEFAULTS[name], **{key: list(value)}), key) == value
        for wrong in (value[:-1], (*value, 1.0), list(value[:-1])):
            is_refused(name, key, wrong, rf"{key} must have {len(value)} values, got")
        is_refused(name, key, (*value[:-1], math.nan), rf"{key}\[\d\] must lie in .*, got nan")


@pytest.mark.parametrize("name", DEFAULTS)
def test_numbers_become_those_that_are_declared(name):
    """Integers and NumPy's scalars where floats are, also in tuples and lists: tensors of them are no integers then."""

    def same_but(value, kind):
        if type(value) in (tuple, list):
            return type(value)(same_but(entry, kind) for entry in value)
        return kind(value) if type(value) is float and value == int(min(max(value, -1e6), 1e6)) else value

    def kinds(value):
        return [kind for entry in value for kind in kinds(entry)] if type(value) in (tuple, list) else [type(value)]

    for kind in (int, np.int64, np.float32):
        whole = {entry.name: same_but(getattr(DEFAULTS[name], entry.name), kind) for entry in FIELDS[name]}
        config = dataclasses.replace(DEFAULTS[name], **whole)
        assert config == DEFAULTS[name]
        for key in whole:
            assert kinds(getattr(config, key)) == kinds(getattr(DEFAULTS[name], key)), (kind, key)


def test_tuples_of_any_length_are_left_to_their_environment():
    """Diamond's start has one length per cable, and says so itself."""
    with pytest.raises(ValueError, match="start_displacement must hold 4 lengths in metres"):
        dataclasses.replace(DEFAULTS["Diamond"], start_displacement=(0.0, 0.0))


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [("success_tolerance", -1.0, "must lie in .*, got -1.0"), ("goal_depth", -0.1, "must lie in .*, got -0.1")],
)
def test_goals_that_nobody_can_reach_are_refused(key, value, message):
    """CartStemContact."""
    with pytest.raises(ValueError, match=f"{key} {message}"):
        dataclasses.replace(DEFAULTS["CartStemContact"], **{key: value})
