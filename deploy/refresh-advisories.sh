#!/usr/bin/env bash
# Fetches the copy of the RustSec advisory database that .ci/run checks Cargo.lock against. For the
# day before a release, and for a machine that runs CI, once a month:
#
#   deploy/refresh-advisories.sh          fetch, then check Cargo.lock
#   deploy/refresh-advisories.sh where    print the folder of the copy
#
# Needs cargo-deny and the network. A machine without either gets the folder copied from another.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=${CARGO_HOME:-$HOME/.cargo}/advisory-dbs
if [ "${1:-}" = where ]; then
    echo "$folder"
    exit
fi
command -v cargo-deny >/dev/null || { echo "there is no cargo-deny; cargo install --locked cargo-deny" >&2; exit 1; }
cargo deny --locked fetch db
cargo deny --offline --locked check advisories
echo "the copy in $folder is fresh, and Cargo.lock has no advisory"
