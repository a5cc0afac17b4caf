"""The open trainer for point-based clothed avatars."""

__version__ = "0.1.0"
