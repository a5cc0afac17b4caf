"""Makes one table of many runs' scores: python tools/compare.py dataset=sample methods=[static,closet]"""

from avatar.config import command
from avatar.pipeline.comparison import compare

if __name__ == "__main__":
    command("compare", compare)
