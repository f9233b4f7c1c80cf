"""What a user says of a scene: parts, materials, and the builder that collects them."""
