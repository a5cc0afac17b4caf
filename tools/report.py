"""Writes a run's page: python tools/report.py run=<run folder>"""

from avatar.config import command
from avatar.pipeline.reporting import report

if __name__ == "__main__":
    command("report", report)
