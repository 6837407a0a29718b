#!/bin/sh
# Make the logs beside this file anew with the code of commit da9bfb8, and copy its configuration:
#     PYTHON=.venv/bin/python sh tests/data/da9bfb8/make.sh
# In virtual time the rows depend on the machine's arithmetic alone. The logs name no real host.
set -eu
commit=da9bfb8
here=$(cd "$(dirname "$0")" && pwd)
python=$(realpath -s "${PYTHON:-python}")
old=$(mktemp -d)
trap 'rm -rf "$old"' EXIT
mkdir "$old/levid"
git -C "$(git -C "$here" rev-parse --show-toplevel)" archive $commit | tar -x -C "$old/levid"
levid() {
  PYTHONPATH=$old "$python" -c "
import platform
platform.node, platform.platform = lambda: 'rig', lambda: 'Linux'
from levid.cli.main import main
main()" "$@"
}
cd "$old"
for kind in rigs sims sessions models signals; do
  rm -rf "${here:?}/$kind"
  cp -r "levid/config/$kind" "$here/$kind"
done
cp "$here/short.yaml" "$here/short-import.yaml" "$here/short-import.csv" .
levid excite short.yaml --rig "$here/rigs/loopback.yaml" --virtual --out flown
levid import short-import.csv --signals short-import.yaml -o imported.mcap
cp flown/01-short.mcap "$here/short.mcap"
cp imported.mcap "$here/short-import.mcap"
