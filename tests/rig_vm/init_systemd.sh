#!/bin/bash
# The guest's first process where systemd is to be the second: an overlay over everything, then the real thing. What it
# writes is on a disk; where that has an installation already, it boots as any machine does that was switched on.
export PATH=/usr/sbin:/usr/bin:/sbin:/bin:$WORK/system/bin
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mountpoint -q /dev || mount -t devtmpfs dev /dev
modules=$WORK/system/usr/lib/uml/modules/$(uname -r)/kernel
for module in overlay can-dev vcan can can-raw; do
  file=$(find "$modules" -name "$module.ko" | head -n 1)
  (exec -a insmod "$WORK/system/bin/kmod" "$file")
done
mount -t tmpfs tmpfs /mnt
mkdir /mnt/disk /mnt/root
mount -t ext4 /dev/ubda /mnt/disk # what it has not got is lost with the power
mkdir -p /mnt/disk/{upper,work,state}
[ ! -e /mnt/disk/upper/etc/levid ] || again=yes
mount -t overlay -o lowerdir=/,upperdir=/mnt/disk/upper,workdir=/mnt/disk/work overlay /mnt/root
new=/mnt/root
mkdir -p $new/rig $new/mnt/old $new/var/lib/levid $new/var/cache
mount -t hostfs -o "$OUT" none $new/rig # writable, and nothing else is
mount --bind /mnt/disk/state $new/var/lib/levid
. "$HERE/place.sh"
UNDER=$new place_levid
units=$new/etc/systemd/system

# As a machine, not as the container that this may be, and without its services.
rm -f $new/.dockerenv $new/etc/tmpfiles.d/tmp.conf
find $units/*.wants -mindepth 1 ! -name 'levid*' ! -name 'systemd-networkd*' -delete
: > $new/etc/fstab
# unit NAME: a unit of the test's own, from standard input.
unit() { cat > "$units/$1"; }
environment='PYTHONPATH=/srv/levid/src PYTHONDONTWRITEBYTECODE=1 NUMBA_CACHE_DIR=/var/cache/levid HOME=/run'
if [ -z "${again:-}" ]; then
  cp -r "$WORK/numba" $new/var/cache/levid
  echo uninitialized > $new/etc/machine-id
  for unit in systemd-binfmt systemd-modules-load systemd-update-utmp systemd-timesyncd systemd-tmpfiles-setup \
    systemd-tmpfiles-clean.timer proc-sys-fs-binfmt_misc.automount systemd-hwdb-update systemd-random-seed \
    systemd-resolved systemd-pstore systemd-firstboot systemd-logind getty.target; do
    case $unit in *.*) ;; *) unit=$unit.service ;; esac
    ln -sf /dev/null "$units/$unit"
  done
  script=service.py target=rig.target
  unit rig.target <<UNIT
[Unit]
Requires=basic.target systemd-udevd.service
Wants=systemd-networkd.service rig.service
AllowIsolate=yes
UNIT
else
  script=boot_after_power_cut.py target=multi-user.target
  mkdir -p $units/multi-user.target.wants
  ln -sf ../rig.service ../electronics.service $units/multi-user.target.wants
  unit electronics.service <<UNIT
[Unit]
After=systemd-networkd.service
Before=levid.service
[Service]
Environment=$environment
ExecStartPre=/bin/bash -c 'until ip link show vcan0 up | grep -q vcan0; do sleep 0.1; done'
ExecStart=/usr/bin/chrt --fifo 20 /srv/levid/bin/levid electronics /etc/levid/rig.yaml
ExecStartPost=/bin/bash -c 'until grep -q emulating /rig/electronics.log; do sleep 0.1; done'
StandardError=truncate:/rig/electronics.log
UNIT
fi
unit rig.service <<UNIT
[Unit]
After=basic.target systemd-networkd.service
[Service]
Type=oneshot
TimeoutStartSec=infinity
Environment=$environment
ExecStart=/bin/bash -c '/srv/levid/bin/python /srv/levid/src/levid/tests/rig_vm/$script >> /rig/service.log 2>&1; echo \$? > /rig/exit-code'
ExecStopPost=/bin/bash -c 'journalctl --no-pager --boot > /rig/journal.log; sync; echo o > /proc/sysrq-trigger'
UNIT
cd $new
pivot_root . mnt/old
umount -l /mnt/old
exec /lib/systemd/systemd --unit=$target < /dev/null
