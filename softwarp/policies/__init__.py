"""Policies: networks built from an environment's specs, observation scaling and scripted baselines."""
