"""Writes a run's page: python tools/report.py run=<run folder>"""

from start import run

if __name__ == "__main__":
    run("report")
