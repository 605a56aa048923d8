#!/usr/bin/env bash
# Builds the image from a release binary: deploy/build-image.sh [BINARY [TAG]]
# The context is a folder of four files, so that no build tree is sent to the daemon.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
binary=${1:-${CARGO_TARGET_DIR:-$here/../target}/release/slabcast}
tag=${2:-slabcast:0.1.0}
[ -x "$binary" ] || {
    echo "no binary at $binary; run \`cargo build --release --locked\` or name one" >&2
    exit 2
}
context=$(mktemp -d)
trap 'rm -rf "$context"' EXIT
# Line tables stay in the build tree; the image gets the program alone.
install -m 0755 "$binary" "$context/slabcast"
strip --strip-debug "$context/slabcast" 2>/dev/null || true
install -m 0644 "$here/Dockerfile" "$here/../LICENSE-MIT" "$here/../LICENSE-APACHE" "$context/"
# The classic builder will do: the file uses nothing newer.
docker build --tag "$tag" "$context"
