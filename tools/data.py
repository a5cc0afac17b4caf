"""Other people's data: says what is there, measures it, converts it, fits bodies to it.

python tools/data.py info source=scans/coat
python tools/data.py check source=scans/coat
python tools/data.py convert source=scans/coat dataset=own name=coat
python tools/data.py fit source=scans/unfitted dataset=own name=jacket
"""

from start import run

if __name__ == "__main__":
    run("data")
