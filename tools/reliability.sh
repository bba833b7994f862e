#!/bin/bash
# Measure the rows of docs/reliability.md and write it: `make reliability`. Rows that cannot be measured here (no vcan0, no user-mode
# Linux) stop it.
set -eu
cd "$(dirname "$0")/.."
export HIL_RELIABILITY=$PWD/build/reliability
rm -rf "$HIL_RELIABILITY"
mkdir -p "$HIL_RELIABILITY"
pytest=(.venv/bin/python -m pytest -q)
"${pytest[@]}" -m "not socketcan" tests/e2e/test_reliability*.py
guest=(tools/with_vcan.sh -t 1200 --)
ip link show up vcan0 2>/dev/null | grep -q vcan0 && guest=()
"${guest[@]}" "${pytest[@]}" -m socketcan tests/e2e/test_reliability_can.py
.venv/bin/python tools/reliability.py "$HIL_RELIABILITY"
