#!/bin/bash
# The tests behind `make test`: test.sh [PYTEST_ARGUMENT...]
#
# Everything runs on this kernel. Where it has no vcan0 and none can be made, the tests marked `socketcan` are skipped
# there and run once more on a user-mode Linux kernel that has one (with_vcan.sh). Without arguments, tests that do not
# need the machine for themselves run first, side by side on all processors; of the others those that fail run twice.
set -u
cd "$(dirname "$0")/.." || exit 1

pytest=(.venv/bin/python -m pytest)
no_tests=5 # pytest's exit code when nothing is collected

have_vcan0() { ip link show vcan0 && ip link show up vcan0 | grep -q vcan0; } &>/dev/null
make_vcan0() {
  [ "$(id -u)" = 0 ] || return
  modprobe vcan # not needed, and not there, where vcan is built in
  ip link add vcan0 type vcan && ip link set vcan0 mtu 72 up
} &>/dev/null
have_guest() { command -v linux.uml && command -v busybox; } &>/dev/null
can_install() { [ "$(id -u)" = 0 ] && command -v apt-get; } &>/dev/null

run_here() {
  if [ $# -gt 0 ]; then
    "${pytest[@]}" "$@"
    return
  fi
  "${pytest[@]}" -n auto -m "not alone and not study"
  local side_by_side=$?
  "${pytest[@]}" -m "alone and not study"
  local alone=$?
  if [ $alone = 1 ]; then
    echo "test: those that failed run once more: they are in real time, and this machine may not have been theirs alone"
    "${pytest[@]}" -m "alone and not study" --last-failed --last-failed-no-failures none
    alone=$?
  fi
  [ $side_by_side = 0 ] && return $alone
  return $side_by_side
}

if ! command -v chromium >/dev/null && can_install; then
  make --no-print-directory browser || echo "test: no browser: the tests of the window are skipped" >&2
fi
have_vcan0 || make_vcan0
with_vcan0=$?
run_here "$@"
here=$?
[ $with_vcan0 = 0 ] && exit $here
case $here in 0 | 1 | "$no_tests") ;; *) exit $here ;; esac # interrupted, or pytest itself is unhappy

if ! have_guest && can_install; then
  make --no-print-directory vcan
fi
if ! have_guest; then
  echo "test: the SocketCAN tests did not run: this kernel has no vcan0 and user-mode Linux is not installed." >&2
  echo "test: 'make vcan' installs it (Debian); or: sudo modprobe vcan && sudo ip link add vcan0 type vcan &&" \
    "sudo ip link set vcan0 mtu 72 up" >&2
  exit $here
fi

echo "test: this kernel has no vcan0: the SocketCAN tests run in user-mode Linux"
guest=(tools/with_vcan.sh -t 2400)
[ -d "${HIL_DATA:-}" ] && guest+=(-r "$HIL_DATA")
if [ $# = 0 ]; then # to import all tests takes minutes there
  mapfile -t these < <(grep -rlF mark.socketcan --include='test_*.py' tests)
  set -- "${these[@]}"
fi
"${guest[@]}" -- "${pytest[@]}" "$@" -m socketcan
there=$?
if [ $there = $no_tests ]; then
  echo "test: no SocketCAN test was selected"
  there=0
fi

[ $here = 0 ] && exit $there
exit $here
