"""Posable bodies behind one interface."""
