"""What a step does besides physics: state and workspace, control of Newton's method, path following."""
