"""Carries an outfit's scans to the T-pose and learns their skinning: python tools/canonicalize.py outfit=dress"""

from avatar.config import command
from avatar.pipeline.canonicalization import canonicalize

if __name__ == "__main__":
    command("canonicalize", canonicalize)
