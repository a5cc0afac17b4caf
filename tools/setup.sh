#!/bin/sh
# Sets up a local .venv and the system libraries that open3d and the pictures need. Usage: tools/setup.sh demo|test
set -eu
cd "$(dirname "$0")/.."
goal=${1:-demo}
python=${PYTHON:-python3}
packages="libusb-1.0-0 libgl1 libegl1 libx11-6 libudev1 libidn2-0 libgomp1 libxrender1"
[ "$goal" = test ] && packages="$packages chromium fonts-dejavu-core"

has_library() { ldconfig -p 2>/dev/null | grep -q "$1"; }
missing=""
for library in libusb-1.0 libGL.so.1 libEGL.so.1 libX11.so.6 libudev.so.1 libidn2.so.0 libgomp.so.1 libXrender.so.1; do
    has_library "$library" || missing="$missing $library"
done
[ "$goal" = test ] && ! command -v chromium >/dev/null && missing="$missing chromium"
"$python" -c "import venv, ensurepip" 2>/dev/null || { missing="$missing python3-venv"; packages="$packages python3-venv"; }
if [ -n "$missing" ]; then
    if command -v apt-get >/dev/null && [ "$(id -u)" = 0 ]; then
        echo "setup: installing system libraries (missing:$missing)"
        apt-get update -qq
        # shellcheck disable=SC2086
        DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $packages >/dev/null
    else
        echo "setup: missing$missing. As root, run: apt-get install -y $packages" >&2
        echo "setup: (on other systems, the packages that hold these libraries)" >&2
        exit 1
    fi
fi

"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "setup: Python 3.11 or newer is needed" >&2; exit 1; }
stamp=".venv/.set-up-$goal"
if [ ! -f "$stamp" ] || [ setup.cfg -nt "$stamp" ] || [ constraints.txt -nt "$stamp" ]; then
    [ -x .venv/bin/python ] || "$python" -m venv .venv
    extras="mesh,pictures,export,log"
    [ "$goal" = test ] && extras="$extras,simulate,anny,test"
    echo "setup: installing Python packages into .venv (a few minutes the first time)"
    .venv/bin/python -m pip install --quiet --constraint constraints.txt torch==2.13.0
    .venv/bin/python -m pip install --quiet --constraint constraints.txt --editable ".[$extras]"
    touch "$stamp"
fi
echo "setup: done. In every new shell run: . .venv/bin/activate"
