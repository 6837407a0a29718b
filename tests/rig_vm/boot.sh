#!/usr/bin/env bash
# Boots a Linux with vcan as a process of this machine (User-mode Linux, no KVM), flies a short session on it
# through socketcan, and checks the frames that candump saw. Needs Debian or Ubuntu, root, apt; .venv as `make test`
# makes it. Everything it fetches and writes lies in build/rig-vm. Exit code 77: it cannot be done here, and why.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
root=$(cd "$here/../.." && pwd)
work=$root/build/rig-vm
out=$work/out

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

# The last run stays readable beside the new one.
rm -rf "$out.last"
[ ! -d "$out" ] || mv "$out" "$out.last"
mkdir -p "$out" "$work/numba"
# Compiled here, fetched there: the guest has one slow processor.
NUMBA_CACHE_DIR=$work/numba "$root/.venv/bin/python" "$here/warm_up.py"

cat > "$work/init.sh" <<EOF
#!/bin/bash
export HERE=$here ROOT=$root WORK=$work PYTHONPATH=${PYTHONPATH:-}
exec /bin/bash "$here/init.sh"
EOF
chmod +x "$work/init.sh"

# A guest that gets little of the processor stalls all the more. The kernel exits with 0 whatever happened inside: what counts is the exit code the guest leaves behind.
nice -n -5 timeout 600 "$work/system/usr/bin/linux.uml" mem=1G root=/dev/root rootfstype=hostfs hostfs=/ ro \
  "init=$work/init.sh" con=null con0=null,fd:1 quiet </dev/null || true

code=$(cat "$out/exit-code" 2>/dev/null || echo "none")
if [ "$code" != 0 ]; then
  echo "test-rig: the guest ended with exit code $code" >&2
  tail -n 20 "$out"/*.log >&2 || true
  exit 1
fi
cat "$out/report.txt"
