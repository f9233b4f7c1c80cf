"""Files: meshes, trajectories and scenes, each format in its own module."""
