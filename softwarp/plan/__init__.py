"""From a scene to the arrays of a model, on the host."""
