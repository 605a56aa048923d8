#!/bin/sh
# Rehearses a cluster over a link of limited rate on one machine: two network namespaces and a pair of
# interfaces between them, each of which sends at RATE at most (tc-tbf). The master and the client are in
# one, the workers in the other. Needs root, iproute2, and veth and tbf in the kernel.
#
#   docs/measurements/scripts/shaped.sh 1gbit 50us slabcast lab plan VOLUME --trace FILE --rehearse 2,8,15 [more of plan's flags]
set -eu

if [ $# -lt 4 ]; then
    echo "usage: docs/measurements/scripts/shaped.sh RATE LATENCY slabcast lab plan VOLUME --trace FILE --rehearse LIST ..." >&2
    exit 2
fi
rate=$1
latency=$2
shift 2
if [ "$(id -u)" != 0 ]; then
    echo "docs/measurements/scripts/shaped.sh: network namespaces are made by root alone; run it with sudo" >&2
    exit 1
fi

near=slabcast-near-$$
far=slabcast-far-$$
at=10.213.77
clean() {
    # Interfaces go with their namespaces.
    for name in "$near" "$far"; do
        ip netns del "$name" 2>/dev/null || true
    done
}
trap clean EXIT INT TERM

ip netns add "$near"
ip netns add "$far"
ip link add near netns "$near" type veth peer name far netns "$far"
for end in near:1 far:2; do
    name=${end%:*}
    space=slabcast-$name-$$
    ip -n "$space" addr add "$at.${end#*:}/24" dev "$name"
    ip -n "$space" link set lo up
    ip -n "$space" link set "$name" up
    ip netns exec "$space" tc qdisc add dev "$name" root tbf rate "$rate" burst 256kb latency 50ms
done

ip netns exec "$near" "$@" --link "$rate" --latency "$latency" \
    --rehearse-at "$at.1" --rehearse-by "ip netns exec $far"
