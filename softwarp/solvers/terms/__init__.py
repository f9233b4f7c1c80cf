"""Effects that a step sums up, as peers: elements, frames, cables, chambers, joints, contact."""
