#!/usr/bin/env bash
# The long campaigns, for nights: bash tests/nightly.sh [mutants|simd|faults|matrix|flips|soak|long]...
#
#   mutants   100,000 mutants of small files through every parser (SLABCAST_MUTANTS)
#   simd      the renderer's tests on every instruction set of this machine, and its benches once
#   faults    10,000 seeds of faults in the virtual cluster (SLABCAST_SEEDS)
#   matrix    every combination of workers, threads, tiles, slabs, culling and links
#   flips     100,000 flipped bits in each direction of a link, worker and client (SLABCAST_FLIPS)
#   soak      an hour of jobs while workers are killed and stopped and clients cancel
#             (SLABCAST_SOAK_MINUTES)
#   long      tests of commands that take half a minute and more
#
# Prints one line for each campaign: its name, ok or FAILED, seconds, and its figure. What each
# campaign printed is in target/nightly. Ends with 1 if one failed.
set -uo pipefail
cd "$(dirname "$0")/.."
exec </dev/null
logs=${CARGO_TARGET_DIR:-target}/nightly
mkdir -p "$logs"
failed=0

campaign() { # campaign NAME FIGURE COMMAND...: FIGURE is an awk program over the command's output
    local name=$1 figure=$2 begin=$SECONDS state=ok
    shift 2
    "$@" >"$logs/$name.log" 2>&1 || { state=FAILED; failed=1; }
    printf '%-8s %-6s %5d s  %s\n' "$name" "$state" $((SECONDS - begin)) \
        "$(awk "$figure" "$logs/$name.log")"
    [ $state = ok ] || tail -n 20 "$logs/$name.log" >&2
}

# Sums the tests of all test programs.
tests='/^test result:/ { passed += $4; failed += $6 } END { printf "%d tests passed, %d failed", passed, failed }'

[ $# -gt 0 ] || set -- mutants simd faults matrix flips soak long
for name in "$@"; do
    case $name in
    mutants)
        campaign mutants \
            '/ mutants in / {
                 parsers++
                 for (i = 2; i <= NF; i++) {
                     if ($i == "mutants") mutants += $(i - 1)
                     if ($i == "opened,") opened += $(i - 1)
                 }
             }
             END { printf "%d mutants of %d parsers, %d opened", mutants, parsers, opened }' \
            env SLABCAST_MUTANTS="${SLABCAST_MUTANTS:-100000}" \
            cargo test --release --locked -p slabcast-volumes --all-features mutants -- --nocapture
        ;;
    simd)
        campaign simd "$tests" \
            env SLABCAST_TEST_ALL_SIMD=1 cargo test --locked -p slabcast-render --all-targets
        ;;
    faults)
        campaign faults \
            '/ frames, .* retries, / {
                 campaigns++
                 for (i = 2; i <= NF; i++) {
                     if ($i == "frames,") frames += $(i - 1)
                     if ($i == "retries,") retries += $(i - 1)
                 }
             }
             END { printf "%d campaigns, %d frames, %d retries", campaigns, frames, retries }' \
            env SLABCAST_SEEDS="${SLABCAST_SEEDS:-10000}" \
            cargo test --release --locked -p slabcast-sim --test faults -- --nocapture
        ;;
    matrix)
        campaign matrix '/^exact: / { line = $0 } END { print line }' \
            cargo run --release --locked -- lab check matrix
        ;;
    flips)
        campaign flips '/ flips / { print }' \
            env SLABCAST_FLIPS="${SLABCAST_FLIPS:-100000}" \
            cargo test --locked -p slabcast --test noise -- --ignored --nocapture
        ;;
    soak)
        campaign soak '/^soak: / { sub("soak: ", ""); print }' \
            env SLABCAST_SOAK_MINUTES="${SLABCAST_SOAK_MINUTES:-60}" \
            SLABCAST_SOAK_DIR="$(realpath "$logs")" \
            cargo test --release --locked -p slabcast --test soak -- --ignored --nocapture
        ;;
    long)
        campaign long "$tests" \
            cargo test --locked -p slabcast --test commands -- --ignored error_target thin_sheets
        ;;
    *)
        echo "nightly: no campaign $name; there are mutants, simd, faults, matrix, flips, soak and long" >&2
        exit 2
        ;;
    esac
done
exit $failed
