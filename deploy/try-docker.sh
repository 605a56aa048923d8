#!/usr/bin/env bash
# Tries the image and compose.yaml for real, on this machine's Docker engine:
#
#   1. builds the release binary (or takes the one that SLABCAST_BINARY names);
#   2. makes debian:bookworm-slim from a debootstrap folder where the engine has none
#      (no image registry is asked; needs root, and debootstrap from Debian's packages);
#   3. builds the image and starts a master and three workers;
#   4. renders a turn of the sample with them; meanwhile one worker gets a SIGKILL while the
#      master says that it holds a lease;
#   5. compares every frame's pixels_sha256 with those of a run inside one process;
#   6. prints a verdict and takes everything down again (images stay).
#
# deploy/try-docker.sh [VOLUME]      exit code 0: the same pixels
# SLABCAST_UP=-y and the like are passed on, for volumes that do not say how they stand.
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
"$binary" render "$volume" ${SLABCAST_UP:+"--up=$SLABCAST_UP"} "${view[@]}" --stats "$work/alone.jsonl" -o "$work/alone"
hashes() { grep -o '"pixels_sha256":"[0-9a-f]*"' "$1"; }
hashes "$work/alone.jsonl" >"$work/alone.hashes"
frames=$(wc -l <"$work/alone.hashes")

say "master and three workers"
compose up -d
compose ps

# Tasks that the master has lent to the worker whose name begins with $1.
lent() {
    "$binary" status --master "127.0.0.1:$SLABCAST_PORT" --json |
        awk -v name="\"$1" '/"name":/ { mine = index($0, name) }
            /"tasks_lent":/ && mine { gsub(/[^0-9]/, ""); print }'
}

say "render with the cluster; one worker is killed with work in its hands"
"$binary" render --master "127.0.0.1:$SLABCAST_PORT" "${view[@]}" \
    --stats "$work/cluster.jsonl" -o "$work/cluster" >"$work/client.log" 2>&1 &
client=$!
done_frames() { find "$work/cluster" -name 'frame_*.png' 2>/dev/null | wc -l; }
until [ "$(done_frames)" -ge 3 ]; do
    kill -0 "$client" || { cat "$work/client.log"; exit 1; }
    sleep 0.02
done
victim=$(compose ps -q worker | sed -n 2p)
pid=$(docker inspect --format '{{.State.Pid}}' "$victim")
# Stopped first: what is lent to it from here on it can't finish. Killed once the master says
# that it has a lease, and before its silence is noticed.
kill -STOP "$pid"
until held=$(lent "${victim:0:12}") && [ "${held:-0}" -gt 0 ]; do
    kill -0 "$client" || { echo "the job ended before the worker was lent anything"; exit 1; }
    sleep 0.02
done
kill -KILL "$pid"
echo "killed worker ${victim:0:12} with $held lease(s), after $(done_frames) of $frames frames"
wait "$client" || { cat "$work/client.log"; exit 1; }
tail -1 "$work/client.log"
hashes "$work/cluster.jsonl" >"$work/cluster.hashes"
if ! diff "$work/alone.hashes" "$work/cluster.hashes"; then
    echo "VERDICT: pixels differ between one process and the cluster"
    exit 1
fi
grep -o '"retries":[0-9]*' "$work/cluster.jsonl" |
    awk -F: '{ n += $2 } END { print "leases handed out again in all: " n + 0 }'
sleep 2
echo "restarts of that worker: $(docker inspect --format '{{.RestartCount}}' "$victim"), now $(docker inspect --format '{{.State.Status}}' "$victim")"

say "memory now, and at its peak"
for id in $(compose ps -q); do
    pid=$(docker inspect --format '{{.State.Pid}}' "$id")
    echo "$(docker inspect --format '{{.Name}}' "$id") $(awk '/VmRSS|VmHWM/ { printf "%s %d MiB  ", $1, $2 / 1024 }' "/proc/$pid/status")"
done

say "stop"
begin=$SECONDS
compose stop --timeout 15
for id in $(compose ps -q); do
    docker inspect --format '{{.Name}} exit code {{.State.ExitCode}}' "$id"
done
echo "stopped in $((SECONDS - begin)) s"

echo
echo "VERDICT: same pixels in all $frames frames, with a worker killed while it held a lease"
