#!/bin/bash
# Electronics and daemon on vcan0: a session is flown, an amplifier trips in the next, and frames are checked.
set -euo pipefail
out=$WORK/out
export NUMBA_CACHE_DIR=$WORK/numba MPLCONFIGDIR=/run XDG_RUNTIME_DIR=/run/levid HOME=/run TMPDIR=/run
export PYTHONDONTWRITEBYTECODE=1 PYTHONPATH=/srv/levid/src
mkdir -p "$XDG_RUNTIME_DIR"
levid=/srv/levid/bin/levid

# It says so where it loses frames: a Sync that it missed must not look like one that was never sent.
nice -n -20 candump -L -d -r 8388608 vcan0 > "$out/candump.txt" &
dump=$!
mkfifo /run/faults
# Hardware waits for nobody: electronics that are behind would answer every Sync too late from then on.
chrt --fifo 20 "$levid" electronics "$HERE/rig.yaml" < /run/faults > "$out/electronics.txt" 2> "$out/electronics.log" &
electronics=$!
exec 3> /run/faults # held open: a line is a command
until grep -q emulating "$out/electronics.log"; do sleep 0.2; kill -0 $electronics; done
"$levid" run "$HERE/rig.yaml" 2> "$out/daemon.log" &
daemon=$!
until grep -q socket "$out/daemon.log"; do sleep 0.2; kill -0 $daemon; done
renice -n -10 -p "$(pgrep -f levid.daemon.loop.loop_process)" # the loop has no time, its companions have

python=/srv/levid/bin/python
"$python" "$HERE/flights.py" "$HERE/session.yaml" "$out" /run/faults "$XDG_RUNTIME_DIR/levid.sock"

ps -eo pid,ni,time,etime,args --sort=-time | head -n 12 > "$out/processes.txt"
kill -TERM $daemon
wait $daemon
kill -TERM $electronics
wait $electronics
kill -INT $dump
wait $dump || true
"$python" "$HERE/check_frames.py" "$out/candump.txt" > "$out/report.txt"
"$python" "$HERE/check_logs.py" "$out" >> "$out/report.txt"
"$python" "$HERE/check_can_timestamps.py" vcan1 >> "$out/report.txt"
