#!/bin/bash
# The soak behind `make soak`: soak.sh [MINUTES] [ARGUMENT...] on vcan0 of this kernel, or else of a user-mode Linux kernel.
set -u
cd "$(dirname "$0")/.." || exit 1
minutes=${1:-30}
shift
soak=(.venv/bin/python tools/soak.py --minutes "$minutes" "$@")
if [[ " $* " == *" --bus "* ]] || ip link show up vcan0 2>/dev/null | grep -q vcan0; then
  exec "${soak[@]}"
fi
echo "soak: this kernel has no vcan0: it runs in user-mode Linux (make vcan installs it)" >&2
exec tools/with_vcan.sh -t $((${minutes%.*} * 120 + 1200)) -- "${soak[@]}"
