"""Makes an outfit's clothed template from its canonical scans: python tools/template.py outfit=dress"""

from start import run

if __name__ == "__main__":
    run("template")
