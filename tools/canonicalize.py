"""Carries an outfit's scans to the T-pose and learns their skinning: python tools/canonicalize.py outfit=dress"""

from start import run

if __name__ == "__main__":
    run("canonicalize")
