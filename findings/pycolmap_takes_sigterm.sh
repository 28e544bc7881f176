#!/usr/bin/env bash
# pycolmap 4.2.1 and pyceres 2.6: `import` puts a handler of their logging library in the place of the program's own one for SIGTERM.
# A program that had one is ended at once, with a C++ stack trace: nothing is cleaned up, closed or written. Python's
# `signal.getsignal` still returns the old handler. Registering it again after the import gives it back; Ctrl-C is not concerned.
# Guessed: a library that is imported changes no handler of signals; at most those of crashes.
# Matters here: services, containers and `timeout` end a program by SIGTERM. `vio check` stopped so left a half folder behind.
# A node that imports pycolmap late, when a map is first adjusted, loses the end of its run.
# Source: this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" pycolmap==4.2.1 pyceres==2.6 numpy==2.4.6
cat >"$folder/ended.py" <<'PYTHON'
import importlib
import os
import signal
import sys
import time
from importlib.metadata import version

package, when = sys.argv[1:]


def own_handler(number, frame):
    print(f"{package} {version(package)}, handler registered {when} the import: called", flush=True)
    sys.exit(0)


def register():
    signal.signal(signal.SIGTERM, own_handler)


if when == "before":
    register()
importlib.import_module(package)
if when == "after":
    register()
assert signal.getsignal(signal.SIGTERM) is own_handler
os.kill(os.getpid(), signal.SIGTERM)
time.sleep(5)
PYTHON
run() {
    PYTHONPATH="$folder/packages" python3 "$folder/ended.py" "$@"
}
for package in pycolmap pyceres; do
    run "$package" after | tee "$folder/out"
    grep -q called "$folder/out"
    status=0
    run "$package" before >"$folder/out" 2>"$folder/err" || status=$?
    echo "$package, handler registered before the import: not called, status $status, $(wc -l <"$folder/err") lines of a stack trace"
    [[ $status -eq 143 && ! -s $folder/out ]]
    grep -q 'stack trace' "$folder/err"
done
