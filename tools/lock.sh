#!/bin/bash
# Write constraints.txt from what .venv holds now. After a look at the outcome of `make test`:
#   make dev && .venv/bin/pip install -U --upgrade-strategy eager -e '.[dashboard,logs,plot,magnetic,test,dev]' && tools/lock.sh
set -eu
cd "$(dirname "$0")/.."
pins=$(.venv/bin/pip freeze --exclude-editable | grep -v ' @ ') # a package from a local file has no version to pin
{
  echo "# Versions that the tests passed with, for every extra (tools/lock.sh). Made with Python 3.11; all are said to run on"
  echo "# 3.12 and 3.13 as well. A pin without a wheel for your Python: install without -c and tell us."
  echo "$pins"
} >constraints.txt
