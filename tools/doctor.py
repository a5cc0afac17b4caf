"""Lists what is installed, what is missing and the command that installs it: python tools/doctor.py"""

from start import run

if __name__ == "__main__":
    run("doctor")
