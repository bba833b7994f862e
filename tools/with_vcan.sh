#!/bin/bash
# Run one command on a throw-away Linux kernel that has real SocketCAN, on a host that has none.
#
#   with_vcan.sh [-t SECONDS] [-m MEMORY] [-w DIR]... [-r DIR]... -- COMMAND [ARGUMENT...]
#
# The guest is user-mode Linux: it needs neither root nor /dev/kvm and boots in a few seconds. It has vcan0, vcan1, the
# pair vxcan0 - vxcan1 (all with CAN FD) and the netem queue for delay and loss on the pair; no ISO-TP. It sees the host's
# files read-only, the current directory and each -w DIR writable, and fresh /tmp, /run and /dev/shm (name a directory
# below those with -r to keep it in sight). The environment is kept; there is no network but lo.
#
# Exit code: that of COMMAND; 124 after SECONDS (300), 125 when the guest broke down, 69 when something is not installed.
# Packages (Debian): user-mode-linux busybox-static iproute2 kmod; gcc libc6-dev too on a processor with AMX.
set -u

fail() { echo "with_vcan: $2" >&2; exit "$1"; }
usage() { sed -n '4s/^# */usage: /p' "$0" >&2; exit 64; }

limit=300 memory=1500M cwd=$PWD writable=("$PWD") readable=()
while getopts t:m:w:r: option; do
  case $option in
    t) limit=$OPTARG ;;
    m) memory=$OPTARG ;;
    w) writable+=("$(realpath "$OPTARG")") ;;
    r) readable+=("$(realpath "$OPTARG")") ;;
    *) usage ;;
  esac
done
shift $((OPTIND - 1))
[ $# -gt 0 ] || usage
command=("$@") terminal=no
[ -t 1 ] && terminal=yes

for program in linux.uml busybox; do
  command -v $program >/dev/null ||
    fail 69 "$program not found: apt-get install --no-install-recommends user-mode-linux busybox-static iproute2 kmod"
done

work=$(mktemp -d /var/tmp/with_vcan.XXXXXX)
trap 'rm -rf "$work"' EXIT

preload=()
if grep -qw amx_tile /proc/cpuinfo; then # see uml_xstate.c
  cc -O2 -shared -fPIC -o "$work/uml_xstate.so" "$(dirname "$0")/uml_xstate.c" ||
    fail 69 "this processor has AMX, which takes a C compiler: apt-get install --no-install-recommends gcc libc6-dev"
  preload=(env LD_PRELOAD="$work/uml_xstate.so")
fi

# What the guest runs as its first process: the values from here, then the program below.
{
  echo '#!/bin/bash'
  export -p | grep -vE '^declare -x (TMPDIR|OLDPWD|PWD|SHLVL|XDG_RUNTIME_DIR|_)='
  declare -p cwd writable readable work command terminal
  cat <<'GUEST'
PATH=$PATH:/usr/sbin:/sbin
stty -F /dev/tty1 raw -echo; stty -F /dev/tty2 raw -echo
exec >/dev/tty1 2>/dev/tty2

mount -t proc proc /proc; mount -t sysfs sys /sys
[ -e /dev/null ] || mount -t devtmpfs dev /dev
mkdir -p /dev/pts /dev/shm /dev/.keep
mount -t devpts -o mode=620,ptmxmode=666 devpts /dev/pts
mount -t tmpfs shm /dev/shm
ln -sfn /proc/self/fd /dev/fd
for n in 0:stdin 1:stdout 2:stderr; do ln -sfn /proc/self/fd/${n%:*} /dev/${n#*:}; done

# Directories to keep are mounted aside, then moved to their places above the fresh /run and /tmp.
keep=("${writable[@]}" "$work" "${readable[@]}")
for n in "${!keep[@]}"; do
  mkdir -p /dev/.keep/$n
  if [ "$n" -le ${#writable[@]} ]; then mount -t hostfs -o "${keep[n]}" none /dev/.keep/$n
  else mount --bind "${keep[n]}" /dev/.keep/$n; fi
done
mount -t tmpfs run /run; mount -t tmpfs tmp /tmp
for n in "${!keep[@]}"; do mkdir -p "${keep[n]}"; mount --move /dev/.keep/$n "${keep[n]}"; done

cd "/usr/lib/uml/modules/$(uname -r)/kernel" || echo "with_vcan: no modules for $(uname -r)" >&2
for module in net/can/can net/can/can-raw net/can/can-bcm net/can/can-gw net/can/j1939/can-j1939 \
              drivers/net/can/dev/can-dev drivers/net/can/vcan drivers/net/can/vxcan drivers/net/can/slcan/slcan \
              net/sched/sch_netem; do
  insmod $module.ko || echo "with_vcan: no module $module" >&2
done
ip link set lo up
ip link add vcan0 type vcan; ip link add vcan1 type vcan; ip link add vxcan0 type vxcan peer name vxcan1
for interface in vcan0 vcan1 vxcan0 vxcan1; do
  ip link set $interface mtu 72 && ip link set $interface up || echo "with_vcan: no $interface" >&2
done

cd "$cwd"
trap '' HUP
if [ $terminal = yes ]; then
  "${command[@]}" </dev/null
  code=$?
else # the consoles are terminals: put a pipe between, as the host has one, or there are colours and progress bars in logs
  exec 3> >(exec cat >/dev/tty1); out=$!
  exec 4> >(exec cat 3>&- >/dev/tty2); err=$!
  "${command[@]}" </dev/null >&3 2>&4 3>&- 4>&-
  code=$?
  exec 3>&- 4>&-
  for pid in $out $err; do timeout 2 tail --pid=$pid -s 0.05 -f /dev/null; done # a left process may hold the pipe open
fi
echo $code >"$work/code.part"; mv "$work/code.part" "$work/code"; sync
busybox poweroff -f
GUEST
} >"$work/init"
chmod 755 "$work/init"

# The guest has one processor. On one of the host's it hands over to its processes three times faster than across two.
pin=()
command -v taskset >/dev/null && pin=(taskset -c "$(taskset -cp $$ | sed 's/.*[ ,-]//')")

setsid timeout -k 3 "$limit" "${pin[@]}" "${preload[@]}" linux.uml mem="$memory" umid=guest uml_dir="$work/uml" quiet loglevel=3 \
  rootfstype=hostfs rootflags=/ ro init="$work/init" \
  con=null con0=null,fd:5 con1=null,fd:3 con2=null,fd:4 console=tty0 \
  3>&1 4>&2 5>"$work/log" </dev/null >/dev/null 2>&1 &
guest=$!
trap 'kill $guest 2>/dev/null' INT TERM HUP
wait $guest
ended=$?

[ -f "$work/code" ] && exit "$(cat "$work/code")"
[ $ended = 124 ] && fail 124 "stopped after $limit s"
tail -15 "$work/log" >&2
fail 125 "the guest gave no exit code (kernel ended with $ended)"
