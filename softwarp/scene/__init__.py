"""What a user says of a scene: parts and materials, one file per kind, and the record of them all."""

from softwarp.model.handles import Cavity, ContactPair, Handle, Joint, RigidBody, Rod, SoftBody, Telescope

__all__ = ["Cavity", "ContactPair", "Handle", "Joint", "RigidBody", "Rod", "SoftBody", "Telescope"]
