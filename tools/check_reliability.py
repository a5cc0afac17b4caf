"""Runs the reliability tests and counts failures: python tools/check_reliability.py 'only=[kill,flips]'"""

from start import run

if __name__ == "__main__":
    run("check_reliability", "reliability:CHECK_RELIABILITY")
