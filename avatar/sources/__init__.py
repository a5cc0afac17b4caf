"""Data sets and scans as other programs leave them: their layouts, and their conversion to outfits of this project."""
