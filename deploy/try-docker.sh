#!/usr/bin/env bash
# Tries the image and compose.yaml for real, on this machine's Docker engine:
#
#   1. builds the release binary (or takes the one that SLABCAST_BINARY names);
#   2. makes debian:bookworm-slim from a debootstrap folder where the engine has none
#      (no image registry is asked; needs root, and debootstrap from Debian's packages);
#   3. builds the image and starts a master and three workers;
#   4. renders a turn of the sample with them, and kills one worker with SIGKILL meanwhile;
#   5. compares every frame's pixels_sha256 with those of a run inside one process;
#   6. prints a verdict and takes everything down again (images stay).
#
# deploy/try-docker.sh [VOLUME]      exit code 0: same pixels, and a lease was handed out again
set -euo pipefail
repo=$(cd "$(dirname "$0")/.." && pwd)
volume=$(realpath "${1:-$repo/samples/mni152_t1.nii.gz}")
export SLABCAST_PORT=${SLABCAST_PORT:-17433}
export SLABCAST_DATA=$(dirname "$volume") SLABCAST_FILE=$(basename "$volume")
work=$(mktemp -d)
project=slabcast-try
view=(--size 512x512 --frames 18)

say() { printf '\n== %s\n' "$*"; }
compose() {
    if docker compose version >/dev/null 2>&1; then
        docker compose -p "$project" -f "$repo/deploy/compose.yaml" "$@"
    else
        docker-compose -p "$project" -f "$repo/deploy/compose.yaml" "$@"
    fi
}
clean_up() {
    local code=$?
    if [ $code -ne 0 ]; then
        compose ps || true
        compose logs --tail=40 || true
        tail -5 "$work"/*.log || true
    fi
    compose down --timeout 15 >/dev/null 2>&1 || true
    rm -rf "$work"
}
trap clean_up EXIT

say "binary"
binary=${SLABCAST_BINARY:-}
if [ -z "$binary" ]; then
    (cd "$repo" && cargo build --release --locked -p slabcast)
    binary=${CARGO_TARGET_DIR:-$repo/target}/release/slabcast
fi
"$binary" --version

say "base image"
base=debian:bookworm-slim
if docker image inspect "$base" >/dev/null 2>&1; then
    echo "$base is there already"
else
    command -v debootstrap >/dev/null || { apt-get update -qq && apt-get install -y -qq debootstrap; }
    debootstrap --variant=minbase bookworm "$work/root" >"$work/debootstrap.log"
    # What the slim images leave out too: documents, translations, package lists.
    rm -rf "$work"/root/usr/share/{doc,man,locale,info}/* \
        "$work"/root/var/{lib/apt/lists,cache/apt}/*
    tar -C "$work/root" --numeric-owner -c . | docker import --change 'CMD ["bash"]' - "$base"
    rm -rf "$work/root"
fi

say "image"
"$repo/deploy/build-image.sh" "$binary" slabcast:0.1.0
docker image inspect --format '{{.Id}} {{.Size}} bytes, user {{.Config.User}}' slabcast:0.1.0

say "the same frames in one process"
"$binary" render "$volume" "${view[@]}" --stats "$work/alone.jsonl" -o "$work/alone"
hashes() { grep -o '"pixels_sha256":"[0-9a-f]*"' "$1"; }
hashes "$work/alone.jsonl" >"$work/alone.hashes"
frames=$(wc -l <"$work/alone.hashes")

say "master and three workers"
compose up -d
compose ps

# A worker dies by SIGKILL from the host, as it would by the kernel's hand, once some frames are
# out. It may happen to be between two leases; then the run is made again, so that what is
# tried is a worker that dies with work in its hands.
again=0
for try in 1 2 3 4 5; do
    say "render with the cluster, one worker killed (try $try)"
    rm -rf "$work/cluster" "$work/cluster.jsonl"
    "$binary" render --master "127.0.0.1:$SLABCAST_PORT" "${view[@]}" \
        --stats "$work/cluster.jsonl" -o "$work/cluster" >"$work/client.log" 2>&1 &
    client=$!
    until [ "$(ls "$work/cluster" 2>/dev/null | grep -c '\.png$')" -ge 3 ]; do
        kill -0 "$client" || { cat "$work/client.log"; exit 1; }
        sleep 0.02
    done
    victim=$(compose ps -q worker | sed -n "$((try % 3 + 1))p")
    kill -9 "$(docker inspect --format '{{.State.Pid}}' "$victim")"
    echo "killed worker ${victim:0:12} after $(ls "$work/cluster" | grep -c '\.png$') of $frames frames"
    wait "$client" || { cat "$work/client.log"; exit 1; }
    tail -2 "$work/client.log"
    hashes "$work/cluster.jsonl" >"$work/cluster.hashes"
    if ! cmp -s "$work/alone.hashes" "$work/cluster.hashes"; then
        diff "$work/alone.hashes" "$work/cluster.hashes" || true
        echo "VERDICT: pixels differ between one process and the cluster"
        exit 1
    fi
    again=$(grep -o '"retries":[0-9]*' "$work/cluster.jsonl" |
        awk -F: '{ n += $2 } END { print n + 0 }')
    echo "same pixels in $frames frames; leases handed out again: $again"
    [ "$again" -gt 0 ] && break
done
sleep 2
echo "restarts of that worker: $(docker inspect --format '{{.RestartCount}}' "$victim"), now $(docker inspect --format '{{.State.Status}}' "$victim")"

say "memory now"
docker stats --no-stream --format '{{.Name}} {{.MemUsage}}' $(compose ps -q) || true

say "stop"
begin=$SECONDS
compose stop --timeout 15
for id in $(compose ps -q); do
    docker inspect --format '{{.Name}} exit code {{.State.ExitCode}}' "$id"
done
echo "stopped in $((SECONDS - begin)) s"

[ "$again" -gt 0 ] || { echo "VERDICT: same pixels, but no worker died with a lease in five tries"; exit 1; }
echo
echo "VERDICT: same pixels in all $frames frames, with a worker killed while it held a lease"
