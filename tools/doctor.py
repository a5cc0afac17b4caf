"""Tells what is installed, what is missing, and the line that mends it; exits with 1 when a needed thing lacks."""

import sys

from avatar.environment import accelerator, inspect_machine

if __name__ == "__main__":
    findings = inspect_machine()
    for finding in findings:
        mark = "ok " if finding.present else ("MISSING" if finding.needed else "absent ")
        print(f"{mark:8}{finding.name:42}{finding.seen}" + ("" if finding.present else f"\n{'':8}-> {finding.mend}"))
    lacking = [finding.name for finding in findings if finding.needed and not finding.present]
    if not lacking:
        print(f"training would run on: {accelerator()}")
    sys.exit(bool(lacking))
