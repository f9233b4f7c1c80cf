"""What touches what: broad phase, narrow phases, the list of contacts."""
