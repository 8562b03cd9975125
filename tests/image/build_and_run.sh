#!/usr/bin/env bash
# Builds the image and runs it, as its own user and as another one. Needs no Docker daemon: buildah builds on a Debian
# root that debootstrap makes and that stands for the Dockerfile's base. Needs root and Debian's buildah and debootstrap.
#
#   make image-test
#
# IMAGE_TEST_BASE: pull the base from a registry instead, for example docker.io/library/python:3.11-slim.
# IMAGE_TEST_VOLUMES: HOST:CONTAINER:ro ..., for the build, such as pip's configuration for a mirror.
# IMAGE_TEST_FOLDER: where everything is kept between runs; else it is removed at the end.
set -euo pipefail
cd "$(dirname "$0")/../.."

base=$(sed -n 's/^FROM //p' Dockerfile)
if [ -n "${IMAGE_TEST_FOLDER:-}" ]; then
  folder=$IMAGE_TEST_FOLDER
  mkdir -p "$folder"
else
  folder=$(mktemp -d)
  trap 'rm -rf "$folder"' EXIT
fi
storage=(--storage-driver vfs --root "$folder/storage" --runroot "$folder/run")
volumes=()
for volume in ${IMAGE_TEST_VOLUMES:-}; do volumes+=(--volume "$volume"); done

say() { printf '\n=== %s\n' "$*"; }
buildah() { command buildah "${storage[@]}" "$@"; }

if [ -n "${IMAGE_TEST_BASE:-}" ]; then
  say "base: $IMAGE_TEST_BASE"
  buildah pull "$IMAGE_TEST_BASE"
  buildah tag "$IMAGE_TEST_BASE" "$base"
elif ! buildah inspect --type image "$base" >/dev/null 2>&1; then
  say "base: Debian 12 by debootstrap, tagged $base"
  [ -d "$folder/root/etc" ] ||
    debootstrap --variant=minbase --include=python3,python3-venv,ca-certificates bookworm "$folder/root"
  scratch=$(buildah from scratch)
  buildah add --quiet "$scratch" "$folder/root" /
  buildah config --env PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin "$scratch"
  buildah commit --quiet --rm "$scratch" "$base"
fi

say "build"
buildah build --isolation chroot --pull=never --network host "${volumes[@]}" --tag hemislam-test .

# run USER COMMAND...: in $container, as `docker run --user USER` does; "" for the image's own user. A user that the
# image does not know has HOME=/.
run() {
  local user=()
  if [ -n "$1" ]; then user=(--user "$1" --env HOME=/); fi
  shift
  buildah run --isolation chroot --network host "${user[@]}" "$container" -- "$@"
}

# served USER: the server answers while it runs, and ends with status 0 on SIGINT.
served() {
  local out="$folder/serve.txt" pid address=""
  run "$1" timeout --signal=INT --preserve-status 30 \
    hemislam serve sample_data/cloister.mcap --port 0 --no-browser --paused >"$out" 2>&1 &
  pid=$!
  while [ -z "$address" ] && kill -0 "$pid" 2>/dev/null; do
    sleep 0.2
    address=$(sed -n 's/^hemislam is at \([^ ]*\).*/\1/p' "$out")
  done
  if [ -n "$address" ]; then
    python3 - "$address" <<'PYTHON'
import json, sys, urllib.request
with urllib.request.urlopen(sys.argv[1] + "healthz", timeout=20) as answer:
    assert answer.status == 200 and json.load(answer) == {"status": "ok"}
with urllib.request.urlopen(sys.argv[1], timeout=20) as answer:
    assert b"<title>hemislam</title>" in answer.read()
PYTHON
  fi
  wait "$pid" || { cat "$out"; echo "hemislam serve failed"; return 1; }
  cat "$out"
  run "$1" sh -c 'test -s runs/sessions/*.hemislam' || { echo "hemislam serve kept no session file"; return 1; }
}

for user in "" 12345; do
  name=${user:-hemislam}
  container=$(buildah from --pull=never hemislam-test)
  say "as $name: info"
  run "$user" hemislam info sample_data/cloister.mcap
  say "as $name: run"
  run "$user" hemislam run sample_data/cloister.mcap --duration 10 --out "runs/image-test-$name"
  run "$user" test -s "runs/image-test-$name/trajectory.tum"
  say "as $name: serve"
  served "$user"
  buildah rm "$container" >/dev/null
done
say "the image works"
