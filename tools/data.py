"""Other people's data: says what is there, measures it, converts it, fits bodies to it.

python tools/data.py info source=scans
python tools/data.py check source=scans
python tools/data.py convert source=scans dataset=mine name=coat
python tools/data.py fit source=scans dataset=mine name=coat
"""

from start import run

if __name__ == "__main__":
    run("data")
