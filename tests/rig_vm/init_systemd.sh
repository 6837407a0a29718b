#!/bin/bash
# The guest's first process where systemd is to be the second: an overlay over everything, then the real thing.
export PATH=/usr/sbin:/usr/bin:/sbin:/bin:$WORK/system/bin
out=$WORK/out-service
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mountpoint -q /dev || mount -t devtmpfs dev /dev
modules=$WORK/system/usr/lib/uml/modules/$(uname -r)/kernel
for module in overlay can-dev vcan can can-raw; do
  file=$(find "$modules" -name "$module.ko" | head -n 1)
  (exec -a insmod "$WORK/system/bin/kmod" "$file")
done
mount -t tmpfs tmpfs /mnt
mkdir /mnt/upper /mnt/work /mnt/root
mount -t overlay -o lowerdir=/,upperdir=/mnt/upper,workdir=/mnt/work overlay /mnt/root
new=/mnt/root
mkdir -p $new/rig $new/mnt/old $new/var/lib/levid $new/var/cache
mount -t hostfs -o "$out" none $new/rig # writable, and nothing else is
mount -t ext4 /dev/ubda $new/var/lib/levid # a disk: what it has not got is lost with the power
. "$HERE/place.sh"
UNDER=$new place_levid
cp -r "$WORK/numba" $new/var/cache/levid

# As a machine, not as the container that this may be.
rm -f $new/.dockerenv $new/etc/systemd/system/*.wants/* $new/etc/tmpfiles.d/tmp.conf
: > $new/etc/fstab
echo uninitialized > $new/etc/machine-id
for unit in systemd-binfmt systemd-modules-load systemd-update-utmp systemd-timesyncd systemd-tmpfiles-setup \
  systemd-tmpfiles-clean.timer proc-sys-fs-binfmt_misc.automount systemd-hwdb-update systemd-random-seed \
  systemd-resolved systemd-pstore systemd-firstboot; do
  case $unit in *.*) ;; *) unit=$unit.service ;; esac
  ln -sf /dev/null "$new/etc/systemd/system/$unit"
done
cat > $new/etc/systemd/system/rig.service <<UNIT
[Unit]
After=basic.target systemd-networkd.service
[Service]
Type=oneshot
TimeoutStartSec=infinity
Environment=PYTHONPATH=/srv/levid/src PYTHONDONTWRITEBYTECODE=1 NUMBA_CACHE_DIR=/var/cache/levid HOME=/run
ExecStart=/bin/bash -c '/srv/levid/bin/python /srv/levid/src/levid/tests/rig_vm/service.py >> /rig/service.log 2>&1; echo \$? > /rig/exit-code'
ExecStopPost=/bin/bash -c 'journalctl --no-pager > /rig/journal.log; sync; echo o > /proc/sysrq-trigger'
UNIT
cat > $new/etc/systemd/system/rig.target <<UNIT
[Unit]
Requires=basic.target systemd-udevd.service
Wants=systemd-networkd.service rig.service
AllowIsolate=yes
UNIT
cd $new
pivot_root . mnt/old
umount -l /mnt/old
exec /lib/systemd/systemd --unit=rig.target < /dev/null
