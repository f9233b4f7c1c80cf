"""Studies and verbs of the ``softwarp`` command: one flat script each; ``config`` composes their settings."""
