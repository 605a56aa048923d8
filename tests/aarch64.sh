#!/usr/bin/env bash
# The same bytes on 64-bit ARM: bash tests/aarch64.sh
#
# Builds for aarch64 and runs there, in qemu's emulator of one program, what says that bytes are the same:
# every golden frame, the self-test at each instruction set (plain and NEON), the unit tests of what decides
# (common, render, schedule), among them those that compare NEON's loops with the plain ones, and the
# renderer's oracle: tiles against the serial renderer, in scenes at random. On an ARM machine it runs the same
# without an emulator.
#
# A command of its own, in neither .ci/run nor `cargo test`, since it builds all of it again and an emulator
# takes its time: 17 minutes on one core that others used, too, 12 of them to build. What is missing it
# installs (Debian's packages, rustup's target), or says what that would be.
set -euo pipefail
cd "$(dirname "$0")/.."
exec </dev/null
export CARGO_INCREMENTAL=0 CARGO_TERM_PROGRESS_WHEN=never
target=aarch64-unknown-linux-gnu

fail() { printf '\naarch64: FAILED: %s\n' "$1" >&2; exit 1; }

# install COMMAND...: Debian's packages, by root or sudo.
packages=(qemu-user gcc-aarch64-linux-gnu libc6-dev-arm64-cross)
install() {
    command -v apt-get >/dev/null || return 1
    local root=()
    [ "$(id -u)" = 0 ] || root=(sudo -n)
    "${root[@]}" apt-get update -q && "${root[@]}" apt-get install -q -y --no-install-recommends "$@"
}

runner=()
if [ "$(uname -m)" != aarch64 ]; then
    sysroot=/usr/aarch64-linux-gnu
    if ! command -v qemu-aarch64 >/dev/null || ! command -v aarch64-linux-gnu-gcc >/dev/null ||
        [ ! -e "$sysroot/lib/ld-linux-aarch64.so.1" ] || [ ! -e "$sysroot/lib/crt1.o" ]; then
        install "${packages[@]}" ||
            fail "no emulator or no cross compiler; on Debian: apt-get install ${packages[*]}"
    fi
    runner=(qemu-aarch64 -L "$sysroot")
    export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc
    export CC_aarch64_unknown_linux_gnu=aarch64-linux-gnu-gcc
    export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER="${runner[*]}"
    if [ ! -d "$(rustc --print target-libdir --target $target)" ]; then
        rustup target add $target || fail "no standard library for $target: rustup target add $target"
    fi
fi

step() { # step NAME COMMAND...
    local name=$1 begin=$SECONDS
    shift
    printf '\n==> %s: %s\n' "$name" "$*"
    "$@" || fail "$name: $*"
    printf '==> %s: %d s\n' "$name" $((SECONDS - begin))
}

# One profile for all: with its debug assertions, and what draws is optimised.
step "build" cargo build --locked -p slabcast --target $target
folder=$(cargo metadata --locked --no-deps --format-version 1 | sed 's/.*"target_directory":"\([^"]*\)".*/\1/')
slabcast=("${runner[@]}" "$folder/$target/debug/slabcast")

step "starts" "${slabcast[@]}" --version
step "golden frames" "${slabcast[@]}" check golden --verify tests/golden.txt

# Doctor also looks at ports and disks, which are nothing of ours here.
printf '\n==> self-test: doctor\n'
said=$("${slabcast[@]}" doctor) || true
grep self-test <<<"$said" || fail "self-test: doctor does not name it"
for set in plain neon; do
    grep -Eq "^ok +self-test +$set:" <<<"$said" || fail "self-test: $set does not pass"
done

# What else the renderer has (references in f64, bounds of errors, allocations) takes an emulator longer than
# all of this, and says less of bytes.
step "tests" cargo test --locked --target $target -p slabcast-common -p slabcast-trace -p slabcast-schedule \
    -p slabcast-sim -p slabcast-render --lib --test oracle --test closed_forms

printf '\naarch64: all passed in %d s: golden frames, self-test (plain, neon), tests; ' $SECONDS
if [ ${#runner[@]} = 0 ]; then echo "on this machine"; else echo "under $(qemu-aarch64 --version | head -1)"; fi
