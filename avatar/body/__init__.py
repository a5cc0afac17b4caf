"""Posable bodies behind one interface."""

from avatar.body.registry import BodyConfig, canonical_pose, load_body

__all__ = ["BodyConfig", "canonical_pose", "load_body"]
