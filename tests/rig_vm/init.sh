#!/bin/bash
# The guest's first process: kernel modules, a CAN FD bus, somewhere to write; then the flight, then off.
export PATH=/usr/sbin:/usr/bin:/sbin:/bin:$WORK/system/usr/bin:$WORK/system/bin:$WORK/system/sbin
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mountpoint -q /dev || mount -t devtmpfs dev /dev
mount -t tmpfs tmpfs /run # not over /tmp: the clone may lie there
mount -t hostfs -o "$WORK" none "$WORK" # writable, and nothing else is
out=$WORK/out
. "$HERE/place.sh"
place_levid

finish() {
  echo "$1" > "$out/exit-code"
  sync
  echo o > /proc/sysrq-trigger
  sleep 5
}

modules=$WORK/system/usr/lib/uml/modules/$(uname -r)/kernel
for module in can-dev vcan can can-raw; do
  file=$(find "$modules" -name "$module.ko" | head -n 1)
  # One program, told what to be by the name it is called by.
  (exec -a insmod "$WORK/system/bin/kmod" "$file") || { echo "insmod $module" >> "$out/init.log"; finish 20; }
done
{
  ip link set lo up
  for name in vcan0 vcan1; do # the second for what would disturb a flight
    ip link add $name type vcan
    ip link set $name mtu 72 up # 72: CAN FD
    ip -details link show $name
  done
} >> "$out/init.log" 2>&1 || finish 21

/bin/bash "$HERE/fly.sh" >> "$out/fly.log" 2>&1
finish $?
