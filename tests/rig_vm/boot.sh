#!/usr/bin/env bash
# Boots a Linux with vcan as a process of this machine (User-mode Linux, no KVM), flies a short session on it
# through socketcan, and checks the frames that candump saw; beside it a second one with systemd, where the daemon is a
# service, until its power is cut; and that one again, from the same disk. Each has one processor. Needs Debian or
# Ubuntu, root, apt; .venv as `make test` makes it. Everything it fetches and writes lies in build/rig-vm. Exit code 77:
# it cannot be done here, and why.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
root=$(cd "$here/../.." && pwd)
work=$root/build/rig-vm

cannot() {
  echo "test-rig: skipped: $1" >&2
  exit 77
}
[ "$(uname -sm)" = "Linux x86_64" ] || cannot "User-mode Linux is for Linux on x86_64, this is $(uname -sm)"
[ "$(id -u)" = 0 ] || cannot "it takes root (hostfs and mounts), this is uid $(id -u)"
command -v apt-get >/dev/null && command -v dpkg-deb >/dev/null || cannot "it takes packages of Debian or Ubuntu"
command -v ip >/dev/null || cannot "it takes the package iproute2"
mkdir -p "$work/packages" "$work/system"
if [ ! -x "$work/system/usr/bin/linux.uml" ]; then
  (cd "$work/packages" && apt-get -o APT::Sandbox::User=root download -qq user-mode-linux can-utils kmod) ||
    cannot "apt-get cannot download user-mode-linux, can-utils and kmod"
  for package in "$work"/packages/*.deb; do dpkg-deb -x "$package" "$work/system"; done
fi

# Without it the guest starts on processors without AMX only.
whole_xstate=
if command -v cc >/dev/null; then
  whole_xstate=$work/whole_xstate.so
  cc -O2 -shared -fPIC -o "$whole_xstate" "$here/whole_xstate.c" -ldl
elif grep -qm1 amx_tile /proc/cpuinfo; then
  cannot "it takes a C compiler (cc) on a processor with AMX"
fi

# Compiled here, fetched there: the guests have one slow processor.
mkdir -p "$work/numba"
python=$root/.venv/bin/python
base=$("$python" -c 'import sys; print(sys.base_prefix)')
HERE=$here ROOT=$root BASE=$base NUMBA_CACHE_DIR=$work/numba unshare --mount bash -c '
  set -e; . "$HERE/place.sh"; place_levid
  PYTHONPATH=/srv/levid/src /srv/levid/bin/python /srv/levid/src/levid/tests/rig_vm/fill_numba_cache.py' ||
  cannot "it takes a mount namespace, and levid that runs in it"

guests=()
# cut PID: this guest has no power any more. Its kernel is the leader of a process group, which its processes are in.
cut() {
  local kernel
  kernel=$(pgrep -P "$1") || return 0 # it is off already
  kill -KILL -- "-$kernel" || true
}
trap 'for pid in "${guests[@]}"; do cut "$pid"; done' EXIT # whatever ends this script, ends the guests

# start OUT INIT DEVICE...: boots a guest, which leaves its results in OUT; $guest is its process. The last run stays
# readable beside the new one.
start() {
  rm -rf "$1.last"
  [ ! -d "$1" ] || mv "$1" "$1.last"
  mkdir -p "$1"
  cat > "$1.sh" <<EOF
#!/bin/bash
export HERE=$here ROOT=$root WORK=$work BASE=$base OUT=$1
exec /bin/bash "$here/$2"
EOF
  chmod +x "$1.sh"
  # A guest that gets little of the processor stalls all the more.
  LD_PRELOAD=$whole_xstate nice -n -5 timeout 600 "$work/system/usr/bin/linux.uml" mem=1G root=/dev/root rootfstype=hostfs hostfs=/ ro \
    "init=$1.sh" con=null con0=null,fd:1 quiet systemd.show_status=0 "${@:3}" </dev/null &
  guest=$!
  guests+=("$guest")
}

# ended OUT PID: the kernel exits with 0 whatever happened inside; what counts is the exit code the guest leaves behind.
ended() {
  { wait "$2"; } 2>/dev/null || true # without a word on who was killed
  code=$(cat "$1/exit-code" 2>/dev/null || echo "none")
  if [ "$code" != 0 ]; then
    echo "test-rig: the guest ended with exit code $code" >&2
    tail -n 20 "$1"/*.log >&2 || true
    exit 1
  fi
}

# Takes the guest with systemd to the end of its power, and then through its return.
service() {
  rm -f "$work/disk"
  truncate --size 512M "$work/disk"
  mkfs.ext4 -q "$work/disk"
  start "$work/out-service" init_systemd.sh "ubda=$work/disk"
  while kill -0 "$guest" 2>/dev/null && [ ! -e "$work/out-service/cut" ]; do sleep 0.05; done
  cut "$guest"
  ended "$work/out-service" "$guest"
  e2fsck -fy "$work/disk" > "$work/out-service/disk.log" 2>&1 || true # 1: mended, as after any power cut
  debugfs -R "rdump /state/cut-logs $work/out-service" "$work/disk" 2>> "$work/out-service/disk.log"
  "$python" "$here/check_power_cut.py" "$work/out-service" >> "$work/out-service/report.txt"
  cat "$work/out-service/report.txt"
  start "$work/out-again" init_systemd.sh "ubda=$work/disk"
  ended "$work/out-again" "$guest"
  cat "$work/out-again/report.txt"
}

missing=
for program in /lib/systemd/{systemd,systemd-networkd,systemd-udevd} /sbin/{mkfs.ext4,e2fsck,debugfs}; do
  [ -x "$program" ] || missing=$program
done
start "$work/out" init.sh
bus=$guest
[ "$(nproc)" -gt 1 ] || ended "$work/out" "$bus"
if [ -n "$missing" ]; then
  echo "test-rig: the service was not tried: it takes $missing" >&2
else
  service
fi
ended "$work/out" "$bus"
cat "$work/out/report.txt"
