"""Studies and verbs of the ``softwarp`` command: one flat script each; ``config`` composes their settings."""

import warp as wp

wp.config.log_level = wp.LOG_WARNING  # not a line for every kernel module that is loaded
