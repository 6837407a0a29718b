# Puts levid where every user may read it and its path is the same here and in the guest, as numba's cache asks for:
# /srv/levid, like a venv. For `source` in a mount namespace of one's own, or in the guest. ROOT: the clone; BASE: where
# its Python is installed; UNDER: the root directory that is meant, if not /.
place_levid() {
  local srv=${UNDER:-}/srv name
  name=$(basename "$(readlink -f "$ROOT/.venv/bin/python")")
  mount -t tmpfs -o mode=755 tmpfs "$srv"
  mkdir -p "$srv"/levid/{src/levid,python,bin,lib}
  mount --bind "$ROOT" "$srv/levid/src/levid"
  mount --bind "$BASE" "$srv/levid/python"
  mount --bind "$(readlink -f "$ROOT/.venv")/lib" "$srv/levid/lib"
  ln -s "/srv/levid/python/bin/$name" "$srv/levid/bin/python"
  printf 'home = /srv/levid/python/bin\ninclude-system-site-packages = false\n' > "$srv/levid/pyvenv.cfg"
  sed '1s|.*|#!/srv/levid/bin/python|' "$ROOT/.venv/bin/levid" > "$srv/levid/bin/levid"
  chmod +x "$srv/levid/bin/levid"
}
