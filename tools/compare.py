"""Makes one table of many runs' scores: python tools/compare.py dataset=sample 'methods=[static,closet]'"""

from start import run

if __name__ == "__main__":
    run("compare")
