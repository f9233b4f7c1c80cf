"""Constants of a finalized scene, the state of its worlds, and how arrays are declared."""
